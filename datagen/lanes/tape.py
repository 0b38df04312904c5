"""Straight pieces of tape on the map, found from the borders of markings alone.

Every border edge votes for the middle of its marking, half the marking's width towards its inside. Where the
left and the right border of one tape vote for the same middles along a straight line, a piece of tape lies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_closing
from scipy.spatial import cKDTree

from datagen.lanes.path import MapEdges, left_of
from lanenet.data.segments import true_runs

#: Sides of the cells in which a piece begins, in camera heights, and their number of directions. Chosen: half
#: a usual marking, and twice the angle that a piece tolerates.
_CELL, _DIRECTIONS = 0.15, 9
#: Least number of votes of either border in a cell where a piece begins, and in a place of a piece that is
#: seen. Chosen: one frame shows two, and three frames a cell.
_BEGIN_VOTES, _PLACE_VOTES = 6, 3
#: Distance and angle from a piece up to which votes belong to it: camera heights, cosine. Chosen: twice the
#: scatter of borders between frames, and of their directions.
_ASIDE, _MIN_COSINE = 0.06, float(np.cos(np.deg2rad(12.0)))
#: Length of a place along a piece, longest gap between places that are seen, and shortest piece, in camera
#: heights. Chosen: as for kinks; dashes are not joined.
_PLACE, _GAP, SHORTEST = 0.1, 0.35, 0.6
#: Root mean square by which a piece is bent at most, in camera heights. Measured beside 24 simulated corners:
#: 0.004, once 0.008.
BENT = 0.011
#: Rounds in which a piece grows from its cell, to twice its length at most, and factor below which it no
#: longer grows. Chosen: enough for the longest straight.
_ROUNDS, _GROWS = 8, 1.1
#: Scale of reweighting of a straight line, in camera heights: as large as ``BENT``.
_SCALE = BENT
#: Least number of places of which the bend of a piece is measured. Derived: a parabola goes through three.
_LEAST_PLACES = 4
#: Rounds of reweighting. Chosen: it settles within a handful.
_REWEIGHTED = 5


@dataclass(frozen=True)
class Piece:
    """A straight piece of tape.

    Attributes:
        begin_cm: Where its middle line begins, frame map.
        end_cm: Where it ends.
        marking_cm: Width of the tape.
        bend_rad: By how much it turns to the left from its beginning to its end: chords of an arc do.
    """

    begin_cm: Float[np.ndarray, "2"]
    end_cm: Float[np.ndarray, "2"]
    marking_cm: float
    bend_rad: float = 0.0

    @property
    def length_cm(self) -> float:
        """Distance between its ends."""
        return float(np.linalg.norm(self.end_cm - self.begin_cm))

    @property
    def along(self) -> Float[np.ndarray, "2"]:
        """Unit vector from its beginning to its end."""
        return (self.end_cm - self.begin_cm) / self.length_cm

    def same(self, other: Piece) -> bool:
        """Whether the other one is this piece, either way round."""
        ends = {id(self.begin_cm), id(self.end_cm)}
        return ends == {id(other.begin_cm), id(other.end_cm)}

    def turned(self) -> Piece:
        """The same, the other way round."""
        return Piece(self.end_cm, self.begin_cm, self.marking_cm, -self.bend_rad)


def straight_pieces(edges: MapEdges, marking_cm: float, camera_height_cm: float) -> list[Piece]:
    """Find the straight pieces of tape among edges, those with the most votes first.

    Args:
        edges: Edge points on the map, normals into the markings.
        marking_cm: Width of the marking.
        camera_height_cm: Sets the scale of bounds.
    """
    votes = _Votes(
        edges.xy_cm + 0.5 * marking_cm * edges.normals,
        edges.normals,
        np.ones(len(edges.xy_cm), dtype=bool),
        marking_cm,
        camera_height_cm,
    )
    pieces = []
    for rows in votes.cells():
        piece = votes.grown(rows)
        if piece is not None:
            pieces.append(piece)
    return pieces


@dataclass(frozen=True)
class _Votes:
    """Middles of markings that edges vote for.

    Attributes:
        xy_cm: The middles, frame map.
        normals: Normals of the edges.
        free: Which belong to no piece yet; changes as pieces are found.
        marking_cm: Width of the marking.
        height_cm: Height of the camera.
    """

    xy_cm: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 2"]
    free: Bool[np.ndarray, "m"]
    marking_cm: float
    height_cm: float

    def cells(self) -> Iterator[Int[np.ndarray, "k"]]:
        """Votes of each cell of place and direction in which a piece may begin, and are still free."""
        angle = np.mod(np.arctan2(self.normals[:, 1], self.normals[:, 0]), np.pi)
        place = np.floor(self.xy_cm / (_CELL * self.height_cm)).astype(np.int64)
        key = np.column_stack([place, np.floor(angle / np.pi * _DIRECTIONS).astype(np.int64)])
        if not len(key):
            return
        _, cell, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        members = np.split(np.argsort(cell.reshape(-1), kind="stable"), np.cumsum(count)[:-1])
        for k in np.argsort(-count, kind="stable"):
            if count[k] < 2 * _BEGIN_VOTES:
                return
            rows = members[k][self.free[members[k]]]
            if len(rows) >= 2 * _BEGIN_VOTES and 2 * len(rows) > count[k]:
                yield rows

    def grown(self, rows: Int[np.ndarray, "k"]) -> Piece | None:
        """Grow a piece from the votes of a cell; None if they are not part of one."""
        normal = _axis(self.normals[rows])
        found: Piece | None = None
        at, half_cm = self.xy_cm[rows].mean(axis=0), 0.5 * SHORTEST * self.height_cm
        for _ in range(_ROUNDS):
            longer = self._fitted(at, normal, half_cm)
            if longer is None or (found is not None and longer.length_cm < _GROWS * found.length_cm):
                break
            found, at = longer, 0.5 * (longer.begin_cm + longer.end_cm)
            normal, half_cm = left_of(longer.along[None])[0], longer.length_cm
        if found is None or found.length_cm < SHORTEST * self.height_cm:
            return None
        self._take(found)
        return found

    def _fitted(
        self, at_cm: Float[np.ndarray, "2"], normal: Float[np.ndarray, "2"], half_cm: float
    ) -> Piece | None:
        """The piece around a place, up to a distance; None if there is none, or if it is bent."""
        rows = np.array(self.tree.query_ball_point(at_cm, half_cm), dtype=np.intp)
        facing = self.normals[rows] @ normal
        near = np.abs((self.xy_cm[rows] - at_cm) @ normal) < _ASIDE * self.height_cm
        near &= np.abs(facing) > _MIN_COSINE
        points, right = self.xy_cm[rows[near]], facing[near] > 0.0
        if min(right.sum(), (~right).sum()) < _BEGIN_VOTES:
            return None
        middle, along, wider_cm = _straight(points, right, normal, _SCALE * self.height_cm)
        normal, past = left_of(along[None])[0], (points - middle) @ along
        place_cm = _PLACE * self.height_cm
        place = np.floor((past - past.min()) / place_cm).astype(np.int64)
        places = int(place.max()) + 1
        votes = np.minimum(*(np.bincount(place[side], minlength=places) for side in (right, ~right)))
        gap = round(_GAP / _PLACE) + 1
        joined = binary_closing(np.pad(votes >= _PLACE_VOTES, gap), np.ones(gap, dtype=bool))[gap:-gap]
        here = ((at_cm - middle) @ along - past.min()) / place_cm
        runs = [run for run in true_runs(joined) if run[0] - gap <= here <= run[-1] + gap]
        if not runs:
            return None
        run = max(runs, key=len)
        off = (points - middle) @ normal
        sampled = run[votes[run] >= _PLACE_VOTES]
        bends = np.empty(len(sampled))
        for i, k in enumerate(sampled):
            there = place == k
            bends[i] = 0.5 * (np.median(off[there & right]) + np.median(off[there & ~right]))
        if np.sqrt(np.mean(np.square(bends))) > BENT * self.height_cm:
            return None
        ends = past.min() + np.array([run[0], run[-1] + 1]) * place_cm
        bend_rad = 0.0
        if len(sampled) > _LEAST_PLACES:
            # The second derivative of a parabola, times the length.
            bend_rad = 2.0 * float(np.polyfit(sampled * place_cm, bends, 2)[0] * (ends[1] - ends[0]))
        begin_cm, end_cm = (middle + end * along for end in ends)
        return Piece(begin_cm, end_cm, self.marking_cm + wider_cm, bend_rad)

    def _take(self, piece: Piece) -> None:
        """Mark the votes along a piece as no longer free."""
        along, apart = piece.along, self.xy_cm - piece.begin_cm
        past = apart @ along
        beside = np.abs(apart @ left_of(along[None])[0]) < 2.0 * _ASIDE * self.height_cm
        alike = np.abs(self.normals @ along) < np.sin(2.0 * np.arccos(_MIN_COSINE))
        self.free[beside & alike & (past >= 0.0) & (past <= piece.length_cm)] = False

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.xy_cm)


def _axis(normals: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "2"]:
    """Mean direction of unit vectors of which some point the opposite way."""
    twice = 2.0 * np.arctan2(normals[:, 1], normals[:, 0])
    angle = 0.5 * np.arctan2(np.sin(twice).mean(), np.cos(twice).mean())
    return np.array([np.cos(angle), np.sin(angle)])


def _straight(
    points_cm: Float[np.ndarray, "k 2"],
    right: Bool[np.ndarray, "k"],
    inwards: Float[np.ndarray, "2"],
    scale_cm: float,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], float]:
    """Fit a straight line robustly to the votes of both borders, each of which may be off by a constant.

    Args:
        points_cm: The votes.
        right: Which are of the border with its normal along ``inwards``.
        inwards: Roughly across the line.
        scale_cm: Scale of reweighting.

    Returns:
        A point on it, its direction, and by how much the marking is wider than was assumed.
    """
    weight = np.ones(len(points_cm))
    for _ in range(_REWEIGHTED):
        means = [(weight[side] @ points_cm[side]) / weight[side].sum() for side in (right, ~right)]
        apart = points_cm - np.where(right[:, None], means[0], means[1])
        along = np.linalg.eigh((weight * apart.T) @ apart)[1][:, 1]
        normal = left_of(along[None])[0]
        weight = 1.0 / (1.0 + (apart @ normal / scale_cm) ** 2)
    # The middle is half-way between the lines of both borders.
    aside_cm = float((means[1] - means[0]) @ normal)
    # Borders that lie further apart cast their votes short of the middle.
    wider_cm = aside_cm if inwards @ normal > 0.0 else -aside_cm
    return means[0] + 0.5 * aside_cm * normal, along, wider_cm
