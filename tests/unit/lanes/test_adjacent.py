"""A road of two lanes with dashes between them, and a driver who sometimes drives in the other one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lane_edges import FRAME_CM, joined, paint, ring_path, speckle

from datagen.lanes.fit import FitSettings, fit_lines
from datagen.lanes.path import Path, PathEdges
from datagen.lanes.trace import TraceSettings, trace_adjacent, trace_lane
from lanenet.data.maps.frame_lines import FrameLanes, FrameLines, assign_lanes, lines_of_frame
from lanenet.data.maps.line import LaneLine
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import ROWS_CM

HEIGHT_CM, WHEELBASE_CM, LANE_CM = 15.0, 17.0, 36.0
RADIUS_CM = 150.0
#: Offsets of the lines from the middle of the driver's own lane, which is the path.
RIGHT_CM, MIDDLE_CM, FAR_CM = -18.0, 18.0, 54.0
#: Where the driver leaves for the other lane, and where he is back, along the lap.
LEAVES_CM, BACK_CM = 300.0, 460.0
#: How far along the lap the far line is seen: from the other lane alone.
SEEN_CM = (310.0, 480.0)


def _driven(forward: bool, visits: bool = True) -> tuple[Path, np.ndarray]:
    """Two laps on a ring, left round or right round, and the poses; each lap once into the other lane."""
    path = ring_path(RADIUS_CM)
    s = path.s_frames_cm if forward else path.s_frames_cm[::-1]
    into = np.clip((s - LEAVES_CM) / 50.0, 0.0, 1.0) * np.clip((BACK_CM - s) / 50.0, 0.0, 1.0)
    d = 30.0 * into * into * (3.0 - 2.0 * into) * visits
    path = replace(path, s_frames_cm=s, d_frames_cm=d, forward=np.full(len(s), forward))
    angle = s / RADIUS_CM
    xy = (RADIUS_CM - d)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    turn = 0.5 * np.pi if forward else -0.5 * np.pi
    return path, np.column_stack([xy, angle + turn])


def _edges(path: Path, dashed: bool = True, far: bool = True) -> PathEdges:
    rng = np.random.default_rng(0)
    everywhere = np.ones(len(path.xy_cm), dtype=bool)
    lines = {RIGHT_CM: everywhere, MIDDLE_CM: np.mod(path.s_cm, 30.0) < 18.0 if dashed else everywhere}
    if far:
        lines[FAR_CM] = (path.s_cm > SEEN_CM[0]) & (path.s_cm < SEEN_CM[1])
    # Three times, as densely as a frame shows a line.
    parts = [
        paint(rng, path, np.full(len(path.xy_cm), d), seen) for d, seen in lines.items() for _ in range(3)
    ]
    return joined(*parts, speckle(rng, path, 300))


def _lines(path: Path, edges: PathEdges) -> list[LaneLine]:
    settings = TraceSettings()
    lane = trace_lane(path, edges, HEIGHT_CM, LANE_CM, settings)
    lane = trace_adjacent(path, edges, lane, HEIGHT_CM, settings)
    return fit_lines(path, edges, lane, HEIGHT_CM, FitSettings(), edges)


def _frame(lines: list[LaneLine], path: Path, poses: np.ndarray, lanes: FrameLanes, k: int) -> FrameLines:
    s_cm, lane, forward = float(path.s_frames_cm[k]), int(lanes.lane[k]), bool(lanes.forward[k])
    return lines_of_frame(lines, poses[k], s_cm, WHEELBASE_CM, lane, forward)


def _true_rows(pose: np.ndarray, offset_cm: float) -> np.ndarray:
    """Where the ring that a line is crosses the label rows."""
    x, y = car_from_map(np.zeros((1, 2)), pose, WHEELBASE_CM)[0]
    return x - np.sign(x) * np.sqrt((RADIUS_CM - offset_cm) ** 2 - (np.array(ROWS_CM) - y) ** 2)


def _depth_cm(poses: np.ndarray) -> np.ndarray:
    """How far the front axle's middle is beyond the line in the middle of the road."""
    ahead = np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    front = poses[:, :2] + WHEELBASE_CM * ahead
    return RADIUS_CM - MIDDLE_CM - np.linalg.norm(front, axis=1)


def _check(frames: list[FrameLines], poses: np.ndarray, bounds_cm: tuple[float, float]) -> np.ndarray:
    """Compare labels with what bounds the lane on the left and on the right; return which there are."""
    truth = np.array([np.concatenate([_true_rows(pose, d) for d in bounds_cm]) for pose in poses])
    error = np.array([frame.points_cm for frame in frames]) - truth
    assert np.nanmax(np.abs(error)) < 1.0
    return np.isfinite(error)


def _checked(
    lines: list[LaneLine], forward: bool, path: Path, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Check the lane of all frames and labels of some; return which are known, of far line and dashes."""
    lanes = assign_lanes(lines, poses, path.s_frames_cm, WHEELBASE_CM)
    assert (lanes.forward == forward).all()
    depth = _depth_cm(poses)
    away, home = np.flatnonzero(depth > 4.0), np.flatnonzero(depth < -4.0)
    assert len(away) * FRAME_CM > 4.0 * LANE_CM
    assert (lanes.lane[away] == -1).all() and (lanes.lane[home] == 0).all()
    known = []
    for rows, bounds in ((home[::8], (MIDDLE_CM, RIGHT_CM)), (away[::4], (FAR_CM, MIDDLE_CM))):
        frames = [_frame(lines, path, poses, lanes, k) for k in rows]
        known.append(_check(frames, poses[rows], bounds if forward else bounds[::-1]))
    assert known[0].mean() > 0.98
    far, middle = (known[1][:, :3], known[1][:, 3:]) if forward else (known[1][:, 3:], known[1][:, :3])
    return far, middle


@pytest.mark.parametrize("forward", [True, False])
def test_labels_name_the_lane_that_the_driver_is_in(forward):
    path, poses = _driven(forward)
    lines = _lines(path, _edges(path))
    assert {line.index: line.dashed for line in lines} == {-1: False, 0: True, 1: False}
    far, middle = _checked(lines, forward, path, poses)
    assert middle.mean() > 0.98 and far.mean() > 0.75


@pytest.mark.parametrize("forward", [True, False])
def test_a_far_line_that_is_not_painted_is_masked(forward):
    path, poses = _driven(forward)
    lines = _lines(path, _edges(path, far=False))
    assert [line.index for line in lines] == [0, 1]
    far, middle = _checked(lines, forward, path, poses)
    assert not far.any() and middle.mean() > 0.98


def test_beyond_a_solid_line_with_nothing_behind_it_the_car_is_beside_its_lane():
    path, poses = _driven(True)
    lines = _lines(path, _edges(path, dashed=False, far=False))
    assert not lines[0].dashed
    lanes = assign_lanes(lines, poses, path.s_frames_cm, WHEELBASE_CM)
    assert not lanes.lane.any()
    rows = np.arange(0, len(poses), 8)
    frames = [_frame(lines, path, poses, lanes, k) for k in rows]
    assert _check(frames, poses[rows], (MIDDLE_CM, RIGHT_CM)).mean() > 0.98


def test_a_short_piece_of_line_where_nobody_drives_is_no_lane():
    path, _ = _driven(True, visits=False)
    assert [line.index for line in _lines(path, _edges(path))] == [0, 1]


def test_what_is_seen_elsewhere_is_no_line_of_the_lane_that_is_visited():
    """The driver is in the other lane, but what lies along the road is seen half a lap further."""
    path, _ = _driven(True)
    moved = replace(path, s_frames_cm=np.mod(path.s_frames_cm + 470.0, path.period_cm))
    assert [line.index for line in _lines(moved, _edges(path))] == [0, 1]
