"""The mouth of a side road: one line turns off at a right angle, and the lane goes straight on.

Only the shape tells it from a bend of the lane, where the other line is in glare or worn: a line turns into a
side road on a small curve, and nothing crosses the lane, as the outer line of a bend would.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.tracking.camera_view import CameraView
from lanenet.perception.network.tracking.leg import PIECE_CM, Leg, LegBorders, pieces_seen

#: Angles by which the line may turn, [rad], and radii of its curve, [cm]. Chosen.
_TURNS = np.radians([75.0, 80.0, 85.0, 90.0, 95.0, 100.0, 105.0])
_RADII_CM = (8.0, 14.0, 20.0)
#: Where the line would turn if it did so at once, along the lane, [cm].
_AT_CM = (4.0, 85.0)
#: In so many pieces it has to be seen before the curve, over so many cm, and beyond it. Chosen.
_BEFORE, _BEFORE_CM, _BEYOND = 2, 12.0, 6.0
#: Between these distances beyond, both of its borders may be seen in at most this share of the pieces of a
#: line that goes straight on, or bends so much more to that side than the lane 15 cm ahead, [1/cm]. Chosen:
#: bays lie beside a line that goes on.
_ON_CM, _ON, _BENDS = (4.0, 20.0), 0.35, (0.0, 1.0 / 150.0)
#: Which share has to be seen of the curve, with so many cm to each side of where the line would turn at once,
#: and how much larger it has to be than if it did.
_SEEN, _ABOUT_CM, _ROUNDER = 0.8, 24.0, 0.1
#: Where a bend would have its outer line, this share of it has to be in the image; markings may be seen to
#: cross the lane over at most this share of its width, up to so many widths beyond where the line would turn
#: at once.
_IN_VIEW, _CROSSED, _BEND = 0.7, 0.1, 1.4
#: So far ahead edges are still seen well enough for that, [cm]. Chosen.
_FARTHEST_CM = 90.0
#: A marking crosses the lane whose normal has at least this part along it; its borders meet, moved by half
#: its width, within this distance, [cm], with normals that are at least that opposite. As for corners of
#: tape.
_CROSSES, _MEET_CM, _OPPOSITE = 0.35, 1.3, -0.8
#: How far beside a line its borders count, [cm], and beside the lane's lines nothing that crosses does; and
#: how far about all that any do.
_NEAR_CM, _OUTER_NEAR_CM, _AROUND_CM = 1.8, 4.0, 3.0
#: There is no side road without so many borders across the lane's direction, between these distances beside
#: it, [cm], with such normals. Chosen.
_LEAST, _ASIDE_CM, _ACROSS = 25, (5.0, 45.0), 0.85
#: Two findings are the same side road within this distance, [cm]; one that was found so often is believed, if
#: the car drove on so far between, [cm]. Chosen: as for corners.
_SAME_CM, _BELIEVED, _APART_CM = 6.0, 2, 1.0
#: So many times as many frames without it as with it, and it is forgotten. Chosen: glare hides it now and
#: then.
_MISSED = 2
#: By how much the car may turn after it was found, [rad]. Chosen: more than bends turn over a lane's width.
_AWAY = 0.8
#: The lane is continued from this distance on, [cm], where its line has turned off at the last label row,
#: until it lies so many lane widths behind. Chosen: mouths are wider.
_BEGINS_CM, _BEHIND = 36.0, 1.0


class SideRoad(NamedTuple):
    """A side road.

    Attributes:
        side: On which it lies: 0 left, 1 right.
        ahead_cm: How far ahead of the front axle the lane's line turns into it.
    """

    side: int
    ahead_cm: float


class SideRoadAhead:
    """The side road that the car comes to, or passes.

    Attributes:
        road: The last one that was found, as the car sees it now.
    """

    def __init__(self) -> None:
        """Know of none."""
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self.road: SideRoad | None = None
        self._found = self._missed = 0
        self._driven_cm = self._turned_rad = 0.0

    def moved(self, travel_cm: float, turn_rad: float) -> None:
        """Take the car's motion since the last frame: how far it drove, and by how much it turned.

        A car that has turned away from the lane passes no side road of it.
        """
        if self.road is None:
            return
        self.road = self.road._replace(ahead_cm=self.road.ahead_cm - travel_cm)
        self._driven_cm += abs(travel_cm)
        self._turned_rad += turn_rad
        # Not a number where the motion is none.
        if not (abs(self._turned_rad) <= _AWAY and math.isfinite(self.road.ahead_cm)):
            self.reset()

    def look(self, found: SideRoad | None) -> None:
        """Take a frame in which the lane is not continued: what :func:`find_side_road` found in it.

        One that finds nothing speaks against what an earlier one found.
        """
        if found is None:
            self._missed += 1
            if self._missed >= _MISSED * self._found:
                self.reset()
            return
        again = (
            self.road is not None
            and found.side == self.road.side
            and abs(found.ahead_cm - self.road.ahead_cm) < _SAME_CM
        )
        if not again or self._driven_cm >= _APART_CM:
            self._found, self._driven_cm = self._found + 1 if again else 1, 0.0
            self._missed = self._missed if again else 0
        self.road, self._turned_rad = found, 0.0

    def is_here(self, width_cm: float) -> bool:
        """Return whether the car passes it, or is about to, in a lane of that width."""
        return (
            self.road is not None
            and self._found >= _BELIEVED
            and -_BEHIND * width_cm < self.road.ahead_cm < _BEGINS_CM
        )


def find_side_road(
    lines_cm: Float[np.ndarray, "2 3"],
    width_cm: float,
    markings_cm: Sequence[float],
    edges: RoadEdges,
    view: CameraView,
) -> SideRoad | None:
    """Find the next side road that a line of the lane turns into.

    Args:
        lines_cm: x of the lane's lines at the label rows if it goes straight on, frame car.
        width_cm: Its width.
        markings_cm: Width of the marking of each line, negative for one that is darker than the floor.
        edges: The frame's edge points.
        view: What the camera shows.

    Returns:
        The side road; None if there is none.
    """
    lane = Leg.between(lines_cm)
    found = []
    for side in range(len(SIDES)):
        ahead_cm = _turns_off_at(side, lane, width_cm, markings_cm, edges, view)
        if ahead_cm is not None:
            found.append(SideRoad(side, ahead_cm))
    return min(found, key=lambda road: road.ahead_cm, default=None)


def _turns_off_at(
    side: int,
    lane: Leg,
    width_cm: float,
    markings_cm: Sequence[float],
    edges: RoadEdges,
    view: CameraView,
) -> float | None:
    """Return where the line of a side turns into a side road, along the lane; None if it does not."""
    way = 1.0 if side == SIDES.index("right") else -1.0
    own = LegBorders.of(lane, width_cm, markings_cm[side], edges)
    beside_cm = way * own.right_cm - 0.5 * width_cm
    across = (np.abs(own.normal_along) > _ACROSS) & (own.along_cm > 0.0)
    across &= (beside_cm > _ASIDE_CM[0]) & (beside_cm < _ASIDE_CM[1])
    if np.count_nonzero(across) < _LEAST:
        return None
    beyond_it, best, turn, at_cm = own.where(across), 0.0, math.nan, math.nan
    for tried in _TURNS.tolist():
        beyond = beyond_it.seen_beyond(0.5 * way * width_cm, way * tried).sum(axis=1)
        # Places are told by where the lane's middle would turn.
        first_cm = 0.5 * width_cm * math.tan(0.5 * tried)
        places_cm = np.arange(len(beyond)) / math.sin(tried) - first_cm
        beyond[(places_cm < _AT_CM[0]) | (places_cm > _AT_CM[1])] = 0.0
        place = int(beyond.argmax())
        if beyond[place] > best:
            best, turn, at_cm = float(beyond[place]), tried, float(places_cm[place])
    if best < _BEYOND:
        return None
    near = own.where(np.hypot(beside_cm, own.along_cm - at_cm) < _ABOUT_CM + _AROUND_CM)
    # Without a curve it is a corner of tape.
    sharp, *seen = (
        _seen_of_curve(near, way, width_cm, turn, at_cm, radius_cm) for radius_cm in (0.0, *_RADII_CM)
    )
    if max(seen) < max(_SEEN, sharp + _ROUNDER):
        return None
    radius_cm = _RADII_CM[seen.index(max(seen))]
    begins_cm = at_cm - radius_cm * math.tan(0.5 * turn)
    straight = own.seen_straight(0.5 * way * width_cm)
    if pieces_seen(straight, begins_cm - _BEFORE_CM, begins_cm) < _BEFORE:
        return None
    if _goes_on(own, way, width_cm, at_cm):
        return None
    # The outer line of such a bend crosses the lane, at the latest where it turns at once, too.
    if at_cm + width_cm * math.tan(0.5 * turn) > _FARTHEST_CM:
        return None
    outer_cm = _curve(way, -0.5 * width_cm, 0.5 * width_cm, turn, at_cm, radius_cm, 0.0, 10.0)[0]
    in_lane = outer_cm[np.abs(outer_cm[:, 0]) < 0.5 * width_cm]
    if view.shows(lane.on_road(in_lane)).mean() < _IN_VIEW:
        return None
    other = LegBorders.of(lane, width_cm, markings_cm[1 - side], edges)
    crossed = _crossed(other, way, width_cm, begins_cm, at_cm + _BEND * width_cm)
    return at_cm if crossed <= _CROSSED else None


def _crossed(other: LegBorders, way: float, width_cm: float, from_cm: float, to_cm: float) -> float:
    """Return over which share of its width markings are seen to cross a lane, between two places."""
    across_cm = 0.5 * width_cm + way * other.right_cm
    here = (across_cm > _OUTER_NEAR_CM) & (across_cm < width_cm - _OUTER_NEAR_CM)
    here &= (other.along_cm > from_cm) & (other.along_cm < to_cm) & (np.abs(other.normal_along) > _CROSSES)
    right_cm, along_cm, normal_right, normal_along = other.where(here)
    apart2 = (right_cm - right_cm[:, None]) ** 2 + (along_cm - along_cm[:, None]) ** 2
    opposite = normal_right * normal_right[:, None] + normal_along * normal_along[:, None] < _OPPOSITE
    of_marking = (opposite & (apart2 < _MEET_CM * _MEET_CM)).any(axis=1)
    pieces = max(1, int((width_cm - 2.0 * _OUTER_NEAR_CM) / PIECE_CM))
    seen = np.zeros(pieces, np.bool_)
    piece = ((across_cm[here][of_marking] - _OUTER_NEAR_CM) / PIECE_CM).astype(np.int64)
    seen[np.minimum(piece, pieces - 1)] = True
    return float(seen.mean())


def _goes_on(own: LegBorders, way: float, width_cm: float, at_cm: float) -> bool:
    """Return whether a line is seen beyond a place on itself, straight on or in a bend, as beside bays."""
    on_cm = np.arange(at_cm + _ON_CM[0], at_cm + _ON_CM[1], PIECE_CM)
    for per_cm in _BENDS:
        slope = way * per_cm * (on_cm - ROWS_CM[1])
        path_cm = np.stack([0.5 * way * width_cm + 0.5 * slope * (on_cm - ROWS_CM[1]), on_cm], axis=1)
        directions = np.stack([slope, np.ones(len(on_cm))], axis=1) / np.hypot(1.0, slope)[:, None]
        if np.mean(own.seen_along(path_cm, directions, _NEAR_CM) == 1.0) > _ON:
            return True
    return False


def _seen_of_curve(
    near: LegBorders, way: float, width_cm: float, turn: float, at_cm: float, radius_cm: float
) -> float:
    """Return how much is seen of a line with a curve of a radius, before it, on it and beyond it."""
    tangent_cm = radius_cm * math.tan(0.5 * turn)
    about_cm = _ABOUT_CM - tangent_cm
    path = _curve(way, 0.5 * width_cm, 0.5 * width_cm, turn, at_cm, radius_cm, about_cm, about_cm)
    return float(near.seen_along(*path, _NEAR_CM).mean())


def _curve(
    way: float,
    aside_cm: float,
    own_cm: float,
    turn: float,
    at_cm: float,
    radius_cm: float,
    before_cm: float,
    beyond_cm: float,
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]]:
    """Return the pieces of a line parallel to one that turns off.

    Args:
        way: Where that turns to: -1 left, 1 right.
        aside_cm: How far the parallel one lies beside the lane's middle there, towards where it turns.
        own_cm: How far the one that turns does.
        turn: By how much it turns, [rad].
        at_cm: Where it would turn if it did so at once, along the lane.
        radius_cm: Of its curve.
        before_cm: Length before the curve.
        beyond_cm: Length beyond it.

    Returns:
        Middles of the pieces, right of the lane's middle and along it, and their directions.
    """
    centre_cm, begins_cm = own_cm + radius_cm, at_cm - radius_cm * math.tan(0.5 * turn)
    around_cm, half = centre_cm - aside_cm, 0.5 * PIECE_CM
    before, beyond = np.arange(half - before_cm, 0.0, PIECE_CM), np.arange(half, beyond_cm, PIECE_CM)
    pieces = math.ceil(around_cm * turn / PIECE_CM)
    arc = (np.arange(pieces) + 0.5) * turn / max(pieces, 1)
    angles = np.concatenate([np.zeros(len(before)), arc, np.full(len(beyond), turn)])
    straight_cm = np.concatenate([before, np.zeros(pieces), beyond])
    ahead = np.stack([way * np.sin(angles), np.cos(angles)], axis=1)
    centre = np.array([way * centre_cm, begins_cm])
    outwards = np.stack([-way * np.cos(angles), np.sin(angles)], axis=1)
    return centre + around_cm * outwards + straight_cm[:, None] * ahead, ahead
