"""Markings along a path: follow one, or the centre of a lane, and find the widths of markings and lane.

Dynamic programming over the offsets finds the course of a marking or lane.

Two lines side by side are not necessarily the lane. Where three lines run side by side at equal distances,
the road has two lanes, or one lane with a line in its middle. The car decides: if it keeps to one half, that
half is its lane; if it drives on the middle line or changes sides often, its lane is the whole road.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from pydantic import Field
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.path import Path, Samples
from datagen.lanes.profile import EdgeProfile, shifted
from lanenet.config import Settings
from lanenet.errors import NoLaneError

#: Ratio of two line distances at which one counts as half of the other. Chosen: widths are known to a cell of
#: 0.06 camera heights, 3 % of a usual lane.
_HALF = (0.44, 0.56)
#: Least support of lines at half or twice the distance of the best ones. Chosen: one of them may be dashed.
_AS_WELL = 0.8
#: Least support of each of three lines relative to what lies in the middles of the two lanes. Chosen: on a
#: mottled floor, any place across the road has some support.
_CLEAR = 1.25
#: Largest offset of the car from the centre of its lane, as a share of the lane's width. Chosen: a pair of
#: lines further off is half of a lane, next to a crack or shadow that the car drives over.
_OFF_CENTRE = 0.4
#: Offsets from the middle of a road with two lanes, in widths of the road. Derived: beyond the first, the car
#: is nearer to the centre of one lane (at 0.25) than to the middle; beyond the second, it is not on the road.
_IN_HALF, _ON_ROAD = 0.125, 1.0
#: Least share of frames in the same half of the road if the car keeps to it. Measured on simulated drives in
#: one of two lanes: 0.88 with wide swerves, else 0.96 and more.
_MOST = 0.5


class TraceSettings(Settings):
    """How lane lines are traced; lengths in camera heights where the name says so.

    Where no other origin is given, values were chosen on simulated drives.

    Attributes:
        cell_heights: Cells across the path: 0.4 cm at a camera height of 15 cm, a fifth of a usual marking.
        side_heights: Largest offset from the path at which edges count.
        min_side: Least component of an edge's normal across the path: edges within 41 degrees of it.
        tape_heights: Narrowest and widest marking: 0.75 to 9 cm at a camera height of 15 cm.
        lane_heights: Narrowest and widest lane, if its width is not given: 12 to 98 cm at 15 cm.
        smoothness: Cost of a step of one cell across, per sample along the path; it grows with the square.
        sideways: Additional cost of a step of one cell where no paint is.
        second_line: Weight of the weaker of the lane's two lines; the stronger one counts 1.
        inside: Cost per sample if the car is a lane's width outside the lane, less if it is only just
            outside. It exceeds ``second_line``, so that an adjacent lane with two solid lines does not win; a
            much higher value makes the lane change sides with the car.
        min_support: Density of edges above which a marking counts as seen, 0..1.
        width_share: Largest variation of the lane's width along the road, as a share of it.
        neighbours: Number of lines to look for on each side beyond the driven lane.
        neighbour_lanes: Least length of paint of an adjacent line, in lane widths.
        neighbour_share: Least share of the path along which an adjacent line is seen,
        visit_share: or of the path that the car drives in the lane in front of it,
        visit_lanes: if that path has at least this length, in lane widths.
    """

    cell_heights: float = Field(default=0.03, gt=0.0)
    side_heights: float = Field(default=8.0, gt=0.0)
    min_side: float = Field(default=0.75, gt=0.0, lt=1.0)
    tape_heights: tuple[float, float] = (0.05, 0.6)
    lane_heights: tuple[float, float] = (0.8, 6.5)
    smoothness: float = Field(default=0.04, gt=0.0)
    sideways: float = Field(default=0.3, ge=0.0)
    second_line: float = Field(default=0.08, gt=0.0, le=1.0)
    inside: float = Field(default=0.12, ge=0.0)
    min_support: float = Field(default=0.4, gt=0.0)
    width_share: float = Field(default=0.15, gt=0.0, lt=0.5)
    neighbours: int = Field(default=1, ge=0)
    neighbour_lanes: float = Field(default=4.0, gt=0.0)
    neighbour_share: float = Field(default=0.35, ge=0.0, le=1.0)
    visit_share: float = Field(default=0.5, ge=0.0, le=1.0)
    visit_lanes: float = Field(default=2.0, gt=0.0)


@dataclass(frozen=True, eq=False)
class Markings:
    """Where markings of one width may lie along a path.

    Attributes:
        path: The path, with the frames' positions.
        profile: Density of edges along it.
        tape_cm: Width of the markings.
        settings: Cell sizes, costs and bounds.
    """

    path: Path
    profile: EdgeProfile
    tape_cm: float
    settings: TraceSettings

    @cached_property
    def support(self) -> Float[np.ndarray, "m c"]:
        """Support of a marking with its middle in each cell of the profile, 0..1."""
        return self.profile.tapes(self.tape_cm)

    def best_lane(self, lane_width_cm: float) -> tuple[float, Samples]:
        """Find the lane's width, within a tenth of the given one, and the offset of its centre."""
        best: tuple[float, float, Samples] | None = None
        profile = self.profile
        outside = self.settings.inside * self._car_outside(lane_width_cm)
        for width in lane_width_cm * np.linspace(0.9, 1.1, 9):
            cells = width / profile.cell_cm
            left, right = shifted(self.support, 0.5 * cells), shifted(self.support, -0.5 * cells)
            # One line counts nearly as much as two, or a lane with a worn line would lose to its neighbour.
            support = np.maximum(left, right) + self.settings.second_line * np.minimum(left, right)
            centre, score = self._best_track(support, outside)
            if best is None or score > best[0]:
                best = (score, float(width), (centre - profile.half_cells) * profile.cell_cm)
        assert best is not None
        return best[1], best[2]

    def follow(self, guess_cm: Samples, band_cm: float) -> Samples:
        """Follow one marking within a band about a guess; returns its offset."""
        cell_cm, half_cells = self.profile.cell_cm, self.profile.half_cells
        columns = self.support.shape[1]
        reach = max(2, int(band_cm / cell_cm))
        offsets = np.arange(-reach, reach + 1)
        nearest = np.rint(np.clip(guess_cm / cell_cm + half_cells, 0.0, columns - 1.0)).astype(np.intp)
        window = np.clip(nearest[:, None] + offsets, 0, columns - 1)
        support = np.take_along_axis(self.support, window, axis=1)
        # Of two markings side by side, prefer the one nearer to the guess.
        against = np.broadcast_to(0.1 * np.abs(offsets) / reach, support.shape)
        track, _ = self._best_track(support, np.ascontiguousarray(against))
        return (nearest + track - reach - half_cells) * cell_cm

    def seen(self, line_cm: Samples) -> Samples:
        """Keep a followed line where both borders of its marking are seen; NaN elsewhere."""
        edges = []
        for density, sign in ((self.profile.left, 0.5), (self.profile.right, -0.5)):
            column = self._column(line_cm + sign * self.tape_cm)
            window = np.clip(column[:, None] + np.arange(-1, 2), 0, density.shape[1] - 1)
            edges.append(np.take_along_axis(density, window, axis=1).max(axis=1))
        return np.where(np.minimum(*edges) >= self.settings.min_support, line_cm, np.nan)

    def mean_support(self, line_cm: Samples) -> float:
        """Mean support along a line."""
        column = np.clip(self._column(line_cm), 0, self.support.shape[1] - 1)
        return float(self.support[np.arange(len(column)), column].mean())

    def _column(self, d_cm: Samples) -> Int[np.ndarray, "m"]:
        return np.rint(d_cm / self.profile.cell_cm).astype(np.intp) + self.profile.half_cells

    def _car_outside(self, lane_cm: float) -> Float[np.ndarray, "m c"]:
        """Mean over all visits of how far the car is outside a lane centred at each offset, 0..1."""
        path = self.path
        m, columns = self.support.shape
        at = (np.arange(columns) - self.profile.half_cells) * self.profile.cell_cm
        forward = path.drives_forward
        rows = np.rint(path.s_frames_cm / path.step_cm).astype(np.intp) % m
        total, visits = np.zeros((m, columns)), np.zeros(m)
        for row, offset in zip(rows[forward], path.offsets_cm[forward], strict=True):
            total[row] += np.clip(np.abs(at - offset) / (0.5 * lane_cm) - 1.0, 0.0, 1.0) ** 2
            visits[row] += 1.0
        near = max(1.0, 0.25 * lane_cm / path.step_cm)
        total = gaussian_filter1d(total, near, axis=0, mode="wrap" if path.closed else "nearest")
        visits = gaussian_filter1d(visits, near, mode="wrap" if path.closed else "nearest")
        return total / np.maximum(visits, 1e-3)[:, None]

    def _best_track(
        self, support: Float[np.ndarray, "m c"], against: Float[np.ndarray, "m c"]
    ) -> tuple[Samples, float]:
        """Columns with the most support; a closed path is extended by half a lap at either end."""
        m = len(support)
        lead = m // 2 if self.path.closed else 0
        if lead:
            support, against = (np.concatenate([a[-lead:], a, a[:lead]]) for a in (support, against))
        track, score = _viterbi(
            support.astype(np.float32),
            against.astype(np.float32),
            self.settings.smoothness,
            self.settings.sideways,
        )
        return track[lead : lead + m].astype(np.float64), float(score)


@njit(cache=True)
@no_type_check
def _viterbi(support, against, smoothness, sideways):
    """Sequence of columns with the most support; steps of up to four columns, dearer without paint."""
    m, columns = support.shape
    cost = np.empty((m, columns), np.float32)
    back = np.zeros((m, columns), np.int8)
    for c in range(columns):
        cost[0, c] = support[0, c] - against[0, c]
    for i in range(1, m):
        for c in range(columns):
            best, step = -1e18, 0
            unpainted = sideways * max(0.0, 1.0 - support[i, c])
            for j in range(-4, 5):
                if 0 <= c + j < columns:
                    value = cost[i - 1, c + j] - smoothness * j * j - unpainted * abs(j)
                    if value > best:
                        best, step = value, j
            cost[i, c] = best + support[i, c] - against[i, c]
            back[i, c] = step
    track = np.empty(m, np.int64)
    track[m - 1] = np.argmax(cost[m - 1])
    score = cost[m - 1, track[m - 1]]
    for i in range(m - 1, 0, -1):
        track[i - 1] = track[i] + back[i, track[i]]
    return track, score


def find_tape_width(
    profile: EdgeProfile, driven: int, camera_height_cm: float, settings: TraceSettings
) -> float:
    """Find the width at which left and right edges pair up best, over the driven section."""
    low, high = (t * camera_height_cm for t in settings.tape_heights)
    widths = np.arange(low, high, 0.5 * profile.cell_cm)
    scores = [_best_pairs(profile, w, driven).mean() for w in widths]
    return float(widths[int(np.argmax(gaussian_filter1d(np.array(scores), 1.0)))])


def darker_than_floor(
    profile: EdgeProfile, driven: int, camera_height_cm: float, settings: TraceSettings
) -> bool:
    """Whether the markings along most of the driven section are darker than the floor.

    The two borders of a marking lie its width apart and brighten towards each other; those of a dark one
    brighten away from each other. What lies between two markings is wider.
    """
    pairs = []
    for one in (profile, profile.towards_dark()):
        width_cm = find_tape_width(one, driven, camera_height_cm, settings)
        # Densities saturate: after many laps, the scatter of a border counts nearly as much as the border.
        pairs.append(_best_pairs(one.unsaturated(), width_cm, driven))
    light, dark = pairs
    return int((dark > light).sum()) > int((light > dark).sum())


def _best_pairs(profile: EdgeProfile, width_cm: float, driven: int) -> Samples:
    """Mean of the six best pairs of borders at each position: two or three lines, each some cells wide."""
    return np.asarray(np.partition(profile.tapes(width_cm)[:driven], -6, axis=1)[:, -6:].mean(axis=1))


def find_lane_width(
    markings: Markings, driven: int, camera_height_cm: float, least: tuple[float, float] = (0.0, 0.0)
) -> float:
    """Find the distance at which two markings run along the path, one on either side of the car.

    Args:
        markings: Where markings may lie.
        driven: Number of path samples that the car has driven over.
        camera_height_cm: Sets the scale of bounds.
        least: Narrowest lane, in camera heights and in widths of a marking; a narrower one counts if there is
            no other.

    Raises:
        NoLaneError: If no two lines run side by side.
    """
    profile, support = markings.profile, markings.support[:driven]
    low, high = (w * camera_height_cm for w in markings.settings.lane_heights)
    widths = np.arange(low, high, 2.0 * profile.cell_cm)
    scores = []
    for width in widths:
        cells = 0.5 * width / profile.cell_cm
        pair = shifted(support, cells) * shifted(support, -cells)
        within = int(_OFF_CENTRE * width / profile.cell_cm)
        inside = pair[:, profile.half_cells - within : profile.half_cells + within + 1]
        scores.append(np.sqrt(inside).max(axis=1).mean())
    score = gaussian_filter1d(np.array(scores), 1.5)
    peaks = [i for i in range(1, len(score) - 1) if score[i] >= score[i - 1] and score[i] > score[i + 1]]
    if not peaks:
        raise NoLaneError("no two lines run side by side along the drive, so its scale is unknown")
    least_cm = max(least[0] * camera_height_cm, least[1] * markings.tape_cm)
    peaks = [i for i in peaks if widths[i] >= least_cm] or peaks
    peaks.sort(key=lambda i: -score[i])
    best = peaks[0]
    for other in peaks[1:]:
        half, whole = sorted((float(widths[best]), float(widths[other])))
        if score[other] < _AS_WELL * score[best] or not _HALF[0] < half / whole < _HALF[1]:
            continue
        _, middle = markings.best_lane(whole)
        if _has_middle_line(markings, middle, whole):
            return half if _keeps_to_a_half(markings.path, middle, whole) else whole
    return float(widths[best])


def _has_middle_line(markings: Markings, middle_cm: Samples, whole_cm: float) -> bool:
    """Whether three lines run along the road."""
    band_cm = (max(_HALF) - 0.5) * whole_cm
    left, left_lane, middle, right_lane, right = (
        markings.mean_support(markings.follow(middle_cm + share * whole_cm, band_cm))
        for share in (0.5, 0.25, 0.0, -0.25, -0.5)
    )
    return min(left, middle, right) >= _CLEAR * max(left_lane, right_lane)


def _keeps_to_a_half(path: Path, middle_cm: Samples, whole_cm: float) -> bool:
    """Whether the car is most of the time in the same half of the road, in its direction of travel."""
    middle = np.interp(path.s_frames_cm, path.s_cm, middle_cm, period=path.period_cm)
    offset = path.offsets_cm - middle
    left = np.where(path.drives_forward, offset, -offset) / whole_cm
    left = left[np.abs(left) < _ON_ROAD]
    return bool(max(np.sum(left > _IN_HALF), np.sum(left < -_IN_HALF)) > _MOST * len(left))
