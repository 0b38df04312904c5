"""Kinks of lane lines: tape is laid in straight pieces, and where two meet no smooth curve follows.

Straight pieces of tape are found beside a fitted line and joined where they meet in a corner. Where the line
leaves such a chain, and the borders of the marking lie along the chain, the line takes the chain's course.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from datagen.lanes.chains import Chain, chains_of
from datagen.lanes.path import MapEdges, left_of
from datagen.lanes.sections import BLEND, Section, in_lap, through
from datagen.lanes.tape import Piece, straight_pieces
from lanenet.data.maps.line import LaneLine
from lanenet.data.segments import true_runs

#: Length of a place along a line, and how far from its middle the marking is looked for, in camera heights.
#: Chosen: 2 and 6 cm at 20 cm.
_PLACE, _REACH = 0.1, 0.3
#: Offset up to which a marking lies on a line, in camera heights. Chosen: 6 mm at 20 cm, the scatter of
#: borders between frames.
_ON = 0.03
#: Offset up to which a marking lies on a piece of its tape, in widths of the tape, if that is more. Measured:
#: where the camera or the floor is a little off, wide tape bends aside by 0.15 widths at its ends.
_ON_TAPE = 0.15
#: Least number of edge points of a place that is seen. Chosen: one frame shows two.
_MIN_POINTS = 4
#: Least cosine between a border and the line: a line that cuts a corner of 90 degrees is at 45 to both sides.
_MIN_COSINE = 0.64
#: Distance from a fitted line up to which pieces of its tape are looked for, in lane widths. Chosen: lanes of
#: tape are up to a third wider in a corner, and the middle of the lane is half a width away.
_BESIDE_LANES = 0.35
#: Least cosine between a piece and the line for its direction to be known: 60 degrees.
_ALONG = 0.5
#: Distance of a chain's end from the line that goes back there, from which its last piece has to be so long,
#: in camera heights. Derived: over twice that distance the line turns by 27 degrees. Measured: a piece of
#: clutter that led away was 0.8 long, pieces of tape whose next piece was not in view 1.8 and more.
_BACK, _LEADS = 0.3, 1.5
#: Least share of the places of a section at which the marking lies on the chain, and least length, in camera
#: heights, by which it lies there rather than on the fitted line. Chosen: 5 cm at 18 cm.
_ON_SECTION, _BETTER = 0.7, 0.3
#: Bounds of a section's length along the line relative to that along the chain. Chosen: a corner of 120
#: degrees that is cut is half as long; a line that does not go back and forth is not longer.
_LENGTHS = (0.3, 2.0)


def with_kinks(line: LaneLine, edges: MapEdges, camera_height_cm: float, lane_cm: float) -> LaneLine:
    """Return a line with the corners that the borders of its marking show.

    Args:
        line: A fitted line.
        edges: Edge points on the map.
        camera_height_cm: Sets the scale of bounds.
        lane_cm: Width of the lane: further away from the line, pieces of tape belong to something else.
    """
    if not np.isfinite(line.marking_cm) or not len(edges.xy_cm):
        return line
    search = _Search(line, edges, camera_height_cm, lane_cm)
    sections: list[Section] = []
    for section in sorted(search.sections(), key=lambda section: -section.better):
        if not any(section.overlaps(other, line.period_cm) for other in sections):
            sections.append(section)
    while sections:
        found = through(line, sections, camera_height_cm)
        kept = [section for section in sections if not section.strayed(found, line, camera_height_cm)]
        if len(kept) == len(sections):
            return found
        sections = kept
    return line


@dataclass(frozen=True)
class _Search:
    """What the search along one line needs."""

    line: LaneLine
    edges: MapEdges
    height_cm: float
    lane_cm: float

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.edges.xy_cm)

    @property
    def closed(self) -> bool:
        return self.line.period_cm is not None

    @cached_property
    def s_cm(self) -> Float[np.ndarray, "p"]:
        """Positions of the places."""
        low, high = self.line.span_cm
        count = max(1, int((high - low) / (_PLACE * self.height_cm)))
        return low + np.arange(count) * (high - low) / count

    @cached_property
    def at_cm(self) -> Float[np.ndarray, "p 2"]:
        return self.line.everywhere(self.s_cm)

    @cached_property
    def right(self) -> Float[np.ndarray, "p 2"]:
        return -left_of(self.line.everywhere(self.s_cm, 1))

    @cached_property
    def places(self) -> cKDTree:
        return cKDTree(self.at_cm)

    @cached_property
    def on(self) -> Bool[np.ndarray, "p"]:
        """Whether the marking lies on the line."""
        return np.asarray(
            np.abs(self.offsets(self.at_cm, self.right, self.line.marking_cm)) <= _ON * self.height_cm
        )

    def offsets(
        self, at_cm: Float[np.ndarray, "m 2"], right: Float[np.ndarray, "m 2"], marking_cm: float
    ) -> Float[np.ndarray, "m"]:
        """Median offset of the marking to the right of places; NaN where it is not seen."""
        half_cm, most_cm = 0.5 * marking_cm, _REACH * self.height_cm
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

    def pieces(self) -> list[Piece]:
        """Straight pieces of tape beside the line."""
        reach_cm = _BESIDE_LANES * self.lane_cm
        apart_cm, _ = self.places.query(self.edges.xy_cm, distance_upper_bound=reach_cm)
        beside = np.asarray(apart_cm) < reach_cm
        return straight_pieces(self.edges.select(beside), self.line.marking_cm, self.height_cm)

    def sections(self) -> Iterator[Section]:
        """Sections where the line leaves a chain of pieces on which the marking lies."""
        for chain in chains_of(self.pieces(), self._ahead, self._on_piece, self.height_cm):
            yield from self._off_chain(chain)

    def _ahead(self, piece: Piece) -> bool | None:
        """Whether a piece runs along the line; None where it runs across."""
        place = self.places.query(0.5 * (piece.begin_cm + piece.end_cm))[1]
        along = float(left_of(self.right[place][None])[0] @ piece.along)
        return None if abs(along) < _ALONG else along > 0.0

    def _off_chain(self, chain: Chain) -> Iterator[Section]:
        """Sections where the line leaves a chain."""
        length_cm, blend = float(chain.lengths_cm[-1]), round(BLEND / _PLACE)
        if chain.closed:
            # From the middle of what lies on the line, so that no section goes across its seam.
            way_cm = np.linspace(0.0, length_cm, max(4, int(length_cm / (_PLACE * self.height_cm))))[1:-1]
            runs = true_runs(np.asarray(self.places.query(chain.at(way_cm))[0]) <= self._step_cm, True)
            longest = max(runs, key=len, default=np.zeros(1, np.int64))
            chain = chain.begun_at(float(way_cm[longest[len(longest) // 2]]))
        past_cm = np.linspace(0.0, length_cm, max(2, int(length_cm / (_PLACE * self.height_cm)) + 1))
        points = chain.at(past_cm)
        apart, nearest = self.places.query(points)
        place = np.asarray(nearest)
        across = np.abs(np.sum((points - self.at_cm[place]) * self.right[place], axis=1))
        off = np.where(apart > self._step_cm, apart, across) > _ON * self.height_cm
        runs = true_runs(off)
        while runs:
            run = runs.pop(0)
            while runs and runs[0][0] - run[-1] <= blend:
                run = np.arange(run[0], runs.pop(0)[-1] + 1)
            # Where the line is on the chain it can go over to it.
            first, last = int(run[0]) - blend, int(run[-1]) + blend
            if first < 0 and last >= len(points):
                continue
            section = self._section(chain, past_cm, place, (first, int(run[0]), int(run[-1]), last))
            if section is not None:
                yield section

    def _section(
        self,
        chain: Chain,
        past_cm: Float[np.ndarray, "m"],
        place: Int[np.ndarray, "m"],
        rows: tuple[int, int, int, int],
    ) -> Section | None:
        """The section of a chain between samples of it; None where the marking does not lie on it.

        Args:
            chain: The chain.
            past_cm: Distances of its samples from its beginning.
            place: The place of the line that is nearest to each.
            rows: Samples where the line begins to go over to the chain, where it has, and likewise to its
                end; the first or the last may lie beyond the chain.
        """
        kept = np.clip(rows, 0, len(past_cm) - 1)
        from_cm, taken_cm, left_cm, to_cm = past_cm[kept]
        s_from, s_to = self._positions(int(place[kept[0]]), int(place[kept[3]]), float(to_cm - from_cm))
        stretch = (s_to - s_from) / (to_cm - from_cm)
        if not _LENGTHS[0] <= stretch <= _LENGTHS[1]:
            return None
        margin_cm = 0.5 * _PLACE * self.height_cm
        corners_cm = chain.lengths_cm[1:-1]
        corners_cm = corners_cm[(corners_cm > from_cm + 2 * margin_cm) & (corners_cm < to_cm - 2 * margin_cm)]
        if not len(corners_cm) and (rows[0] < 0 or rows[3] >= len(past_cm)):
            return None  # one straight piece, which the line passes at one end only
        off_cm = np.abs(self._off_way(chain, np.concatenate([[from_cm], corners_cm, [to_cm]])))
        if len(corners_cm):
            taken_cm = min(taken_cm, corners_cm[0] - margin_cm)
            left_cm = max(left_cm, corners_cm[-1] + margin_cm)
        way_cm = np.concatenate([[from_cm, taken_cm], corners_cm, [left_cm, to_cm]])
        s_cm, points = s_from + stretch * (way_cm - from_cm), chain.at(way_cm)
        # Beyond the end of a chain the line comes from where it was, or goes back there.
        blend_cm = BLEND * self.height_cm
        if rows[0] < 0:
            s_cm = np.concatenate([[s_cm[0] - blend_cm, s_cm[0]], s_cm[2:]])
            points = np.concatenate([self.line.everywhere(s_cm[:1]), chain.at(np.zeros(1)), points[2:]])
        if rows[3] >= len(past_cm):
            s_cm = np.concatenate([s_cm[:-2], [s_cm[-1], s_cm[-1] + blend_cm]])
            points = np.concatenate([points[:-2], points[-1:], self.line.everywhere(s_cm[-1:])])
        low, high = self.line.span_cm
        if not self.closed and (s_cm[0] < low or s_cm[-1] > high):
            return None
        aside_cm = np.hypot(*(points[[1, -2]] - self.line.everywhere(s_cm[[1, -2]])).T)
        short = np.diff(chain.lengths_cm)[[0, -1]] < _LEADS * self.height_cm
        off = np.array([rows[0] < 0, rows[3] >= len(past_cm)]) & (aside_cm > _BACK * self.height_cm)
        if (off & short).any():
            return None
        steps = np.arange(int(np.ceil((s_cm[-1] - s_cm[0]) / self._step_cm)))
        on = self.on[(np.floor((s_cm[0] - low) / self._step_cm).astype(np.int64) + steps) % len(self.on)]
        better = int((off_cm <= _ON * self.height_cm).sum() - len(off_cm) + (~on).sum())
        if (off_cm <= self._tape_cm).mean() < _ON_SECTION or better * _PLACE < _BETTER:
            return None
        begin = in_lap(float(s_cm[0]), low, self.line.period_cm)
        return Section(s_cm - s_cm[0] + begin, points, better)

    @property
    def _step_cm(self) -> float:
        return float(self.s_cm[1] - self.s_cm[0])

    def _positions(self, first: int, last: int, length_cm: float) -> tuple[float, float]:
        """Positions along the line of two places, the second about a length further on."""
        begin, end = self.s_cm[first], self.s_cm[last]
        period = self.line.period_cm
        if period is not None:
            end += period * round((begin + length_cm - end) / period)
        return float(begin), float(end)

    def _off_way(self, chain: Chain, past_cm: Float[np.ndarray, "k"]) -> Float[np.ndarray, "m"]:
        """Offset of the marking from a chain between distances from its beginning; NaN where unseen."""
        legs = np.searchsorted(chain.lengths_cm, 0.5 * (past_cm[1:] + past_cm[:-1]), side="right") - 1
        ways = zip(pairwise(chain.at(past_cm)), chain.markings_cm[legs].tolist(), strict=True)
        return np.concatenate([self._off_piece(*ends, marking_cm) for ends, marking_cm in ways])

    def _off_piece(
        self, from_cm: Float[np.ndarray, "2"], to_cm: Float[np.ndarray, "2"], marking_cm: float
    ) -> Float[np.ndarray, "m"]:
        """Offset of the marking from a straight piece at places along it; NaN where it is not seen."""
        length_cm, step_cm = float(np.linalg.norm(to_cm - from_cm)), _PLACE * self.height_cm
        along = (to_cm - from_cm) / length_cm
        at_cm = from_cm + (np.arange(max(1, int(length_cm / step_cm))) + 0.5)[:, None] * step_cm * along
        return self.offsets(at_cm, np.tile(-left_of(along[None]), (len(at_cm), 1)), marking_cm)

    def _on_piece(
        self, from_cm: Float[np.ndarray, "2"], to_cm: Float[np.ndarray, "2"], marking_cm: float
    ) -> Bool[np.ndarray, "m"]:
        """At which places along a straight piece the marking lies on it."""
        return np.asarray(np.abs(self._off_piece(from_cm, to_cm, marking_cm)) <= self._tape_cm)

    @property
    def _tape_cm(self) -> float:
        return max(_ON * self.height_cm, _ON_TAPE * self.line.marking_cm)
