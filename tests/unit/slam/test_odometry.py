"""Motion from picture to picture, on exact edges of a made-up road, with and without what does not move."""

from __future__ import annotations

import os

import numpy as np
import pytest
from pixel_road import fisheye, mirrored, pinhole, pixels
from tape_road import HEIGHT_CM, STEP_CM, TapeRoad, tape_road

from datagen.slam.odometry.image_pairs import SECTORS, ImagePairs, OdometrySettings, index_edges, turns_up_to
from datagen.slam.odometry.odometry import STEPS_HEIGHTS, Evidence, Odometry, best_step, typical_step
from lanenet.perception.edges.pixels import EdgePixels

SETTINGS = OdometrySettings()
STEP = STEP_CM / HEIGHT_CM


def _pictures(edges: list[EdgePixels], camera=None, seed: int = 0) -> ImagePairs:
    camera = fisheye() if camera is None else camera
    return ImagePairs(edges, camera, SETTINGS, np.random.default_rng(seed))


def _evidence(
    images: ImagePairs, distance_cm: np.ndarray, known: bool, far_rad: np.ndarray | None = None
) -> Evidence:
    return Evidence(images, typical_step(images, distance_cm, known), far_rad=far_rad)


@pytest.fixture(scope="module")
def road() -> TapeRoad:
    return tape_road(60)


@pytest.fixture(scope="module")
def edges(road) -> list[EdgePixels]:
    return pixels(road, fisheye())


def _true_turns(road: TapeRoad) -> np.ndarray:
    return np.diff(road.poses[:, 2], prepend=0.0)


def _with_a_lamp(edges: list[EdgePixels], points: int) -> list[EdgePixels]:
    """The same with a ring that stays where it is in the picture, as a lamp mirrored in the floor does."""
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    ring = [60.0, 90.0] + 14.0 * normal
    return [EdgePixels(np.concatenate([e.uv_px, ring]), np.concatenate([e.normals, -normal])) for e in edges]


def test_the_index_gives_the_nearest_edge_of_a_direction():
    rng = np.random.default_rng(3)
    uv, angle = rng.uniform(0.0, 39.0, (60, 2)), rng.uniform(0.0, 2.0 * np.pi, 60)
    sector = angle * SECTORS / (2.0 * np.pi)
    nearest = np.empty((SECTORS, 30, 40), np.int32)
    index_edges(uv, sector, nearest, np.empty(nearest.shape, np.float32))
    for s in range(SECTORS):
        off = np.abs((sector - s + 0.5 * SECTORS) % SECTORS - 0.5 * SECTORS)
        for v in range(0, 30, 3):
            for u in range(0, 40, 3):
                far = np.where(off < 1.0, np.hypot(*(uv - [u, v]).T), np.inf)
                found = nearest[s, v, u]
                if far.min() < 1.5:
                    assert far[found] == pytest.approx(far.min(), abs=1e-6)
                if found >= 0:
                    assert far[found] < 4.0


@pytest.mark.parametrize("camera", [fisheye(), pinhole()], ids=["fisheye", "pinhole"])
def test_a_pair_fits_best_at_its_true_motion(road, camera):
    pictures = _pictures(pixels(road, camera), camera)
    steps, turns = STEP * np.exp(0.06 * np.arange(-10, 11)), turns_up_to(0.12, pictures.turn_step_rad)
    off_step, off_turn = [], []
    for k in range(6, 60, 6):
        i, j = np.unravel_index(pictures.fit(k, steps, turns, np.ones(60)).argmax(), (21, len(turns)))
        off_step.append(np.log(steps[i] / STEP))
        off_turn.append(turns[j] - _true_turns(road)[k])
    # Half a cell of the grid is as well as it can tell; the turn changes between the frames of a pair.
    assert np.median(np.abs(off_step)) < 0.07
    assert np.median(np.abs(off_turn)) < 1.2 * pictures.turn_step_rad


def test_frames_are_compared_alike_whatever_was_compared_before(edges):
    pictures, steps = _pictures(edges), STEP * np.array([0.8, 1.0, 1.25])
    turns = turns_up_to(0.05, pictures.turn_step_rad)
    together = {k: pictures.fit(k, steps, turns, np.ones(60)) for k in (8, 30)}
    np.testing.assert_array_equal(_pictures(edges).fit(30, steps, turns, np.ones(60)), together[30])
    for k in (30, 30, 8, 30, 8):
        again = [pictures.fit(k, steps[i : i + 1], turns, np.ones(60))[0] for i in range(3)]
        np.testing.assert_array_equal(again, together[k])
    assert not np.array_equal(together[8], together[30])


def test_the_number_of_cores_changes_nothing(edges, monkeypatch):
    found = {}
    for cores in (1, 3):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        evidence = _evidence(_pictures(edges[:10]), np.ones(10), False)
        found[cores] = np.column_stack([evidence.motion().steps_cm, evidence.motion().turns_rad])
    np.testing.assert_array_equal(found[1], found[3])


def test_steps_with_turns_of_their_own_fit_as_they_do_alone(edges):
    pictures, steps = _pictures(edges), STEP * np.array([0.8, 1.25])
    turns = turns_up_to(0.05, pictures.turn_step_rad)
    own = np.stack([np.append(turns[1:], np.nan), turns])
    fit = pictures.fit(30, steps, own, np.ones(60))
    np.testing.assert_array_equal(fit[0, :-1], pictures.fit(30, steps[:1], turns[1:], np.ones(60))[0])
    np.testing.assert_array_equal(fit[1], pictures.fit(30, steps[1:], turns, np.ones(60))[0])
    assert fit[0, -1] == 0.0 < fit[0, :-1].max()


def test_steps_put_together_give_poses():
    ways, turns = np.array([0.0, 2.0, 2.0]), np.array([0.0, 0.0, np.pi / 2.0])
    poses = Odometry(ways, turns).poses
    half = np.sqrt(0.5)
    np.testing.assert_allclose(poses, [[0, 0, 0], [2, 0, 0], [2 + 2 * half, 2 * half, np.pi / 2]], atol=1e-12)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("lamp", [0, 60])
def test_way_and_turn_of_a_drive_are_found(road, edges, known, lamp):
    # The recorded speed is a quarter too high.
    distance_cm = np.full(60, 1.25 * STEP_CM if known else 1.0)
    pictures = _pictures(_with_a_lamp(edges, lamp))
    odometry = _evidence(pictures, distance_cm, known).motion()
    assert odometry.steps_cm[0] == odometry.turns_rad[0] == 0.0
    assert odometry.steps_cm[1:].sum() == pytest.approx(59 * STEP_CM, rel=0.02)
    np.testing.assert_allclose(odometry.steps_cm[5:], STEP_CM, rtol=0.15)
    assert np.abs(odometry.poses[:, 2] - road.poses[:, 2]).max() < np.deg2rad(3.0)


def _blurred(edges: list[EdgePixels], sigma_px: float, seed: int = 0) -> list[EdgePixels]:
    """The same with every edge found a little beside its place."""
    rng = np.random.default_rng(seed)
    return [
        EdgePixels(e.uv_px + rng.normal(0.0, sigma_px, (len(e.uv_px), 1)) * e.normals, e.normals)
        for e in edges
    ]


def test_a_slide_that_is_caught_is_followed(road):
    # Within a few frames the car swings round, and back again twice as quickly as it ever turns on the road.
    turns = _true_turns(road)
    turns[20:26] += np.array([0.04, 0.08, 0.12, 0.12, 0.08, 0.04])
    turns[28:34] -= np.array([0.04, 0.08, 0.12, 0.12, 0.08, 0.04])
    heading = np.cumsum(turns)
    middle = heading - 0.5 * turns
    steps = STEP_CM * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    steps[0] = 0.0
    poses = np.column_stack([np.cumsum(steps, axis=0), heading])
    slid = pixels(TapeRoad(road.points_cm, road.normals, poses), fisheye())
    odometry = _evidence(_pictures(_blurred(slid, 0.5)), np.ones(60), False).motion()
    assert np.abs(odometry.poses[:, 2] - heading).max() < np.deg2rad(8.0)
    assert odometry.turns_rad[28:34].min() < -0.05


def test_turns_that_the_distance_shows_are_followed_where_the_road_shows_nothing(road):
    # For a quarter of a second all is blurred, while the car swings round.
    turns = _true_turns(road)
    turns[25:30] += 0.1
    heading = np.cumsum(turns)
    middle = heading - 0.5 * turns
    steps = STEP_CM * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    steps[0] = 0.0
    poses = np.column_stack([np.cumsum(steps, axis=0), heading])
    edges = pixels(TapeRoad(road.points_cm, road.normals, poses), fisheye())
    edges = [e if not 23 <= k < 31 else EdgePixels(e.uv_px[:3], e.normals[:3]) for k, e in enumerate(edges)]
    far = 0.8 * turns + np.random.default_rng(0).normal(0.0, 0.003, 60)
    far[0] = np.nan
    without, with_far = (
        _evidence(_pictures(edges), np.ones(60), False, seen).motion() for seen in (None, far)
    )
    off = [np.abs(o.poses[:, 2] - heading).max() for o in (without, with_far)]
    assert off[0] > np.deg2rad(15.0)
    assert off[1] < np.deg2rad(5.0)


def test_a_distance_that_shows_something_else_changes_nothing(edges):
    far = np.random.default_rng(1).normal(0.0, 0.05, 60)
    plain, other = (_evidence(_pictures(edges), np.ones(60), False, seen).motion() for seen in (None, far))
    np.testing.assert_array_equal(other.poses, plain.poses)


def test_pictures_that_are_further_apart_meet_where_the_turns_between_them_are_known(road):
    turns = np.where(np.arange(60) % 12 < 6, 0.06, -0.03)
    middle = np.cumsum(turns) - 0.5 * turns
    xy = np.cumsum(STEP_CM * np.stack([np.cos(middle), np.sin(middle)], axis=1), axis=0)
    swerving = TapeRoad(road.points_cm, road.normals, np.column_stack([xy, np.cumsum(turns)]))
    pictures = _pictures(pixels(swerving, fisheye()))
    # Frame 25 turns to the left, as the one before it does; the two before those turn to the right.
    tried = turns_up_to(0.12, pictures.turn_step_rad)
    alike, known = (
        pictures.fit(25, np.array([STEP]), tried, np.ones(60), (4,), usual)[0] for usual in (None, turns)
    )
    assert abs(tried[alike.argmax()] - turns[25]) > 0.03
    assert tried[known.argmax()] == pytest.approx(turns[25], abs=pictures.turn_step_rad)


def test_no_point_gains_by_leaving_the_view_of_blurred_pictures(edges):
    steps, turns = np.array([STEP]), np.array([0.0, 0.5])
    for sigma_px in (0.0, 1.5, 3.0):
        pictures = _pictures(_blurred(edges, sigma_px))
        for k in range(6, 60, 6):
            true, away = pictures.fit(k, steps, turns, np.ones(60))[0]
            assert away < true


def test_a_mirrored_drive_turns_the_other_way(road, edges):
    flipped = pixels(road.mirrored(), mirrored(fisheye()))
    plain, other = (
        _evidence(_pictures(e, camera), np.ones(60), False).motion()
        for e, camera in ((edges, fisheye()), (flipped, mirrored(fisheye())))
    )
    np.testing.assert_allclose(other.poses[-1], plain.poses[-1] * [1.0, -1.0, -1.0], atol=6.0)
    assert np.sign(plain.turns_rad.sum()) == -np.sign(other.turns_rad.sum())


def test_the_typical_step_is_that_of_the_road_not_of_what_stands_still(edges):
    steps = np.array(STEPS_HEIGHTS)
    for lamp in (0, 60):
        step, fit = best_step(_pictures(_with_a_lamp(edges, lamp)), np.ones(60), steps)
        assert step == pytest.approx(STEP, rel=0.03)
        assert fit.shape == steps.shape


@pytest.mark.parametrize(("off", "lamp"), [(0.25, 60), (4.0, 0), (10.0, 60), (100.0, 0)])
def test_a_recorded_speed_that_is_far_off_gives_the_right_way(edges, off, lamp):
    pictures = _pictures(_with_a_lamp(edges, lamp))
    usual = typical_step(pictures, np.full(60, off * STEP_CM), True)
    assert usual.step_heights == pytest.approx(STEP, rel=0.03)
    assert usual.factor == pytest.approx(1.0 / off, rel=0.03)


def test_a_speed_in_the_wrong_unit_asks_for_no_more_turns_than_a_fast_car_makes():
    # Without edges nothing contradicts it.
    nothing = [EdgePixels(np.empty((0, 2)), np.empty((0, 2)))] * 30
    pictures = _pictures(nothing)
    evidence = _evidence(pictures, np.full(30, 100.0 * STEP_CM), True)
    assert evidence.grid.typical == pytest.approx(100.0 * STEP)
    most = 1.3 * SETTINGS.max_curvature_heights * STEPS_HEIGHTS[-1]
    assert evidence.grid.turns_rad[-1] == pytest.approx(most, abs=pictures.turn_step_rad)


def test_a_long_frame_takes_a_long_way(road):
    kept = np.r_[0:30, 32:60]
    thinned = pixels(TapeRoad(road.points_cm, road.normals, road.poses[kept]), fisheye())
    distance = np.ones(58)
    distance[30] = 3.0
    odometry = _evidence(_pictures(thinned), distance, False).motion()
    assert odometry.steps_cm[30] == pytest.approx(3.0 * STEP_CM, rel=0.1)
    assert odometry.steps_cm[29] == pytest.approx(STEP_CM, rel=0.1)


def test_pictures_without_edges_leave_it_to_the_commands():
    nothing = [EdgePixels(np.empty((0, 2)), np.empty((0, 2)))] * 30
    odometry = _evidence(_pictures(nothing), np.full(30, 4.0), True).motion(np.full(30, 0.01))
    assert odometry.turns_rad[15] > 0.0
    np.testing.assert_allclose(odometry.turns_rad[5:25] / odometry.steps_cm[5:25], 0.01, rtol=0.2)


def test_points_are_drawn_from_every_direction_alike():
    # A road of nothing but lines ahead, and one short edge across it.
    v = np.repeat(np.arange(60.0, 118.0, 0.5), 2)
    lines = np.column_stack([np.where(np.arange(len(v)) % 2, 40.0, 120.0), v])
    across = np.column_stack([np.arange(70.0, 82.0, 0.5), np.full(24, 90.0)])
    uv = np.concatenate([lines, across])
    normals = np.concatenate([np.tile([1.0, 0.0], (len(lines), 1)), np.tile([0.0, 1.0], (24, 1))])
    pictures = _pictures([EdgePixels(uv, normals)])
    sector = pictures._images[0].sector
    assert (sector == SECTORS // 4).sum() >= SETTINGS.points // 4


def test_half_precision_follows_the_same_motion_in_half_the_memory(edges, monkeypatch):
    evidence = _evidence(_pictures(edges), np.ones(60), False)
    kept = evidence.motion()
    assert evidence.log_likelihood.nbytes == 2 * 60 * np.prod(evidence.grid.shape)

    def in_full(fits, temper):
        return temper * (fits.astype(np.float64) - fits.max(axis=(1, 2), keepdims=True))

    monkeypatch.setattr("datagen.slam.odometry.odometry._likelihood", in_full)
    full = _evidence(_pictures(edges), np.ones(60), False).motion()
    np.testing.assert_allclose(kept.steps_cm[1:], full.steps_cm[1:], rtol=2e-3)
    np.testing.assert_allclose(kept.turns_rad[1:], full.turns_rad[1:], atol=1e-4)
