"""Which lane each frame is in: between which two lines, and in which direction it drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.maps.line import LaneLine
from lanenet.data.segments import equal_runs, true_runs
from lanenet.geometry.lane import BESIDE_DIVIDER_LANES

#: How far it gets into the next lane at least, in lane widths, where it does not just swerve.
_ENTERED = 0.2
#: How far beyond a line of the lane nobody gets who means to stay in it, in lane widths.
_AWAY = 0.35
#: Widths of a lane beside the driven one, relative to it; wider or narrower is a lay-by or a double line.
_WIDTHS = (0.6, 1.5)


@dataclass(frozen=True)
class FrameLanes:
    """The lane of each frame.

    Attributes:
        lane: Index of the line on the left of the lane, seen in the path's direction: 0 for the driven lane,
            -1 for the one to its left, 1 for the one to its right.
        forward: Whether the frame drives in the path's direction.
        between: Frames on the line between two lanes, or beyond it in a swerve: which lane is meant cannot be
            told from the picture.
        away: Frames so far beside the lane, or on the way there and back, that they may be in a lane of which
            nothing is known.
        divides: Whether there is another lane beyond the left, beyond the right line of the frame's lane, in
            its direction of travel.
    """

    lane: Int[np.ndarray, "n"]
    forward: Bool[np.ndarray, "n"]
    between: Bool[np.ndarray, "n"]
    away: Bool[np.ndarray, "n"]
    divides: Bool[np.ndarray, "n 2"]


def assign_lanes(
    lines: list[LaneLine], poses: Float[np.ndarray, "n 3"], s_cm: Float[np.ndarray, "n"], wheelbase_cm: float
) -> FrameLanes:
    """Find the lane of each frame of a segment, in the order in which they were driven.

    The lane is the one in which the middle of the front axle is; it changes when that is clearly beyond a
    line that has a lane behind it: one of which the far line is seen there, or any behind dashes. Beside the
    road the car keeps the lane that it left, and so it does where it comes back before it is well inside the
    other one. On such a line and close beside it a frame is between two lanes. Where it gets so far beside
    the road that it may well be in a lane of which nothing is known (it crossed a solid line, and the far
    line is in no frame), it is in no lane until it comes back.

    Args:
        lines: Lines of the segment.
        poses: Rear-axle poses, frame map.
        s_cm: Position of the rear axles along the path.
        wheelbase_cm: Distance between the axles.
    """
    by_index = {line.index: line for line in lines}
    n = len(s_cm)
    direction = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
    tangent = sum(by_index[i].everywhere(s_cm, 1) for i in (0, 1))
    forward = np.sum(direction * tangent, axis=1) >= 0.0
    front = poses[:, :2] + wheelbase_cm * direction
    s_front = s_cm + np.where(forward, wheelbase_cm, -wheelbase_cm)
    # How far the front axle's middle is to the left of each line.
    left_of = {i: _left_of(line, s_front, front) for i, line in by_index.items()}
    usual = float(np.nanmedian(left_of[1] - left_of[0]))
    exists = _lanes(by_index, left_of, s_front, usual)
    lane = np.zeros(n, dtype=np.int64)
    margin, current = BESIDE_DIVIDER_LANES * usual, 0
    # The first frame may be in any lane.
    for k in [0] * min(n, len(exists)) + list(range(n)):
        if current - 1 in exists and left_of[current][k] > margin and exists[current - 1][k]:
            current -= 1
        elif current + 1 in exists and left_of[current + 1][k] < -margin and exists[current + 1][k]:
            current += 1
        lane[k] = current
    lane = _without_swerves(lane, left_of, _ENTERED * usual)
    divides = _dividers(lane, forward, exists)
    between = _between_lanes(lane, left_of, exists, margin)
    return FrameLanes(lane, forward, between, _away(lane, left_of, _AWAY * usual), divides)


def _lanes(
    by_index: dict[int, LaneLine],
    left_of: dict[int, Float[np.ndarray, "n"]],
    s_cm: Float[np.ndarray, "n"],
    usual_cm: float,
) -> dict[int, Bool[np.ndarray, "n"]]:
    """Tell beside which frames there is each lane: its left line's index, and where it is."""
    everywhere = np.ones(len(s_cm), dtype=bool)
    lanes = {0: everywhere}
    for i in range(min(by_index) - 1, max(by_index) + 1):
        near, far = (i + 1, i) if i < 0 else (i, i + 1)
        if i == 0 or (far not in by_index and not by_index[near].dashed):
            continue
        lanes[i] = everywhere
        if far in by_index:
            width = left_of[i + 1] - left_of[i]
            fits = (width > _WIDTHS[0] * usual_cm) & (width < _WIDTHS[1] * usual_cm)
            known = by_index[i].supported(s_cm) & by_index[i + 1].supported(s_cm)
            lanes[i] = np.where(known, fits, by_index[near].dashed)
    return lanes


def _without_swerves(
    lane: Int[np.ndarray, "n"], left_of: dict[int, Float[np.ndarray, "n"]], entered_cm: float
) -> Int[np.ndarray, "n"]:
    """Give frames back to the lane before and after them where the car hardly got into the other one."""
    lane = lane.copy()
    runs = equal_runs(lane)
    for before, run, after in zip(runs[:-2], runs[1:-1], runs[2:], strict=True):
        home, away = lane[before[-1]], lane[run[0]]
        # The run before may have been given back already.
        if home == away:
            continue
        inside = left_of[home][run] if away < home else -left_of[away][run]
        if home == lane[after[0]] and inside.max() < entered_cm:
            lane[run] = home
    return lane


def _between_lanes(
    lane: Int[np.ndarray, "n"],
    left_of: dict[int, Float[np.ndarray, "n"]],
    exists: dict[int, Bool[np.ndarray, "n"]],
    margin_cm: float,
) -> Bool[np.ndarray, "n"]:
    """Tell which frames are not clearly inside their lane on a side where there is another one."""
    between = np.zeros(len(lane), dtype=bool)
    for i in exists:
        if i - 1 in exists:  # line i divides the two
            between |= (lane == i) & exists[i - 1] & (-left_of[i] < margin_cm)
            between |= (lane == i - 1) & exists[i] & (left_of[i] < margin_cm)
    return between


def _away(
    lane: Int[np.ndarray, "n"], left_of: dict[int, Float[np.ndarray, "n"]], away_cm: float
) -> Bool[np.ndarray, "n"]:
    """Tell which frames belong to a stretch beyond a line of their lane that leads too far from it."""
    beyond = np.full(len(lane), -np.inf)
    for i in np.unique(lane):
        rows = lane == i
        for side in (s for s in (i, i + 1) if s in left_of):
            out = left_of[side] if side == i else -left_of[side]
            beyond[rows] = np.fmax(beyond[rows], out[rows])
    gone = np.zeros(len(lane), dtype=bool)
    for run in true_runs(beyond > 0.0):
        gone[run] = beyond[run].max() > away_cm
    return gone


def _dividers(
    lane: Int[np.ndarray, "n"], forward: Bool[np.ndarray, "n"], exists: dict[int, Bool[np.ndarray, "n"]]
) -> Bool[np.ndarray, "n 2"]:
    """Tell beyond which lines of a frame's lane there is another one: the left, the right."""
    divides = np.zeros((len(lane), 2), dtype=bool)
    for i in exists:
        for side, beyond in enumerate((i - 1, i + 1)):
            if beyond in exists:
                divides[:, side] |= (lane == i) & exists[beyond]
    return np.where(forward[:, None], divides, divides[:, ::-1])


def _left_of(
    line: LaneLine, s_cm: Float[np.ndarray, "n"], points_cm: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Distance of points to the left of a line at given places along it."""
    tangent = line.everywhere(s_cm, 1)
    apart = points_cm - line.everywhere(s_cm)
    cross = tangent[:, 0] * apart[:, 1] - tangent[:, 1] * apart[:, 0]
    return cross / np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)
