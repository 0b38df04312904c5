"""Chains of straight pieces of tape: where the ends of two pieces meet, the marking turns in a corner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from datagen.lanes.tape import BENT, SHORTEST, Piece

#: Whether a marking of a width lies along a straight way from one point to another, place by place.
OnMarking = Callable[[Float[np.ndarray, "2"], Float[np.ndarray, "2"], float], Bool[np.ndarray, "m"]]

#: Least and largest turn of a corner. Chosen: a cubic follows less, and pieces of one straight are not quite
#: parallel; more is no road.
_LEAST_RAD, _MOST_RAD = np.deg2rad(8.0), np.deg2rad(120.0)
#: Least turn of a corner relative to that of an arc from the middle of one of its pieces, which bends, to the
#: other one. Derived: chords of an arc turn by up to twice as much; the rest is margin.
_SHARPER = 3.0
#: Least turn of a corner between pieces as long as the camera is high; shorter ones need more. Derived: an
#: arc that turns by half of this over a piece bends it by 0.3 / 8 of that as root mean square, as much as it
#: may; the rest is what the arc turns between the pieces.
_HIDDEN_RAD = 2.0 * 8.0 / 0.3 * BENT
#: Longest way from the end of a piece to a corner, and how far a piece may go on beyond it, in camera
#: heights. Chosen: borders are hidden or blurred about a corner; tape is laid over the end of another.
_AHEAD, _BEYOND = 0.8, 0.4
#: Largest distance aside of two pieces of one straight where they meet, in camera heights. Chosen: twice the
#: offset up to which a marking lies on a line.
_ASIDE = 0.06
#: Length on either side of a corner that has to be seen, in camera heights, and least share of its places.
#: Chosen: 9 cm at 18 cm.
_TIP, _ON_TIP = 0.5, 0.6
#: Least length of a piece that is left between two corners, in camera heights. Chosen: half of the shortest.
_LEFT = 0.5 * SHORTEST


@dataclass(frozen=True)
class Chain:
    """Straight pieces that follow each other: where the first begins, the corners, and where the last ends.

    Attributes:
        points_cm: These points, frame map.
        markings_cm: Width of the tape between each of them and the next one.
    """

    points_cm: Float[np.ndarray, "k 2"]
    markings_cm: Float[np.ndarray, "g"]

    @property
    def lengths_cm(self) -> Float[np.ndarray, "k"]:
        """Distance of its points from the beginning, along it."""
        steps = np.linalg.norm(np.diff(self.points_cm, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def closed(self) -> bool:
        """Whether it ends where it begins, in the middle of a piece."""
        return len(self.points_cm) > 3 and bool(np.all(self.points_cm[0] == self.points_cm[-1]))

    def begun_at(self, past_cm: float) -> Chain:
        """The same closed chain, from another place on it."""
        piece = int(np.searchsorted(self.lengths_cm, past_cm, side="right")) - 1
        begin = self.at(np.array([past_cm]))
        # Its seam is no corner: the first piece and the last are halves of one.
        points = [begin, self.points_cm[piece + 1 : -1], self.points_cm[1 : piece + 1], begin]
        markings = [self.markings_cm[piece:-1], self.markings_cm[: piece + 1]]
        if piece in (0, len(self.markings_cm) - 1):
            markings = [self.markings_cm]
        return Chain(np.concatenate(points), np.concatenate(markings))

    def at(self, past_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m 2"]:
        """Points at distances from its beginning."""
        lengths = self.lengths_cm
        return np.stack([np.interp(past_cm, lengths, self.points_cm[:, i]) for i in range(2)], axis=1)


def chains_of(
    pieces: list[Piece],
    ahead: Callable[[Piece], bool | None],
    on_marking: OnMarking,
    camera_height_cm: float,
) -> list[Chain]:
    """Join pieces to chains, from the longest piece on in both directions.

    Args:
        pieces: The pieces.
        ahead: Whether a piece runs in the direction of the line; None where it runs across, so that only
            its neighbours tell.
        on_marking: Whether the marking lies along a straight way; decides which corners there are.
        camera_height_cm: Sets the scale of bounds.
    """
    joiner = _Joiner(on_marking, camera_height_cm)
    left = sorted(pieces, key=lambda piece: -piece.length_cm)
    chains, skipped = [], []
    while left:
        first = left.pop(0)
        along = ahead(first)
        if along is None:
            skipped.append(first)
            continue
        rest = left + skipped
        first = first if along else first.turned()
        points, markings, rest = joiner.walk(first, rest, first)
        if len(points) == 1 or points[-1] is not points[0]:
            # Backward is forward the other way round, on what is left of the piece.
            backward, widths, rest = joiner.walk(_from(points[0], first.turned()), rest)
            points = [*reversed(backward), *points]
            markings = [*reversed(widths[1:]), *markings]
        chains.append(Chain(np.array(points), np.array(markings)))
        left = [piece for piece in left if any(piece is other for other in rest)]
        skipped = [piece for piece in skipped if any(piece is other for other in rest)]
    return chains


@dataclass(frozen=True)
class _Joiner:
    on_marking: OnMarking
    height_cm: float

    def walk(
        self, piece: Piece, others: list[Piece], home: Piece | None = None
    ) -> tuple[list[Float[np.ndarray, "2"]], list[float], list[Piece]]:
        """Go from piece to piece as long as they meet.

        Args:
            piece: The piece to begin with.
            others: Pieces to go to, either way round.
            home: A piece that ends the walk, where it is met.

        Returns:
            The corners and the end, the widths of the pieces before each, and the pieces that were not used.
            Where it ends at home, the middle of that piece is the first point and the last one.
        """
        points: list[Float[np.ndarray, "2"]] = []
        markings = [piece.marking_cm]
        while True:
            best: tuple[float, Piece, Float[np.ndarray, "2"]] | None = None
            for following in [turned for other in others for turned in (other, other.turned())] + (
                [home] if home is not None and points else []
            ):
                meet = self._meet(piece, following)
                if meet is None:
                    continue
                length = float((following.end_cm - meet) @ following.along)
                if (best is None or length > best[0]) and self._seen(piece, meet, following):
                    best = length, following, meet
            if best is None:
                return [*points, piece.end_cm], markings, others
            _, following, meet = best
            points.append(meet)
            markings.append(following.marking_cm)
            if following is home:
                middle = 0.5 * (home.begin_cm + home.end_cm)
                return [middle, *points, middle], markings, others
            others = [other for other in others if not other.same(following)]
            piece = _from(meet, following)

    def _meet(self, before: Piece, after: Piece) -> Float[np.ndarray, "2"] | None:
        """Where one piece goes over into another one; None where it does not."""
        h, one, two = self.height_cm, before.along, after.along
        apart = after.begin_cm - before.end_cm
        if np.linalg.norm(apart) > 2.0 * _AHEAD * h + min(before.length_cm, after.length_cm):
            return None
        turn = np.arctan2(one[0] * two[1] - one[1] * two[0], one @ two)
        if abs(turn) > _MOST_RAD:
            return None
        if abs(turn) >= _LEAST_RAD:
            ways = np.linalg.solve(np.column_stack([one, two]), apart)
            if min(ways) < -_BEYOND * h or max(ways) > _AHEAD * h:
                return None
            if abs(turn) < _HIDDEN_RAD * h / min(before.length_cm, after.length_cm):
                return None
            if abs(turn) < _SHARPER * _arc_rad(before, after, float(np.maximum(ways, 0.0).sum()), turn):
                return None
            meet = before.end_cm + ways[0] * one
        else:
            gap = apart @ (one + two) / np.linalg.norm(one + two)
            if gap > _AHEAD * h or _arc_rad(before, after, max(gap, 0.0), turn) > _LEAST_RAD / _SHARPER:
                return None
            ends = before.end_cm + 0.5 * gap * one, after.begin_cm - 0.5 * gap * two
            if np.linalg.norm(ends[1] - ends[0]) > _ASIDE * h:
                return None
            meet = 0.5 * (ends[0] + ends[1])
        left = (meet - before.begin_cm) @ one, (after.end_cm - meet) @ two
        return meet if min(left) > _LEFT * h else None

    def _seen(self, before: Piece, meet_cm: Float[np.ndarray, "2"], after: Piece) -> bool:
        """Whether the marking lies on both pieces up to where they meet."""
        tip_cm = _TIP * self.height_cm
        ways = (before, before.begin_cm, -before.along), (after, after.end_cm, after.along)
        found = []
        for piece, end_cm, along in ways:
            length_cm = min(tip_cm, float(np.linalg.norm(end_cm - meet_cm)))
            found.append(self.on_marking(meet_cm, meet_cm + length_cm * along, piece.marking_cm))
        return all(on.mean() >= _ON_TIP for on in found)


def _from(begin_cm: Float[np.ndarray, "2"], piece: Piece) -> Piece:
    """What is left of a piece from a point on; it bends by so much less."""
    left = float(np.linalg.norm(piece.end_cm - begin_cm)) / piece.length_cm
    return replace(piece, begin_cm=begin_cm, bend_rad=left * piece.bend_rad)


def _arc_rad(before: Piece, after: Piece, gap_cm: float, turn_rad: float) -> float:
    """By how much an arc turns between two pieces, the way that they do, if one of them is a chord of it."""
    sign = np.sign(turn_rad)
    return max(float(sign * piece.bend_rad) * (0.5 + gap_cm / piece.length_cm) for piece in (before, after))
