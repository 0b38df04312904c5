"""Kinks of lane lines: tape is laid in straight pieces, and where two meet no smooth curve follows.

Where the borders of a marking do not lie along a fitted line, the straight pieces before and after are
continued until they meet. If borders lie along them up to that corner, the line goes through it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from datagen.lanes.offset import CubicBasis
from datagen.lanes.path import MapEdges, left_of
from lanenet.data.maps.line import LaneLine
from lanenet.data.segments import true_runs

#: Length of a place along a line, and how far from its middle the marking is looked for, in camera heights.
#: Chosen: 2 and 6 cm at 20 cm.
_PLACE, _REACH = 0.1, 0.3
#: Offset up to which a marking lies on a line, in camera heights. Chosen: 6 mm at 20 cm, the scatter of
#: borders between frames.
_ON = 0.03
#: Least number of edge points of a place that is seen. Chosen: one frame shows two.
_MIN_POINTS = 4
#: Least cosine between a border and the line: a line that cuts a corner of 90 degrees is at 45 to both sides.
_MIN_COSINE = 0.64
#: Longest straight piece that is measured on either side of a corner and its shortest length, and the longest
#: section between them, in camera heights. Chosen: 30, 12 and 100 cm at 20 cm.
_LEG, _LEAST_LEG, _BETWEEN = 1.5, 0.6, 5.0
#: Root mean square by which a straight piece is bent at most, in camera heights. Measured beside 24 simulated
#: corners: 0.004, once 0.008; an arc of 135 cm radius has 0.011 over the longest piece at a height of 18 cm.
_BENT = 0.011
#: Least and largest turn of a kink. Chosen: a cubic follows less; more is no road.
_LEAST_RAD, _MOST_RAD = np.deg2rad(8.0), np.deg2rad(120.0)
#: Length on either side of a corner that has to be seen, in camera heights; least share of its places, and of
#: those of the whole section, at which the marking lies on the corner. Chosen: 9 cm at 18 cm.
_TIP, _ON_TIP, _ON_SECTION = 0.5, 0.65, 0.7
#: Least length, in camera heights, by which the marking lies on the corner rather than on the fitted line.
_BETTER = 0.3
#: Number of sections where the marking is not on the line that one corner may take the place of. A smooth
#: line crosses the tape on both sides of a corner, so that there are three.
_SECTIONS = 4
#: Share of a straight piece over which the fitted line goes over to it.
_BLENDED = 0.4
#: Rounds of reweighting of a straight line. Chosen: it settles within a handful.
_ROUNDS = 5
#: Shortest cubic beside a corner, in camera heights. Chosen: as where bends are tight, or shorter.
_LEAST_CUBIC = 0.2
#: Samples per cubic with which a line is put together.
_SAMPLES = 8


def with_kinks(line: LaneLine, edges: MapEdges, camera_height_cm: float) -> LaneLine:
    """Return a line with the corners that the borders of its marking show.

    Args:
        line: A fitted line.
        edges: Edge points on the map.
        camera_height_cm: Sets the scale of bounds.
    """
    if not np.isfinite(line.marking_cm) or not len(edges.xy_cm):
        return line
    search = _Search(line, edges, camera_height_cm)
    corners: list[_Corner] = []
    for corner in sorted(search.corners(), key=lambda corner: -corner.better):
        if not any(corner.overlaps(other, line.period_cm) for other in corners):
            corners.append(corner)
    return _through(line, corners, camera_height_cm) if corners else line


@dataclass(frozen=True)
class _Corner:
    """Two straight pieces that take the place of a line from one position along it to another.

    Attributes:
        s_cm: Positions where the pieces begin, where they are fully taken, where they meet, and likewise to
            their end; the first lies within the lap.
        points_cm: Points at these positions, frame map; the third is the corner.
        better: Number of places that lie on the marking, compared with the fitted line.
    """

    s_cm: tuple[float, float, float, float, float]
    points_cm: Float[np.ndarray, "5 2"]
    better: int

    def past(self, s_cm: Float[np.ndarray, "m"], period_cm: float | None) -> Float[np.ndarray, "m"]:
        """Distance of positions from its beginning; on a lap, up to the next time round."""
        past = s_cm - self.s_cm[0]
        return past if period_cm is None else np.mod(past, period_cm)

    def beside_seam(self, low_cm: float, period_cm: float | None, apart_cm: float) -> _Corner:
        """The same with its corner no nearer to the seam of a lap, where knots are simple."""
        at = self.s_cm[2]
        if period_cm is None:
            return self
        off = (at - low_cm + 0.5 * period_cm) % period_cm - 0.5 * period_cm
        if abs(off) < apart_cm:
            at += np.copysign(apart_cm, off) - off
        return replace(self, s_cm=(*self.s_cm[:2], float(at), *self.s_cm[3:]))

    def overlaps(self, other: _Corner, period_cm: float | None) -> bool:
        """Whether both take the place of the same part of a line."""
        starts = [
            one.past(np.array([two.s_cm[0]]), period_cm)[0] for one, two in ((self, other), (other, self))
        ]
        lengths = [one.s_cm[-1] - one.s_cm[0] for one in (self, other)]
        return any(0.0 <= start <= length for start, length in zip(starts, lengths, strict=True))

    def blended(
        self, s_cm: Float[np.ndarray, "m"], line_cm: Float[np.ndarray, "m 2"]
    ) -> Float[np.ndarray, "m 2"]:
        """Points of the line with the corner, at positions from its beginning on."""
        pieces = np.stack([np.interp(s_cm, self.s_cm, self.points_cm[:, i]) for i in range(2)], axis=1)
        share = np.interp(s_cm, self.s_cm, [0.0, 1.0, 1.0, 1.0, 0.0])[:, None]
        return line_cm + share * (pieces - line_cm)


@dataclass(frozen=True)
class _Search:
    """What the search along one line needs."""

    line: LaneLine
    edges: MapEdges
    height_cm: float

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.edges.xy_cm)

    @property
    def closed(self) -> bool:
        return self.line.period_cm is not None

    @cached_property
    def s_cm(self) -> Float[np.ndarray, "p"]:
        """Positions of the places."""
        low, high = _span_cm(self.line)
        count = max(1, int((high - low) / (_PLACE * self.height_cm)))
        return low + np.arange(count) * (high - low) / count

    @cached_property
    def at_cm(self) -> Float[np.ndarray, "p 2"]:
        return self.line.everywhere(self.s_cm)

    @cached_property
    def right(self) -> Float[np.ndarray, "p 2"]:
        return -left_of(self.line.everywhere(self.s_cm, 1))

    @cached_property
    def offset_cm(self) -> Float[np.ndarray, "p"]:
        """Offset of the marking to the right of the line; NaN where it is not seen."""
        return self.offsets(self.at_cm, self.right)

    @cached_property
    def on(self) -> Bool[np.ndarray, "p"]:
        """Whether the marking lies on the line."""
        return np.asarray(np.abs(self.offset_cm) <= _ON * self.height_cm)

    def offsets(
        self, at_cm: Float[np.ndarray, "m 2"], right: Float[np.ndarray, "m 2"]
    ) -> Float[np.ndarray, "m"]:
        """Median offset of the marking to the right of places; NaN where it is not seen."""
        half_cm, most_cm = 0.5 * self.line.marking_cm, _REACH * self.height_cm
        found = np.full(len(at_cm), np.nan)
        for i, rows in enumerate(self.tree.query_ball_point(at_cm, most_cm + half_cm)):
            apart, across = self.edges.xy_cm[rows] - at_cm[i], self.edges.normals[rows] @ right[i]
            ahead_cm = apart[:, 1] * right[i, 0] - apart[:, 0] * right[i, 1]
            taken = (np.abs(ahead_cm) <= 0.5 * _PLACE * self.height_cm) & (np.abs(across) >= _MIN_COSINE)
            # The left border brightens to the right.
            off_cm = (apart @ right[i] + half_cm * np.sign(across))[taken]
            off_cm = off_cm[np.abs(off_cm) <= most_cm]
            if len(off_cm) >= _MIN_POINTS:
                found[i] = np.median(off_cm)
        return found

    def corners(self) -> Iterator[_Corner]:
        """Corners in the place of sections where the marking does not lie on the line."""
        runs, n = true_runs(~self.on, self.closed), len(self.on)
        for i, run in enumerate(runs):
            for j in range(i, i + _SECTIONS):
                if j >= len(runs) and (not self.closed or j - i >= len(runs)):
                    break
                last = runs[j % len(runs)]
                length = (last[-1] - run[0]) % n + 1
                if length * _PLACE > _BETWEEN:
                    break
                corner = self._corner(int(run[0]), int(run[0] + length - 1))
                if corner is not None:
                    yield corner

    def _corner(self, first: int, last: int) -> _Corner | None:
        """The corner in the place of a section from one place to another; None where there is none."""
        count = round(_LEG / _PLACE)
        before, after = (
            self._straight(np.arange(*rows))
            for rows in ((first - count, first), (last + 1, last + 1 + count))
        )
        if before is None or after is None:
            return None
        turn = before.along[0] * after.along[1] - before.along[1] * after.along[0]
        if not _LEAST_RAD < np.arctan2(abs(turn), before.along @ after.along) < _MOST_RAD:
            return None
        share = np.linalg.solve(np.column_stack([before.along, -after.along]), after.at_cm - before.at_cm)
        meet = before.at_cm + share[0] * before.along
        blend = round(_BLENDED * count)
        rows = np.array([first - 1 - blend, first - 1, last + 1, last + 1 + blend])
        if not self.closed and (rows[0] < 0 or rows[-1] >= len(self.s_cm)):
            return None
        places = self.at_cm[rows % len(self.s_cm)]
        begin, taken = (before.foot(places[k]) for k in (0, 1))
        left, end = (after.foot(places[k]) for k in (2, 3))
        # The corner lies ahead of the one piece and behind the other.
        if (meet - taken) @ before.along <= 0.0 or (left - meet) @ after.along <= 0.0:
            return None
        on = [self._on_piece(meet, begin), self._on_piece(meet, end)]
        tip = round(_TIP / _PLACE)
        found = np.concatenate(on)
        inside = np.arange(rows[0], rows[-1] + 1) % len(self.on)
        better = int((~self.on[inside]).sum() - (~found).sum())
        if (
            found.mean() < _ON_SECTION
            or np.concatenate([piece[:tip] for piece in on]).mean() < _ON_TIP
            or better * _PLACE < _BETTER
        ):
            return None
        step_cm = float(self.s_cm[1] - self.s_cm[0])
        begin_cm = float(self.s_cm[rows[0] % len(self.s_cm)])
        s_cm = begin_cm + (rows - rows[0]) * step_cm
        lengths = np.linalg.norm(taken - meet), np.linalg.norm(left - meet)
        at_cm = s_cm[1] + (s_cm[2] - s_cm[1]) * lengths[0] / sum(lengths)
        at_cm = float(np.clip(at_cm, s_cm[1] + 0.25 * step_cm, s_cm[2] - 0.25 * step_cm))
        positions = (float(s_cm[0]), float(s_cm[1]), at_cm, float(s_cm[2]), float(s_cm[3]))
        return _Corner(positions, np.array([begin, taken, meet, left, end]), better)

    def _straight(self, rows: Int[np.ndarray, "k"]) -> _Straight | None:
        """The straight piece that the marking forms at some places; None where it forms none."""
        if not self.closed:
            rows = rows[(rows >= 0) & (rows < len(self.s_cm))]
        rows = rows % len(self.s_cm)
        rows = rows[np.isfinite(self.offset_cm[rows]) & self.line.supported(self.s_cm[rows])]
        if len(rows) * _PLACE < _LEAST_LEG:
            return None
        points = self.at_cm[rows] + self.offset_cm[rows, None] * self.right[rows]
        weight = np.ones(len(points))
        for _ in range(_ROUNDS):
            at = (weight @ points) / weight.sum()
            along = np.linalg.svd((points - at) * np.sqrt(weight)[:, None])[2][0]
            off = (points - at) @ [-along[1], along[0]]
            weight = 1.0 / (1.0 + (off / (_BENT * self.height_cm)) ** 2)
        if np.sqrt(np.mean(np.minimum(np.abs(off), _ON * self.height_cm) ** 2)) > _BENT * self.height_cm:
            return None  # a bend
        return _Straight(at, along if (points[-1] - points[0]) @ along > 0.0 else -along)

    def _on_piece(
        self, from_cm: Float[np.ndarray, "2"], to_cm: Float[np.ndarray, "2"]
    ) -> Bool[np.ndarray, "m"]:
        """At which places along a straight piece the marking lies on it."""
        length_cm, step_cm = float(np.linalg.norm(to_cm - from_cm)), _PLACE * self.height_cm
        along = (to_cm - from_cm) / length_cm
        at_cm = from_cm + (np.arange(max(1, int(length_cm / step_cm))) + 0.5)[:, None] * step_cm * along
        off_cm = self.offsets(at_cm, np.tile(-left_of(along[None]), (len(at_cm), 1)))
        return np.asarray(np.abs(off_cm) <= _ON * self.height_cm)


@dataclass(frozen=True)
class _Straight:
    """A straight piece: a point on it and its direction."""

    at_cm: Float[np.ndarray, "2"]
    along: Float[np.ndarray, "2"]

    def foot(self, point_cm: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """The nearest point on it."""
        return self.at_cm + ((point_cm - self.at_cm) @ self.along) * self.along


def _span_cm(line: LaneLine) -> tuple[float, float]:
    return float(line.knots_cm[3]), float(line.knots_cm[-4])


def _through(line: LaneLine, corners: list[_Corner], height_cm: float) -> LaneLine:
    """Put a line together anew, with a triple knot at each corner."""
    low, high = _span_cm(line)
    apart_cm = _LEAST_CUBIC * height_cm
    corners = [corner.beside_seam(low, line.period_cm, 0.25 * apart_cm) for corner in corners]
    kinks = [_in_lap(corner.s_cm[2], low, line.period_cm) for corner in corners]
    breaks = line.knots_cm[3:-3]
    for corner in corners:
        past = corner.past(breaks, line.period_cm)
        breaks = breaks[(past <= 0.0) | (past >= corner.s_cm[-1] - corner.s_cm[0])]
        ends = [_in_lap(corner.s_cm[i], low, line.period_cm) for i in (0, 1, 3, 4)]
        breaks = np.concatenate([breaks, ends])
    kept = [low, high, *kinks]
    for at in np.sort(breaks).tolist():
        if min(abs(at - other) for other in kept) > apart_cm and low < at < high:
            kept.append(at)
    basis = CubicBasis(np.sort(np.array(kept + 2 * kinks)), line.period_cm is not None)
    simple = np.sort(np.array(kept))
    share = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    s_cm = (simple[:-1, None] + share * np.diff(simple)[:, None]).ravel()
    points, sigma_cm = line.everywhere(s_cm), line.sigma_at_cm.copy()
    supported = line.supported_cm
    for corner in corners:
        begin, taken, _, left, end = corner.s_cm
        past = corner.past(s_cm, line.period_cm)
        inside = (past >= 0.0) & (past <= end - begin)
        points[inside] = corner.blended(begin + past[inside], points[inside])
        # The pieces hold the line up to the corner.
        past = corner.past(line.sigma_s_cm, line.period_cm)
        inside = (past >= taken - begin) & (past <= left - begin)
        ends_cm = line.sigma_cm(np.array([taken, left]))
        sigma_cm[inside] = np.interp(begin + past[inside], [taken, left], ends_cm)
        if not line.supported(np.linspace(begin, end, _SAMPLES)).all():
            supported = np.concatenate([supported, [[taken, left]]])
    return replace(
        line,
        knots_cm=basis.knots_cm,
        coefficients_cm=basis.unfolded(basis.fitted(s_cm, points)),
        supported_cm=supported,
        sigma_at_cm=sigma_cm,
    )


def _in_lap(s_cm: float, low_cm: float, period_cm: float | None) -> float:
    return s_cm if period_cm is None else low_cm + (s_cm - low_cm) % period_cm
