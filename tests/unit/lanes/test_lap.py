"""One lap out of a drive of several, in both directions; lanes of frames; the splines under it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lane_edges import arc_path

from datagen.lanes.offset import CubicBasis, adapted_breaks
from datagen.lanes.path import edges_along_path, positions_on_path, shared_path
from datagen.slam.odometry.scans import pack_scans
from lanenet.data.maps.frame_lines import assign_lanes
from lanenet.data.maps.line import LaneLine, Side
from lanenet.geometry.frames import car_from_map
from lanenet.perception.edges.road import RoadEdges

HEIGHT_CM, WHEELBASE_CM = 15.0, 17.0
LONG_CM, SHORT_CM = 150.0, 90.0


def _oval(phase: np.ndarray, offset_cm: np.ndarray) -> np.ndarray:
    """Poses on an oval, offset to the left of it."""
    x, y = LONG_CM * np.cos(phase), SHORT_CM * np.sin(phase)
    dx, dy = -LONG_CM * np.sin(phase), SHORT_CM * np.cos(phase)
    heading = np.unwrap(np.arctan2(dy, dx))
    return np.column_stack([x - offset_cm * np.sin(heading), y + offset_cm * np.cos(heading), heading])


def _laps(laps: float, wander_cm: float = 4.0, seed: int = 0) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """A drive of some laps, and pairs of frames at the same place one lap apart."""
    rng = np.random.default_rng(seed)
    per_lap = 260
    phase = 2.0 * np.pi * np.arange(int(laps * per_lap)) / per_lap
    poses = _oval(phase, wander_cm * np.sin(phase / 1.7 + rng.uniform(0.0, 6.0)))
    return poses, [(k, k + per_lap) for k in range(0, len(poses) - per_lap, 25)]


def _one_part(poses: np.ndarray) -> np.ndarray:
    return np.zeros(len(poses), np.int64)


@pytest.mark.parametrize("laps", [1.3, 2.6])
def test_a_lap_closes_and_every_frame_has_its_place(laps):
    poses, pairs = _laps(laps)
    path = shared_path(poses, _one_part(poses), pairs, 1.8, 75.0, HEIGHT_CM)
    assert path is not None and path.closed and path.period_cm is not None
    steps = np.linalg.norm(np.diff(path.xy_cm, axis=0, append=path.xy_cm[:1]), axis=1)
    np.testing.assert_allclose(steps, path.step_cm, rtol=0.03)
    np.testing.assert_allclose(np.linalg.norm(path.left, axis=1), 1.0)
    # Around the seam as smooth as elsewhere.
    before = np.roll(path.left, 1, axis=0)
    turn = np.abs(before[:, 0] * path.left[:, 1] - before[:, 1] * path.left[:, 0])
    assert turn.max() < 0.06
    assert path.forward is not None and path.forward.all()
    assert path.d_frames_cm is not None
    nearest = np.linalg.norm(poses[:, None, :2] - path.xy_cm[None], axis=2).min(axis=1)
    np.testing.assert_allclose(np.abs(path.d_frames_cm), nearest, atol=0.9)
    assert np.abs(path.d_frames_cm).max() < 9.0
    # One lap later the same place comes again.
    gone = np.mod(path.s_frames_cm[260:] - path.s_frames_cm[:-260] + 20.0, path.period_cm) - 20.0
    assert np.abs(gone).max() < 3.0


def test_a_lap_is_put_together_from_parts_that_hold_none():
    poses, _ = _laps(2.6)
    # Two thirds of a lap, and as much of the next one from its middle on.
    rows = np.r_[0:170, 390:620]
    part = np.repeat([0, 1], [170, 230])
    path = shared_path(poses[rows], part, [], 1.8, 75.0, HEIGHT_CM)
    assert path is not None and path.period_cm is not None and path.d_frames_cm is not None
    whole = shared_path(poses, _one_part(poses), _laps(2.6)[1], 1.8, 75.0, HEIGHT_CM)
    assert whole is not None and path.period_cm == pytest.approx(whole.period_cm, rel=0.03)
    assert np.abs(path.d_frames_cm).max() < 9.0


def test_an_open_road_is_put_together_from_parts_that_overlap():
    x = np.arange(0.0, 600.0, 3.0)
    poses = np.column_stack([x, 20.0 * np.sin(x / 90.0), np.arctan(20.0 / 90.0 * np.cos(x / 90.0))])
    # The car was put back, and drove on from the middle of what it knew.
    rows = np.r_[0:120, 80:200]
    path = shared_path(poses[rows], np.repeat([0, 1], 120), [], 1.8, 75.0, HEIGHT_CM)
    assert path is not None and not path.closed and path.d_frames_cm is not None
    assert np.abs(path.d_frames_cm).max() < 3.0
    # Both visits of a place are at the same position along it.
    np.testing.assert_allclose(path.s_frames_cm[120:160], path.s_frames_cm[80:120], atol=1.0)
    assert path.s_frames_cm.max() == pytest.approx(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum(), rel=0.02)


def test_frames_of_the_other_direction_are_told():
    poses, pairs = _laps(2.0)
    back = poses[::-1][:200] + [0.0, 0.0, np.pi]
    both = np.concatenate([poses, back])
    path = shared_path(both, _one_part(both), pairs, 1.8, 75.0, HEIGHT_CM)
    assert path is not None and path.forward is not None
    assert path.forward[: len(poses)].all() and not path.forward[len(poses) :].any()
    np.testing.assert_allclose(
        path.s_frames_cm[len(poses) :], path.s_frames_cm[: len(poses)][::-1][:200], atol=1.0
    )


def test_roads_that_cross_are_told_apart_by_heading():
    phase = 2.0 * np.pi * np.arange(600) / 400
    x, y = 200.0 * np.sin(phase), 100.0 * np.sin(2.0 * phase)
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    poses = np.column_stack([x, y, heading])
    path = shared_path(
        poses, _one_part(poses), [(k, k + 400) for k in range(5, 195, 20)], 1.8, 75.0, HEIGHT_CM
    )
    assert path is not None and path.period_cm is not None
    steps = np.mod(np.diff(path.s_frames_cm) + 100.0, path.period_cm) - 100.0
    assert steps.min() > 0.0 and steps.max() < 6.0


def test_without_revisits_or_on_another_road_there_is_no_lap():
    poses, pairs = _laps(2.0)
    assert shared_path(poses, _one_part(poses), [], 1.8, 75.0, HEIGHT_CM) is None
    away = np.concatenate(
        [poses, np.column_stack([np.linspace(200.0, 900.0, 300), np.full((300, 2), 500.0)])]
    )
    assert shared_path(away, _one_part(away), pairs, 1.8, 75.0, HEIGHT_CM) is None


@settings(max_examples=15, deadline=None)
@given(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-3.0, 3.0))
def test_moving_the_map_moves_the_lap(x, y, turn):
    poses, pairs = _laps(1.5)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    moved = np.column_stack([poses[:, :2] @ rotation.T + [x, y], poses[:, 2] + turn])
    here, there = (
        shared_path(poses, _one_part(poses), pairs, 1.8, 75.0, HEIGHT_CM),
        shared_path(moved, _one_part(moved), pairs, 1.8, 75.0, HEIGHT_CM),
    )
    assert here is not None and there is not None
    np.testing.assert_allclose(there.xy_cm, here.xy_cm @ rotation.T + [x, y], atol=1e-6)
    np.testing.assert_allclose(there.s_frames_cm, here.s_frames_cm, atol=1e-5)


@pytest.mark.parametrize("forward", [True, False])
def test_edges_of_all_laps_and_directions_lie_on_one_another(forward):
    poses, pairs = _laps(2.2)
    path = shared_path(poses, _one_part(poses), pairs, 1.8, 75.0, HEIGHT_CM)
    assert path is not None and path.period_cm is not None
    rng = np.random.default_rng(1)
    truth, scans = [], []
    turned = poses if forward else poses + [0.0, 0.0, np.pi]
    s_frames, _, found = positions_on_path(path, turned, _one_part(turned))
    assert (found == forward).all()
    placed = type(path)(path.step_cm, path.xy_cm, path.left, s_frames, None, found, closed=True)
    for pose in turned:
        ahead = rng.uniform(20.0, 45.0)
        far = pose[:2] + ahead * np.array([np.cos(pose[2]), np.sin(pose[2])])
        i = int(np.argmin(np.linalg.norm(path.xy_cm - far, axis=1)))
        point = path.xy_cm[i] + 15.0 * path.left[i]
        truth.append(i * path.step_cm)
        normal = path.left[i]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        in_car = np.array([[normal[0] * s - normal[1] * c, normal[0] * c + normal[1] * s]])
        scans.append(RoadEdges(car_from_map(point[None], pose, WHEELBASE_CM), in_car))
    edges = edges_along_path(placed, pack_scans(scans, HEIGHT_CM), turned, WHEELBASE_CM, 60.0)
    assert len(edges.s_cm) == len(poses)
    missed = np.mod(edges.s_cm - truth + 50.0, path.period_cm) - 50.0
    assert np.abs(missed).max() < 1.0
    np.testing.assert_allclose(edges.d_cm, 15.0, atol=0.05)
    np.testing.assert_allclose(edges.side, 1.0, atol=0.01)
    np.testing.assert_allclose(edges.along, 0.0, atol=0.1)


def _straight_lines(offsets_cm: dict[int, float], until_cm: float = 600.0) -> list[LaneLine]:
    basis = CubicBasis(np.linspace(0.0, 600.0, 31), periodic=False)
    knots = basis.knots_cm
    s = np.array([knots[i + 1 : i + 4].mean() for i in range(len(knots) - 4)])
    lines = []
    for index, y in offsets_cm.items():
        side: Side = "left" if index <= 0 else "right"
        rank = -index if index <= 0 else index - 1
        end = until_cm if rank else 600.0
        control = np.column_stack([s, np.full_like(s, y)])
        lines.append(LaneLine(side, knots, control, np.array([[0.0, end]]), 0.1, rank))
    return lines


TWO_LANES = {-1: 54.0, 0: 18.0, 1: -18.0}


def _drive(y_cm: np.ndarray, heading_rad: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    s = np.linspace(20.0, 500.0, len(y_cm))
    return np.column_stack([s, y_cm, np.full(len(y_cm), heading_rad)]), s


def test_a_lane_change_and_back():
    y = np.concatenate(
        [np.zeros(30), np.linspace(0.0, 36.0, 20), np.full(30, 36.0), np.linspace(36.0, 0.0, 20)]
    )
    poses, s = _drive(y)
    found = assign_lanes(_straight_lines(TWO_LANES), poses, s, WHEELBASE_CM)
    assert found.forward.all()
    # The line is at 18 cm; a twentieth of a lane beyond it the car is in the other lane, back likewise.
    going = slice(0, 80)
    np.testing.assert_array_equal(found.lane[going], np.where(y[going] > 18.0 + 1.8, -1, 0))
    np.testing.assert_array_equal(found.lane[80:], np.where(y[80:] < 18.0 - 1.8, 0, -1))
    # Close to the line on either side, the lane is ambiguous.
    np.testing.assert_array_equal(found.between, np.abs(y - 18.0) < 1.8)
    # It is the left line of the one lane and the right line of the other.
    np.testing.assert_array_equal(found.divides, np.stack([found.lane == 0, found.lane == -1], axis=1))


def test_straddling_a_line_does_not_flicker():
    poses, s = _drive(18.0 + 1.5 * np.sin(np.arange(100.0)))
    found = assign_lanes(_straight_lines(TWO_LANES), poses, s, WHEELBASE_CM)
    assert not found.lane.any() and found.between.all()


@pytest.mark.parametrize(("reach", "changes"), [(0.15, False), (0.4, True)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_swerve_across_a_line_is_no_lane_change(reach, changes, side):
    lines = _straight_lines(TWO_LANES)
    # From the middle of a lane to a share of the other one's width beyond the line between them, and back.
    start = 18.0 - 18.0 * side
    y = start + side * (18.0 + 36.0 * reach) * np.sin(np.linspace(0.0, np.pi, 60))
    poses, s = _drive(y)
    home, away = (0, -1) if side > 0.0 else (-1, 0)
    found = assign_lanes(lines, poses, s, WHEELBASE_CM)
    lane = found.lane
    assert lane[0] == home and lane[-1] == home
    assert (away in lane) == changes
    # Frames of a swerve have the lane of before, and are not clearly in it.
    beyond = side * (y - 18.0) > 0.0
    assert beyond.any() and (found.between | (lane == np.where(beyond, away, home))).all()


def test_beyond_the_outer_line_the_car_keeps_its_lane():
    poses, s = _drive(np.linspace(0.0, -30.0, 50))
    found = assign_lanes(_straight_lines(TWO_LANES), poses, s, WHEELBASE_CM)
    assert not found.lane.any() and not found.between.any() and not found.away.any()
    # Where the further line is not known there is no lane to change to.
    poses, s = _drive(np.full(50, 36.0))
    gone = assign_lanes(_straight_lines(TWO_LANES, until_cm=5.0), poses, s, WHEELBASE_CM)
    assert not gone.lane.any()


def test_far_beyond_a_solid_line_the_car_is_in_no_lane_until_it_comes_back():
    # Beyond the right line once by a third of a lane, once by half of one.
    y = np.interp(np.arange(90), [0, 10, 20, 30, 40, 60, 89], [0.0, -30.0, 0.0, 0.0, -36.0, -36.0, 0.0])
    poses, s = _drive(y)
    found = assign_lanes(_straight_lines(TWO_LANES), poses, s, WHEELBASE_CM)
    assert not found.lane.any()
    np.testing.assert_array_equal(found.away, (y < -18.0) & (np.arange(90) > 25))
    assert not found.between.any()


@pytest.mark.parametrize("offsets", [TWO_LANES, {0: 18.0, 1: -18.0}])
@pytest.mark.parametrize("start_cm", [0.0, 36.0])
def test_behind_dashes_there_is_a_lane_whether_its_far_line_is_known_or_not(offsets, start_cm):
    lines = _straight_lines(offsets, until_cm=5.0)
    dashed = [replace(line, unpainted=0.4) if line.index == 0 else line for line in lines]
    poses, s = _drive(np.concatenate([np.full(20, start_cm), np.full(20, 36.0), np.full(20, 0.0)]))
    lane = assign_lanes(dashed, poses, s, WHEELBASE_CM).lane
    np.testing.assert_array_equal(lane, np.where(poses[:, 1] > 18.0, -1, 0))
    solid = [replace(line, unpainted=0.05) for line in lines]
    assert not assign_lanes(solid, poses, s, WHEELBASE_CM).lane.any()


def test_swerves_from_a_lane_whose_far_line_is_unknown():
    lines = [
        replace(line, unpainted=0.4 * (line.index == 0)) for line in _straight_lines({0: 18.0, 1: -18.0})
    ]
    y = np.repeat([36.0, 14.0, 36.0, 0.0], 20)
    poses, s = _drive(y)
    lane = assign_lanes(lines, poses, s, WHEELBASE_CM).lane
    np.testing.assert_array_equal(lane, np.where(y > 0.0, -1, 0))


def test_a_line_is_between_two_lanes_only_where_there_are_two():
    lines = _straight_lines(TWO_LANES)
    # The far line of the other lane comes so near in the second half that there is no lane before it.
    lines = [_bent_in(line) if line.index == -1 else line for line in lines]
    poses, s = _drive(np.full(60, 17.0))
    found = assign_lanes(lines, poses, s, WHEELBASE_CM)
    assert found.between[:20].all() and not found.between[-20:].any()
    assert found.divides[:20, 0].all() and not found.divides[-20:].any() and not found.divides[:, 1].any()


def _bent_in(line: LaneLine) -> LaneLine:
    s_cm, y_cm = line.coefficients_cm.T
    return replace(line, coefficients_cm=np.column_stack([s_cm, np.where(s_cm > 260.0, 30.0, y_cm)]))


def test_dashes_on_the_right_have_a_lane_behind_them_too():
    lines = [replace(line, unpainted=0.3 * line.index) for line in _straight_lines({0: 18.0, 1: -18.0})]
    poses, s = _drive(np.concatenate([np.zeros(20), np.full(20, -36.0), np.zeros(20), np.full(20, 36.0)]))
    lane = assign_lanes(lines, poses, s, WHEELBASE_CM).lane
    np.testing.assert_array_equal(lane, np.where(poses[:, 1] < -18.0, 1, 0))


def test_the_other_way_in_the_other_lane():
    poses, s = _drive(np.full(40, 36.0), np.pi)
    found = assign_lanes(_straight_lines(TWO_LANES), poses, s, WHEELBASE_CM)
    assert not found.forward.any()
    assert (found.lane == -1).all()
    # Against the path's direction the driven lane's line is on the left again.
    assert found.divides[:, 0].all() and not found.divides[:, 1].any()


def test_a_single_lane_is_the_lane():
    poses, s = _drive(np.full(40, 50.0), 0.3)
    found = assign_lanes(_straight_lines({0: 18.0, 1: -18.0}), poses, s, WHEELBASE_CM)
    assert not found.lane.any() and found.forward.all()


@pytest.mark.parametrize("periodic", [True, False])
def test_splines_reproduce_what_they_can(periodic):
    breaks = np.concatenate([np.linspace(0.0, 100.0, 11), [103.0, 108.0, 130.0]])
    basis = CubicBasis(breaks, periodic)
    assert len(basis.unfolded(np.zeros(basis.size))) == len(basis.knots_cm) - 4
    s = np.linspace(0.0, 130.0, 400)
    values = np.sin(2.0 * np.pi * s / 130.0) if periodic else (s / 50.0 - 1.0) ** 3 - s / 40.0
    design = basis.design(s).toarray()
    np.testing.assert_allclose(design.sum(axis=1), 1.0)
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
    np.testing.assert_allclose(design @ coefficients, values, atol=2e-3 if periodic else 1e-9)
    step = 1e-4
    inner = s[5:-5] + 0.013
    for derivative in (1, 2):
        difference = (
            basis.design(inner + step, derivative - 1) - basis.design(inner - step, derivative - 1)
        ) @ coefficients
        np.testing.assert_allclose(
            basis.design(inner, derivative) @ coefficients, difference / (2.0 * step), atol=1e-5
        )


def test_breaks_are_denser_in_bends():
    curvature = np.zeros(200)
    curvature[80:120] = 1.0 / 20.0
    breaks = adapted_breaks(curvature, 1.0, 15.0, 5.0)
    assert breaks[0] == 0.0 and breaks[-1] == pytest.approx(200.0)
    spacing = np.diff(breaks)
    middle = 0.5 * (breaks[1:] + breaks[:-1])
    np.testing.assert_allclose(spacing[(middle > 85) & (middle < 115)], 5.0, rtol=0.15)
    np.testing.assert_allclose(spacing[middle < 60], 15.0, rtol=0.15)


def test_an_open_path_is_not_a_lap():
    assert arc_path(None).period_cm is None


def test_the_path_of_a_point_ahead_of_the_axle_does_not_cut_corners():
    """On a circle of radius r, a point that far ahead runs around on the hypotenuse."""
    angle = 2.0 * np.pi * np.arange(400) / 160
    radius, lead = 50.0, 30.0
    poses = np.column_stack([radius * np.sin(angle), -radius * np.cos(angle), angle])
    pairs = [(k, k + 160) for k in range(0, 240, 20)]
    for lead_cm, expected in ((0.0, radius), (lead, np.hypot(radius, lead))):
        path = shared_path(poses, _one_part(poses), pairs, 1.8, 75.0, HEIGHT_CM, lead_cm)
        assert path is not None and path.closed and path.d_frames_cm is not None
        np.testing.assert_allclose(np.hypot(*path.xy_cm.T), expected, rtol=0.02)
        # Frames have the places of their rear axles, to the left of it.
        np.testing.assert_allclose(path.d_frames_cm, expected - radius, atol=1.0)
