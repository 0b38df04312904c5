"""A straight piece of a lane, and what is seen of lines beside and beyond it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.frames import car_from_map, map_from_car, wrap_angle
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import RoadEdges

#: What is looked at about a leg: y along it, [cm], and how far beside it, in widths.
_NEAR_CM, _FAR_CM, _BESIDE = -15.0, 100.0, 2.0
#: Length of a piece in which a line is seen or not, [cm]; pieces beyond a corner; and how many places of it
#: are tried, 1 cm apart across the lane beyond.
PIECE_CM, _PIECES, _PLACES = 3.0, 12, 90
#: A piece counts whole in which both borders of the marking are seen, and this much with one of them. Tried,
#: with turns in all directions: with 0.3, 0.4 and 0.5 34, 37 and 39 of 52 corners were found on eight roads.
_ONE_BORDER = 0.5
#: A border belongs to a straight line within this distance, at y = 0 and its growth per cm ahead, and from
#: these cosines on: of a straight line, and of a path that bends.
_NEAR_LINE_CM, _NEAR_LINE_GROWTH, _COSINE, _PATH_COSINE = 2.0, 0.03, 0.9, 0.85


class Leg(NamedTuple):
    """A straight piece of a lane.

    Attributes:
        x: Of a point in its middle, frame car, [cm].
        y: Likewise.
        angle: Its direction, clockwise from straight ahead, [rad].
    """

    x: float
    y: float
    angle: float

    @classmethod
    def between(cls, lines_cm: Float[np.ndarray, "2 3"]) -> Leg:
        """Take the straight lane between two lines, given by x at the label rows, frame car."""
        near_cm, _, far_cm = lines_cm.mean(axis=0).tolist()
        return cls(near_cm, ROWS_CM[0], math.atan2(far_cm - near_cm, ROWS_CM[-1] - ROWS_CM[0]))

    @property
    def away_rad(self) -> float:
        """By how much it leads away from straight ahead, to either side."""
        return abs(float(wrap_angle(np.array(self.angle))))

    @property
    def ahead(self) -> Float[np.ndarray, "2"]:
        """Its direction."""
        return np.array([math.sin(self.angle), math.cos(self.angle)])

    def seen_from(
        self, points_cm: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Return how far points of the road lie to the right of the middle, and how far along it."""
        (sine, cosine), (x, y) = self.ahead, (points_cm - [self.x, self.y]).T
        return x * cosine - y * sine, x * sine + y * cosine

    def on_road(self, places_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return points of the road, frame car, by how far right of the middle and along it they lie."""
        sine, cosine = self.ahead
        return places_cm @ np.array([[cosine, -sine], [sine, cosine]]) + [self.x, self.y]

    def at(self, right_cm: float, along_cm: float) -> Float[np.ndarray, "2"]:
        """Return one point of the road, frame car."""
        return self.on_road(np.array([[right_cm, along_cm]]))[0]

    def moved(self, pose: Float[np.ndarray, "3"], wheelbase_cm: float) -> Leg:
        """Return it as the car sees it from where it has driven to, by its pose in its own former frame."""
        before_cm = map_from_car(np.array([[self.x, self.y]]), np.zeros(3), wheelbase_cm)
        ((x, y),) = car_from_map(before_cm, pose, wheelbase_cm).tolist()
        return Leg(x, y, self.angle + float(pose[2]))


class LegBorders(NamedTuple):
    """Edge points moved to the middle of a marking, as a leg of the lane sees them, and their normals."""

    right_cm: Float[np.ndarray, "n"]
    along_cm: Float[np.ndarray, "n"]
    normal_right: Float[np.ndarray, "n"]
    normal_along: Float[np.ndarray, "n"]

    @classmethod
    def of(cls, leg: Leg, width_cm: float, marking_cm: float, edges: RoadEdges) -> LegBorders:
        """Take those about the leg."""
        normals = edges.normals.astype(np.float64)
        right_cm, along_cm = leg.seen_from(edges.points_cm + 0.5 * marking_cm * normals)
        near = (along_cm > _NEAR_CM) & (along_cm < _FAR_CM) & (np.abs(right_cm) < _BESIDE * width_cm)
        direction = Leg(0.0, 0.0, leg.angle)
        return cls(right_cm[near], along_cm[near], *direction.seen_from(normals[near]))

    def where(self, here: Bool[np.ndarray, "n"]) -> LegBorders:
        """Return some of them."""
        return LegBorders(*(values[here] for values in self))

    def seen_straight(self, aside_cm: float) -> Bool[np.ndarray, "b"]:
        """Return in which pieces along the leg a line is seen that many cm to the right of the middle."""
        limit_cm = _NEAR_LINE_CM + _NEAR_LINE_GROWTH * np.abs(self.along_cm)
        own = (np.abs(self.right_cm - aside_cm) < limit_cm) & (np.abs(self.normal_right) > _COSINE)
        seen = np.zeros(int((_FAR_CM - _NEAR_CM) / PIECE_CM) + 1, np.bool_)
        seen[((self.along_cm[own] - _NEAR_CM) / PIECE_CM).astype(np.int64)] = True
        return seen

    def seen_beyond(self, aside_cm: float, turn: float) -> Float[np.ndarray, "p b"]:
        """Return how a line is seen in the pieces beyond each of the corners that it may have."""
        sine, cosine = math.sin(turn), math.cos(turn)
        # Where the line through each point that has turned leaves the straight one, along this.
        beyond_cm = aside_cm - (self.right_cm * cosine - self.along_cm * sine)
        leaves_cm = beyond_cm / sine - aside_cm * math.tan(0.5 * turn)
        further_cm = (self.right_cm - aside_cm) * sine + (self.along_cm - leaves_cm) * cosine
        facing = self.normal_right * cosine - self.normal_along * sine
        place, piece = np.abs(beyond_cm).astype(np.int64), np.floor(further_cm / PIECE_CM).astype(np.int64)
        counts = (np.abs(facing) > _COSINE) & (beyond_cm * sine > 0.0) & (place < _PLACES)
        counts &= (piece >= 0) & (piece < _PIECES)
        borders = np.zeros((2, _PLACES, _PIECES), np.bool_)
        borders[(facing > 0.0).astype(np.int64)[counts], place[counts], piece[counts]] = True
        borders[:, 1:] |= borders[:, :-1].copy()
        return _of_both(borders)

    def seen_along(
        self,
        path_cm: Float[np.ndarray, "k 2"],
        directions: Float[np.ndarray, "k 2"],
        near_cm: float,
    ) -> Float[np.ndarray, "k"]:
        """Return how a line is seen in the pieces of a path.

        Args:
            path_cm: Middles of its pieces: right of the leg's middle, and along it.
            directions: Where it leads there, likewise.
            near_cm: How far beside it a border may lie.
        """
        apart_right = self.right_cm[:, None] - path_cm[:, 0]
        apart_along = self.along_cm[:, None] - path_cm[:, 1]
        piece = (apart_right * apart_right + apart_along * apart_along).argmin(axis=1)
        every = np.arange(len(piece))
        ahead_right, ahead_along = directions[piece].T
        right_cm, along_cm = apart_right[every, piece], apart_along[every, piece]
        beside_cm = right_cm * ahead_along - along_cm * ahead_right
        further_cm = right_cm * ahead_right + along_cm * ahead_along
        facing = self.normal_right * ahead_along - self.normal_along * ahead_right
        own = (
            (np.abs(beside_cm) < near_cm) & (np.abs(further_cm) < PIECE_CM) & (np.abs(facing) > _PATH_COSINE)
        )
        borders = np.zeros((2, len(path_cm)), np.bool_)
        borders[(facing > 0.0).astype(np.int64)[own], piece[own]] = True
        return _of_both(borders)


def _of_both(borders: Bool[np.ndarray, "2 ..."]) -> Float[np.ndarray, "..."]:
    """Return how a line is seen whose two borders are seen, or are not."""
    return np.where(borders.all(axis=0), 1.0, np.where(borders.any(axis=0), _ONE_BORDER, 0.0))


def pieces_seen(seen: Bool[np.ndarray, "b"], from_cm: float, to_cm: float) -> int:
    """Return in how many pieces of :meth:`LegBorders.seen_straight` a line is seen between two places."""
    first, end = (max(round((at_cm - _NEAR_CM) / PIECE_CM), 0) for at_cm in (from_cm, to_cm))
    return int(np.count_nonzero(seen[first:end]))
