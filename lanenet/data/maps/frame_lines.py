"""The lane of each frame, and its lines in the car frame of the image: polylines and the six labels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.maps.line import LaneLine
from lanenet.data.segments import equal_runs, true_runs
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import BESIDE_DIVIDER_LANES, N_POINTS, ROWS_CM, STEEPEST, label_rows

#: Spacing of a polyline's points. Chosen: chords of a 50 cm bend deviate by 0.1 mm.
SAMPLE_CM = 2.0
#: Extent of the polylines: from behind the rear axle to beyond the far edge of the bird's-eye window (72 cm).
BEHIND_CM, _AHEAD_CM = 20.0, 90.0
#: How far the car enters another lane at least, in lane widths; less is a swerve. Chosen: half of the 0.4 by
#: which a car may be off the centre of its own lane (datagen/lanes/markings.py).
_ENTERED = 0.2
#: How far beyond a line a car that means to stay in its lane may get, in lane widths. Chosen: the whole car
#: is beyond the line then, since a 1:10 car is about half as wide as its lane.
_AWAY = 0.35
#: Widths of an adjacent lane relative to the driven one. Chosen: a double line is below 0.2, a lay-by or two
#: lanes without a line between them 1.8 and more.
_ADJACENT_WIDTHS = (0.6, 1.5)


@dataclass(frozen=True)
class FrameLines:
    """The lane of one frame.

    Attributes:
        left_cm: Left line in the direction of travel, frame car; NaN where it is not supported.
        right_cm: Right line likewise.
        points_cm: The six labels; NaN where masked.
        widths_cm: Width of the left and the right marking at the points of their lines; NaN if unknown.
    """

    left_cm: Float[np.ndarray, "m 2"]
    right_cm: Float[np.ndarray, "m 2"]
    points_cm: Float[np.ndarray, "6"]
    widths_cm: tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]] | None = None

    def without(self, hidden: Bool[np.ndarray, "6"]) -> FrameLines:
        """Mask some of the six labels, and of the lines what is nearest to them.

        A view from elsewhere, made for training, would get labels of it.
        """
        lines = []
        for line, gone in zip((self.left_cm, self.right_cm), hidden.reshape(2, -1), strict=True):
            row = np.abs(line[:, 1:] - np.array(ROWS_CM)).argmin(axis=1)
            lines.append(np.where(gone[row][:, None], np.nan, line))
        points_cm = np.where(hidden, np.nan, self.points_cm)
        return replace(self, left_cm=lines[0], right_cm=lines[1], points_cm=points_cm)

    def markings_cm(self, side: int, usual_cm: float) -> Float[np.ndarray, "m"]:
        """Return the width of the left (0) or right (1) marking along its line; ``usual_cm`` if unknown."""
        line = (self.left_cm, self.right_cm)[side]
        own = np.full(len(line), np.nan) if self.widths_cm is None else self.widths_cm[side]
        return np.where(np.isfinite(own), own, usual_cm)


def lines_of_frame(
    lines: list[LaneLine],
    pose: Float[np.ndarray, "3"],
    s_cm: float,
    wheelbase_cm: float,
    lane: int = 0,
    forward: bool = True,
    max_sigma_cm: float = np.inf,
    steepest: float = STEEPEST,
) -> FrameLines:
    """Transform the lane lines around a frame into its car frame.

    Args:
        lines: Lines of the segment; a line of the lane that is not among them is unknown.
        pose: Rear-axle pose of the frame, frame map.
        s_cm: Position of the rear axle along the path.
        wheelbase_cm: Distance between the axles.
        lane: Index of the line on the left of the lane, seen in the path's direction; 0 is the driven lane.
        forward: Whether the car drives in the path's direction; if not, left and right swap.
        max_sigma_cm: A line is masked where its sigma exceeds this, and where the images contradict it.
        steepest: See :func:`lanenet.geometry.lane.label_rows`.
    """
    by_index = {line.index: line for line in lines}
    pair = (lane, lane + 1) if forward else (lane + 1, lane)
    bounds = [by_index.get(i) for i in pair]
    along = np.arange(-BEHIND_CM, wheelbase_cm + _AHEAD_CM, SAMPLE_CM)
    s = np.sort(s_cm + (along if forward else -along))
    for line in bounds:
        s = s if line is None else line.with_corners(s)
    s = s if forward else s[::-1]
    left, right = (_polyline(line, s, pose, wheelbase_cm, max_sigma_cm) for line in bounds)
    points = np.concatenate([label_rows(left, steepest), label_rows(right, steepest)])
    assert points.shape == (N_POINTS,)
    of_left, of_right = (np.full(len(s), np.nan) if line is None else line.widths_cm(s) for line in bounds)
    return FrameLines(left, right, points, (of_left, of_right))


def parallel_line(line_car_cm: Float[np.ndarray, "m 2"], right_cm: float) -> Float[np.ndarray, "m 2"]:
    """Shift a polyline to its right, seen in its direction; NaN spreads to neighbouring points."""
    along = np.gradient(line_car_cm, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    return np.asarray(line_car_cm + right_cm * np.stack([along[:, 1], -along[:, 0]], axis=1))


def _polyline(
    line: LaneLine | None,
    s_cm: Float[np.ndarray, "m"],
    pose: Float[np.ndarray, "3"],
    wheelbase_cm: float,
    max_sigma_cm: float,
) -> Float[np.ndarray, "m 2"]:
    """Express a line in the car frame; NaN where it is unsupported, uncertain or contradicted."""
    if line is None:
        return np.full((len(s_cm), 2), np.nan)
    polyline = car_from_map(line.points(s_cm), pose, wheelbase_cm)
    polyline[(line.sigma_cm(s_cm) > max_sigma_cm) | line.contradicted(s_cm)] = np.nan
    return polyline


@dataclass(frozen=True)
class FrameLanes:
    """The lane of each frame.

    Attributes:
        lane: Index of the lane's left line, seen in the path's direction: 0 for the driven lane, -1 for the
            lane to its left, 1 for the lane to its right.
        forward: Whether the car drives in the path's direction.
        between: Whether the car is on the line between two lanes, or beyond it in a swerve: an image does not
            show which lane is meant.
        away: Whether the car is so far beside its lane, or on the path there and back, that it may be in a
            lane that the map does not know.
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
    """Find the lane of each frame of a segment.

    The lane is the one that contains the middle of the front axle. It changes when that is clearly beyond a
    line with another lane behind it. There is another lane behind a line if its far line is seen, or if the
    line is dashed. Beside the road the car keeps the lane that it left, and likewise where it returns before
    it is well inside the other lane. A frame on a line between two lanes, or close to it, is ``between``. A
    car that is far beyond a solid line may be in a lane that the map does not know; it is ``away`` until it
    returns.

    Args:
        lines: Lines of the segment.
        poses: Rear-axle poses in the order of the drive, frame map.
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
    # Distance of the front axle's middle to the left of each line.
    left_of = {i: _left_of(line, s_front, front) for i, line in by_index.items()}
    width_cm = float(np.nanmedian(left_of[1] - left_of[0]))
    exists = _lanes(by_index, left_of, s_front, width_cm)
    lane = np.zeros(n, dtype=np.int64)
    margin, current = BESIDE_DIVIDER_LANES * width_cm, 0
    # The first frame may be in any lane.
    for k in [0] * min(n, len(exists)) + list(range(n)):
        if current - 1 in exists and left_of[current][k] > margin and exists[current - 1][k]:
            current -= 1
        elif current + 1 in exists and left_of[current + 1][k] < -margin and exists[current + 1][k]:
            current += 1
        lane[k] = current
    lane = _without_swerves(lane, left_of, _ENTERED * width_cm)
    divides = _dividers(lane, forward, exists)
    between = _between_lanes(lane, left_of, exists, margin)
    return FrameLanes(lane, forward, between, _away(lane, left_of, _AWAY * width_cm), divides)


def _lanes(
    by_index: dict[int, LaneLine],
    left_of: dict[int, Float[np.ndarray, "n"]],
    s_cm: Float[np.ndarray, "n"],
    width_cm: float,
) -> dict[int, Bool[np.ndarray, "n"]]:
    """Find the lanes, by the index of their left line, and beside which frames each exists."""
    everywhere = np.ones(len(s_cm), dtype=bool)
    lanes = {0: everywhere}
    for i in range(min(by_index) - 1, max(by_index) + 1):
        near, far = (i + 1, i) if i < 0 else (i, i + 1)
        if i == 0 or (far not in by_index and not by_index[near].dashed):
            continue
        lanes[i] = everywhere
        if far in by_index:
            share = (left_of[i + 1] - left_of[i]) / width_cm
            fits = (share > _ADJACENT_WIDTHS[0]) & (share < _ADJACENT_WIDTHS[1])
            known = by_index[i].supported(s_cm) & by_index[i + 1].supported(s_cm)
            lanes[i] = np.where(known, fits, by_index[near].dashed)
    return lanes


def _without_swerves(
    lane: Int[np.ndarray, "n"], left_of: dict[int, Float[np.ndarray, "n"]], entered_cm: float
) -> Int[np.ndarray, "n"]:
    """Keep the car in its lane where it hardly enters another one before it returns."""
    lane = lane.copy()
    runs = equal_runs(lane)
    for before, run, after in zip(runs[:-2], runs[1:-1], runs[2:], strict=True):
        home, away = lane[before[-1]], lane[run[0]]
        # The run before may have been changed already.
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
    """Find frames that are not clearly inside their lane on a side where there is another lane."""
    between = np.zeros(len(lane), dtype=bool)
    for i in exists:
        if i - 1 in exists:  # line i separates them
            between |= (lane == i) & exists[i - 1] & (-left_of[i] < margin_cm)
            between |= (lane == i - 1) & exists[i] & (left_of[i] < margin_cm)
    return between


def _away(
    lane: Int[np.ndarray, "n"], left_of: dict[int, Float[np.ndarray, "n"]], away_cm: float
) -> Bool[np.ndarray, "n"]:
    """Find excursions beyond a line of the lane that lead too far from it."""
    beyond = np.full(len(lane), -np.inf)
    for i in np.unique(lane):
        rows = lane == i
        for side in (s for s in (i, i + 1) if s in left_of):
            out = left_of[side] if side == i else -left_of[side]
            beyond[rows] = np.fmax(beyond[rows], out[rows])
    away = np.zeros(len(lane), dtype=bool)
    for run in true_runs(beyond > 0.0):
        away[run] = beyond[run].max() > away_cm
    return away


def _dividers(
    lane: Int[np.ndarray, "n"], forward: Bool[np.ndarray, "n"], exists: dict[int, Bool[np.ndarray, "n"]]
) -> Bool[np.ndarray, "n 2"]:
    """Find frames with another lane beyond the left, the right line of their own."""
    divides = np.zeros((len(lane), 2), dtype=bool)
    for i in exists:
        for side, beyond in enumerate((i - 1, i + 1)):
            if beyond in exists:
                divides[:, side] |= (lane == i) & exists[beyond]
    return np.where(forward[:, None], divides, divides[:, ::-1])


def _left_of(
    line: LaneLine, s_cm: Float[np.ndarray, "n"], points_cm: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n"]:
    """Distance of points to the left of a line, at given positions along it."""
    tangent = line.everywhere(s_cm, 1)
    apart = points_cm - line.everywhere(s_cm)
    cross = tangent[:, 0] * apart[:, 1] - tangent[:, 1] * apart[:, 0]
    return cross / np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)
