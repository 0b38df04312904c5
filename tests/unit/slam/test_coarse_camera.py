"""The guessed camera: its geometry, its scale, and the search that finds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from picture_road import loop_drive
from pixel_road import fisheye

from datagen.slam.camera.coarse import (
    NOMINAL_HEIGHT_CM,
    Look,
    clearest_step,
    coarse_camera,
    guessed_camera,
    looking_alike,
    with_known_scale,
)
from datagen.slam.odometry.image_pairs import ImagePairs, OdometrySettings
from datagen.slam.odometry.odometry import STEPS_HEIGHTS, best_step
from datagen.slam.odometry.scans import seen_edges
from datagen.slam.settings import GuessSettings
from datagen.slam.view import mapping_range
from lanenet.geometry.camera import Mounting
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.road import PerceptionSettings, RangeSettings, RoadTable

GUESS = GuessSettings()


def test_the_guessed_camera_sits_ahead_of_the_rear_axle():
    camera = guessed_camera(160, 120, 80.0, 15.0, GUESS)
    m = camera.mounting
    lever = camera.wheelbase_cm + m.ahead_of_front_axle_cm
    assert lever == pytest.approx(0.9 * NOMINAL_HEIGHT_CM)
    assert camera.wheelbase_cm == GUESS.wheelbase_cm
    # The axis meets the road straight ahead, at height over tan(pitch).
    centre = camera.intersect_ground(np.array([[79.5, 59.5]]))[0]
    np.testing.assert_allclose(
        centre, [0.0, m.ahead_of_front_axle_cm + NOMINAL_HEIGHT_CM / np.tan(np.deg2rad(15.0))], atol=1e-9
    )


def test_a_camera_looks_where_one_with_another_principal_point_does():
    usual = guessed_camera(160, 120, 110.0, 20.0, GUESS)
    K = np.array(usual.K)
    K[:2, 2] += [-6.0, 9.0]
    found = replace(usual, K=K).with_mounting(pitch_down_rad=0.4, yaw_rad=-0.01, roll_rad=0.03)
    turned = looking_alike(usual, found)
    middle = np.array([[79.5, 59.5]])
    np.testing.assert_allclose(turned.intersect_ground(middle), found.intersect_ground(middle), atol=1e-6)
    # Nine pixels of 110 are 4.7 degrees.
    assert turned.mounting.pitch_down_rad == pytest.approx(0.4 - 9.0 / 110.0, abs=0.005)
    assert turned.mounting.yaw_rad < -0.05
    assert turned.mounting.roll_rad == usual.mounting.roll_rad
    np.testing.assert_array_equal(turned.K, usual.K)


def test_a_camera_whose_middle_shows_no_road_keeps_its_angles():
    usual = guessed_camera(160, 120, 110.0, 20.0, GUESS)
    level = usual.with_mounting(pitch_down_rad=-0.05, yaw_rad=0.02)
    turned = looking_alike(usual, level)
    assert (turned.mounting.pitch_down_rad, turned.mounting.yaw_rad) == (-0.05, 0.02)


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.7])
def test_a_known_scale_stretches_the_road_and_keeps_the_car(factor):
    camera = guessed_camera(160, 120, 80.0, 15.0, GUESS)
    scaled = with_known_scale(camera, factor, GUESS.wheelbase_cm)
    assert scaled.wheelbase_cm == camera.wheelbase_cm
    assert scaled.mounting.height_cm == pytest.approx(factor * camera.mounting.height_cm)
    lever, scaled_lever = (c.wheelbase_cm + c.mounting.ahead_of_front_axle_cm for c in (camera, scaled))
    assert scaled_lever == pytest.approx(factor * lever)
    # Seen from the rear axle, where poses are, every point of the road is `factor` as far.
    pixels = np.array([[80.0, 80.0], [20.0, 100.0], [140.0, 70.0]])
    rear = np.array([0.0, camera.wheelbase_cm])
    np.testing.assert_allclose(
        scaled.intersect_ground(pixels) + rear, factor * (camera.intersect_ground(pixels) + rear)
    )


def test_the_mapping_range_grows_with_the_camera():
    base = RangeSettings(top_row=40, bottom_rows=7)
    small, large = (mapping_range(Mounting(height_cm), base) for height_cm in (10.0, 20.0))
    assert (small.far_cm, small.side_cm, small.max_cm_per_px) == pytest.approx((60.0, 60.0, 3.0))
    assert large.far_cm == pytest.approx(2.0 * small.far_cm)
    assert (large.top_row, large.bottom_rows) == (40, 7)
    # It begins at a camera before the car, not at an axle that the camera does not see.
    for ahead_cm, far_cm in ((-5.0, 60.0), (25.0, 85.0)):
        before = mapping_range(Mounting(10.0, ahead_of_front_axle_cm=ahead_cm), base)
        assert (before.far_cm, before.side_cm) == pytest.approx((far_cm, 60.0))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_search_finds_the_neighbourhood_of_the_camera(seed):
    """The truth lies on the grid; a second round looks half as far around the best."""
    true = fisheye(pitch_down_rad=np.deg2rad(24.0), roll_rad=0.0, yaw_rad=0.0)
    true.K[:2, :2] = np.diag([60.0, 60.0])
    drive, _ = loop_drive(true, 60, 100, 400.0, seed)
    guess = GuessSettings(focal_px=(60.0, 80.0), pitch_deg=(16.0, 24.0), frames=100)
    seen: list[tuple[int, int]] = []
    camera, tried = coarse_camera(
        drive, PerceptionSettings(), guess, np.random.default_rng(seed), lambda *done: seen.append(done)
    )
    assert abs(camera.K[0, 0] - 60.0) <= 10.0
    assert abs(np.rad2deg(camera.mounting.pitch_down_rad) - 24.0) <= 4.0 + 1e-9
    assert camera.mounting.height_cm == NOMINAL_HEIGHT_CM and camera.wheelbase_cm == guess.wheelbase_cm
    # The camera is that of the best candidate, and no camera was tried twice.
    best = max(tried, key=lambda candidate: candidate.fit)
    assert tried[0] is best and (best.look.focal_px, best.look.pitch_deg) == pytest.approx(
        (camera.K[0, 0], np.rad2deg(camera.mounting.pitch_down_rad))
    )
    assert len({c.look for c in tried}) == len(tried) >= 8
    assert {Look(f, p) for f in guess.focal_px for p in guess.pitch_deg} <= {c.look for c in tried}
    assert all(0.0 < c.fit < np.log1p(10.0) and c.step_heights > 0.0 for c in tried)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_the_step_is_that_of_the_camera_in_which_one_stands_out():
    """A camera that looks far too far up likes another step best, which must not count."""
    true = fisheye(pitch_down_rad=np.deg2rad(24.0), roll_rad=0.0, yaw_rad=0.0)
    drive, _ = loop_drive(true, 60, 100, 400.0, 0)
    far_off = guessed_camera(160, 120, 110.0, 7.0, GUESS)
    pixels = [find_edges(drive.image(k), EdgeSettings()) for k in range(60)]
    pictures = {}
    for name, camera in (("true", true), ("far off", far_off)):
        table = RoadTable(camera, mapping_range(camera.mounting, RangeSettings()))
        edges = [seen_edges(frame, table) for frame in pixels]
        pictures[name] = ImagePairs(edges, camera, OdometrySettings(), np.random.default_rng(0))
    relative = np.ones(60)
    wrong, _ = best_step(pictures["far off"], relative, np.array(STEPS_HEIGHTS))
    step_heights = 4.0 / true.mounting.height_cm
    assert abs(wrong / step_heights - 1.0) > 0.3
    for order in (("true", "far off"), ("far off", "true")):
        step = clearest_step((pictures[name] for name in order), relative)
        assert step == pytest.approx(step_heights, rel=0.05)


def test_the_focal_lengths_to_try_grow_with_the_image():
    camera = guessed_camera(320, 240, 160.0, 15.0, GUESS)
    np.testing.assert_allclose(camera.K[:2, 2], [159.5, 119.5])
    small = guessed_camera(160, 120, 80.0, 15.0, GUESS)
    # The same ray in a picture of twice the size; pixel centres are at integers.
    np.testing.assert_allclose(
        camera.intersect_ground(np.array([[240.5, 200.5]])),
        small.intersect_ground(np.array([[120.0, 100.0]])),
    )


@pytest.mark.slow
@pytest.mark.parametrize("roll_deg", [9.0, -6.0])
def test_a_steep_and_rolled_camera_is_found_where_no_level_one_fits(roll_deg):
    true = fisheye(pitch_down_rad=np.deg2rad(33.0), roll_rad=np.deg2rad(roll_deg), yaw_rad=0.0)
    true.K[:2, :2] = np.diag([100.0, 100.0])
    drive, _ = loop_drive(true, 100, 140, 400.0, 0)
    guess = GuessSettings(
        frames=100, focal_px=(80.0, 95.0), pitch_deg=(11.0, 19.0),
        steep_focal_px=(80.0, 104.0), steep_pitch_deg=(25.0, 32.0), steep_roll_deg=(-7.0, 0.0, 7.0),
    )  # fmt: skip
    camera, tried = coarse_camera(drive, PerceptionSettings(), guess, np.random.default_rng(0))
    found = camera.mounting
    assert (
        any(c.look.roll_deg == 0.0 for c in tried)
        and max(c.fit for c in tried if c.look.pitch_deg > 24.0) > 0.15
    )
    assert abs(np.rad2deg(found.pitch_down_rad) - 33.0) < 4.0
    assert abs(np.rad2deg(found.roll_rad) - roll_deg) < 4.0
    assert abs(camera.K[0, 0] / 100.0 - 1.0) < 0.2


@pytest.mark.slow
def test_a_pinhole_whose_axis_is_far_beside_the_middle_is_found():
    """Images that were rectified with another camera's file."""
    K = np.array([[70.0, 0.0, 79.5 + 26.0], [0.0, 70.0, 59.5], [0.0, 0.0, 1.0]])
    usual = fisheye(pitch_down_rad=np.deg2rad(18.0), roll_rad=0.0, yaw_rad=0.0)
    true = replace(usual, model="pinhole", K=K, D=np.zeros(4))
    drive, _ = loop_drive(true, 60, 100, 400.0, 0)
    guess = GuessSettings(focal_px=(65.0, 80.0), pitch_deg=(14.0, 20.0), frames=100)
    camera, _ = coarse_camera(drive, PerceptionSettings(), guess, np.random.default_rng(0))
    # Within a step of the walk: with a pinhole, focal length and pitch make up for the rest.
    assert camera.model == "pinhole" and abs(camera.K[0, 2] - K[0, 2]) < 0.045 * 160.0


def test_a_level_camera_costs_no_search_for_steep_ones():
    true = fisheye(pitch_down_rad=np.deg2rad(16.0), roll_rad=0.0, yaw_rad=0.0)
    drive, _ = loop_drive(true, 60, 100, 400.0, 0)
    guess = GuessSettings(focal_px=(65.0, 80.0), pitch_deg=(16.0, 24.0), frames=100)
    _, tried = coarse_camera(drive, PerceptionSettings(), guess, np.random.default_rng(0))
    assert {c.look.roll_deg for c in tried} == {0.0} and len(tried) <= 13
