"""The bundle adjustment: drifted poses and nods come back from edge pixels alone."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest
from pixel_road import camera_numbers, drifted, fisheye, mirrored, pinhole, pixels
from tape_road import tape_road

from datagen.slam.adjustment import adjust as bundle_adjust
from datagen.slam.adjustment.adjust import (
    BundleEstimate,
    BundleProblem,
    BundleSettings,
    Observations,
    adjust,
    frame_priors,
    inner_pixels,
    point_trust,
)
from datagen.slam.adjustment.state import BundleState
from datagen.slam.commands import BREAK_PERIODS
from lanenet.geometry.poses import path_lengths

#: The pixels are exact, so that they may weigh more, and be looked for nearer, than those of a real picture.
SMALL = BundleSettings(points=40, pixel_sigma=0.3, gates_px=(5.0, 4.0, 3.0, 2.0, 1.0, 1.0))


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _error(found: np.ndarray, true: np.ndarray) -> float:
    """Largest distance from the true path, as a share of its length."""
    return float(np.linalg.norm(found[:, :2] - true[:, :2], axis=1).max() / path_lengths(true)[-1])


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
@pytest.mark.parametrize(("seed", "way", "turn_rad"), [(0, 0.03, 0.002), (1, -0.04, -0.003)])
def test_drifted_poses_come_back(model, seed, way, turn_rad):
    camera = fisheye() if model == "fisheye" else pinhole()
    road = tape_road(70)
    start = drifted(road.poses, way, turn_rad)
    assert _error(start, road.poses) > 0.03
    found = adjust(
        Observations(pixels(road, camera)), BundleEstimate.level(start, camera), SMALL, _rng(seed), free=()
    )
    assert _error(found.poses, road.poses) < 1e-3
    assert np.abs(found.poses[:, 2] - road.poses[:, 2]).max() < np.deg2rad(0.1)
    np.testing.assert_allclose(found.poses[0], road.poses[0], atol=1e-3)
    assert found.robust_sd_px < 0.05
    assert np.abs(found.tilt).max() < 1e-3
    assert len(found.pairs) == sum(70 - lag for lag in SMALL.lags)


def test_the_number_of_cores_changes_nothing(monkeypatch):
    camera, road = fisheye(), tape_road(20)
    observed, start = Observations(pixels(road, camera)), BundleEstimate.level(road.poses, camera)
    found, short = {}, SMALL.model_copy(update={"gates_px": (3.0, 2.0), "iterations": 2})
    running = threading.active_count()
    for cores in (1, 3):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        found[cores] = adjust(observed, start, short, _rng())
    assert threading.active_count() <= running and found[1].camera.hash == found[3].camera.hash
    np.testing.assert_array_equal(found[1].poses, found[3].poses)


@pytest.mark.parametrize("seed", range(2))
def test_nods_of_each_frame_come_back(seed):
    camera, road, rng = fisheye(), tape_road(70), _rng(seed)
    tilt = rng.normal(size=(70, 2)) * [0.012, 0.005]
    observed = Observations(pixels(road, camera, tilt))
    start = BundleEstimate.level(drifted(road.poses, 0.02, 0.001), camera)
    found = adjust(observed, start, SMALL, rng, free=())
    for k in (0, 1):
        assert np.corrcoef(found.tilt[5:, k], tilt[5:, k])[0, 1] > 0.98
        assert np.std(found.tilt[5:, k] - tilt[5:, k]) < 1e-3
    assert _error(found.poses, road.poses) < 2e-3
    # Without the frames' own tilt the same edges do not agree.
    stiff = SMALL.model_copy(update={"frame_pitch": 1e-6, "frame_roll": 1e-6})
    worse = adjust(observed, start, stiff, _rng(seed), free=())
    assert worse.misfit > 1.5 * found.misfit and worse.robust_sd_px > 2.0 * found.robust_sd_px


@pytest.mark.parametrize("seed", range(2))
def test_a_break_is_not_bridged(seed):
    camera, road = fisheye(), tape_road(80)
    edges = pixels(road, camera)
    observed = Observations(edges, periods=np.where(np.arange(80) == 40, BREAK_PERIODS, 1.0))
    problem = BundleProblem(observed, camera, SMALL, _rng(seed))
    first = problem.pairs.min(axis=1)
    assert not ((first < 40) & (problem.pairs.max(axis=1) >= 40)).any()
    assert len(problem.pairs) == 2 * sum(40 - lag for lag in SMALL.lags)
    # Put down a metre away: both pieces come back, each as it lies.
    start = drifted(road.poses, 0.02, 0.001)
    start[40:] = drifted(road.poses[40:], 0.02, 0.001) + [100.0, 60.0, 0.0]
    found = adjust(observed, BundleEstimate.level(start, camera), SMALL, _rng(seed), free=())
    lay = found.poses[40] - road.poses[40]
    assert np.linalg.norm(lay[:2] - [100.0, 60.0]) < 2.0
    assert _error(found.poses[:40], road.poses[:40]) < 1e-3
    c, s = np.cos(lay[2]), np.sin(lay[2])
    turned = (road.poses[40:, :2] - road.poses[40, :2]) @ np.array([[c, s], [-s, c]])
    apart = found.poses[40:, :2] - found.poses[40, :2] - turned
    assert np.linalg.norm(apart, axis=1).max() < 1e-3 * path_lengths(road.poses[40:])[-1]


def test_points_that_meet_no_edge_again_weigh_little():
    in_view = np.array([10, 10, 10, 10, 1, 0, 2])
    matched = np.array([10, 9, 4, 0, 1, 0, 2])
    trust = point_trust(in_view, matched)
    np.testing.assert_allclose(trust, [1.0, 1.0, 0.02, 0.02, 0.3, 0.02, 1.0])
    more = point_trust(np.full(41, 40), np.arange(41))
    assert (np.diff(more) >= 0.0).all() and more.min() > 0.0 and more.max() == 1.0


@pytest.mark.parametrize("seed", range(2))
def test_noise_that_stays_in_the_picture_does_not_hold_the_car_back(monkeypatch, seed):
    """Dirt on the lens would have the car stand: two thirds of all points, at the same pixels every time."""
    camera, road, rng = fisheye(), tape_road(60), _rng(seed)
    angle = rng.uniform(-np.pi, np.pi, 400)
    dirt, normals = (
        rng.uniform([0.0, 45.0], [159.0, 119.0], (400, 2)),
        np.stack([np.cos(angle), np.sin(angle)]),
    )
    noisy = [
        type(e)(np.concatenate([e.uv_px, dirt]), np.concatenate([e.normals, normals.T]))
        for e in pixels(road, camera)
    ]

    def error() -> float:
        start = BundleEstimate.level(drifted(road.poses, 0.02, 0.001), camera)
        found = adjust(Observations(noisy), start, BundleSettings(points=80), _rng(seed), free=())
        return _error(found.poses, road.poses)

    trusting_some = error()
    assert trusting_some < 3e-3
    monkeypatch.setattr(bundle_adjust, "point_trust", lambda in_view, matched: np.ones(len(in_view)))
    assert error() > 1.5 * trusting_some


def test_what_falls_on_the_rim_of_what_is_seen_looks_for_no_edge():
    """Its own edge may lie beyond, and the nearest one on this side is another."""
    camera, road = fisheye(), tape_road(2)
    keep = np.zeros((camera.height, camera.width), np.uint8)
    keep[55:95] = 255
    # The car stands, so that every point falls on its own pixel.
    edges = pixels(road, camera)[:1] * 2
    where = []
    for known in (keep, None):
        problem = BundleProblem(Observations(edges, known), camera, SMALL, _rng())
        state = BundleState.at(BundleEstimate.level(road.poses[[0, 0]], camera))
        where.append(problem.points.uv[problem.associate(state, 5.0).point, 1])
    assert len(where[0]) > 10 and where[0].min() > 55.5 and where[0].max() < 93.5
    assert len(where[1]) > len(where[0])
    met = [len(w[(w > 56.5) & (w < 92.5)]) for w in where]
    assert met[0] == met[1]


def test_pixels_at_the_rim_are_no_inner_ones():
    camera = fisheye()
    whole = inner_pixels(camera, None)
    assert not whole[[0, -1]].any() and not whole[:, [0, -1]].any() and whole[1:-1, 1:-1].all()
    keep = np.full((camera.height, camera.width), 255, np.uint8)
    keep[:30] = 0
    inner = inner_pixels(camera, keep)
    assert not inner[:31].any() and inner[31:-1, 1:-1].all()


def test_the_same_seed_gives_the_same_and_another_nearly():
    camera, road = fisheye(), tape_road(30)
    observed = Observations(pixels(road, camera))
    start = BundleEstimate.level(drifted(road.poses, 0.02, 0.001), camera)
    one, same, other = (adjust(observed, start, SMALL, _rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.poses, same.poses)
    np.testing.assert_array_equal(one.residual_px, same.residual_px)
    assert one.camera.hash == same.camera.hash
    assert not np.array_equal(one.poses, other.poses)
    assert _error(one.poses, other.poses) < 0.02


def test_a_mirrored_world_gives_the_mirrored_result():
    camera, road = fisheye(), tape_road(40)
    other = mirrored(camera)
    flip = np.array([1.0, -1.0, -1.0])
    edges, start = pixels(road, camera), drifted(road.poses, 0.02, 0.001)
    seen = pixels(road.mirrored(), other)
    np.testing.assert_allclose(seen[0].uv_px, edges[0].uv_px * [-1.0, 1.0] + [159.0, 0.0], atol=1e-9)
    here, there = (
        adjust(Observations(e), BundleEstimate.level(p, c), SMALL, _rng(1))
        for e, p, c in ((edges, start, camera), (seen, start * flip, other))
    )
    np.testing.assert_allclose(there.poses * flip, here.poses, atol=0.01)
    np.testing.assert_allclose(there.tilt * [1.0, -1.0], here.tilt, atol=1e-4)
    np.testing.assert_allclose(
        camera_numbers(mirrored(there.camera)), camera_numbers(here.camera), rtol=1e-3, atol=1e-3
    )
    assert there.misfit == pytest.approx(here.misfit, abs=2e-3)


@pytest.mark.parametrize("command", [0.4, 2.5])
def test_ways_follow_the_commands_where_the_pictures_are_silent(command):
    """A stretch without a mark across the road: only the commanded way tells how far the car went."""
    camera, road = fisheye(), tape_road(30)
    edges = pixels(road, camera)
    edges[14:18] = [type(e)(e.uv_px[:0], e.normals[:0]) for e in edges[14:18]]
    expected = np.ones(30)
    expected[15:18] = command
    settings = SMALL.model_copy(update={"lags": (1,), "speed_change": 1e-4})
    observed = Observations(edges, relative_steps=expected)
    found = adjust(observed, BundleEstimate.level(road.poses, camera), settings, _rng(), free=())
    way = np.diff(path_lengths(found.poses))
    np.testing.assert_allclose(way[14:17] / np.median(way[:12]), command, rtol=0.02)


def _prior(poses: np.ndarray, expected: np.ndarray, recorded: bool) -> tuple[float, np.ndarray]:
    """Cost of what is believed of the frames, and its downhill slope by their numbers."""
    state = BundleState.at(BundleEstimate.level(poses, fisheye()))
    observed = Observations([], relative_steps=expected, speed_recorded=recorded)
    cost, _, downhill = frame_priors(state, BundleSettings(), observed)
    return cost, downhill


def test_a_recorded_speed_tells_each_way_about_its_gain():
    road = tape_road(30)
    expected = np.ones(30)
    expected[12] = 0.0
    # Whatever the gain, ways in proportion to the speed cost nothing more; one that is a fifth longer does.
    for gain in (1.0, 1.3):
        even = road.poses * [gain, gain, 1.0]
        off = [_prior(even, expected, recorded)[0] for recorded in (False, True)]
        assert off[1] - off[0] < 1e-3
        longer = even.copy()
        longer[20:, :2] += 0.2 * (even[20, :2] - even[19, :2])
        off = [_prior(longer, expected, recorded)[0] for recorded in (False, True)]
        assert off[1] - off[0] == pytest.approx(0.5 * (0.2 / BundleSettings().recorded_speed) ** 2, rel=0.05)


def test_the_slope_of_the_prior_of_a_recorded_speed():
    rng = _rng(1)
    road = tape_road(30)
    poses = road.poses + rng.normal(size=(30, 3)) * [0.2, 0.2, 0.01]
    expected = rng.uniform(0.7, 1.3, 30)
    slope = _prior(poses, expected, True)[1] - _prior(poses, expected, False)[1]
    height = fisheye().mounting.height_cm
    # The way in the middle of all is what the others are measured by, and taken as it is.
    ratio = np.diff(path_lengths(poses)) / expected[1:]
    middle = int(np.argsort(ratio)[len(ratio) // 2])
    frames = [k for k in range(2, 28) if k not in (middle, middle + 1)][::5]
    for frame, number in zip(frames, (0, 1, 2, 0, 1, 2), strict=False):
        step = np.zeros_like(poses)
        step[frame, number] = 1e-4 * (1.0 if number == 2 else height)
        ends = [
            _prior(poses + sign * step, expected, True)[0] - _prior(poses + sign * step, expected, False)[0]
            for sign in (1.0, -1.0)
        ]
        assert -slope[5 * frame + number] == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-3, abs=1e-3)


def test_the_gain_of_a_recorded_speed_is_left_to_the_pictures():
    camera, road = fisheye(), tape_road(60)
    observed = Observations(pixels(road, camera), speed_recorded=True)
    start = BundleEstimate.level(drifted(road.poses, 0.03, 0.0), camera)
    found = adjust(observed, start, SMALL, _rng(), free=())
    assert _error(found.poses, road.poses) < 1e-3
