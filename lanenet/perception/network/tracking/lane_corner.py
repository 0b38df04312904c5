"""A sharp corner of the lane: both of its lines turn there, and the car is led around it.

At the label rows the inner line of such a corner has turned away, out of view beside the car, while the outer
one still goes straight on. So the corner is looked for where both are seen to turn, further ahead, and kept
beside the car's own motion until it lies behind. At a junction one line turns without the other: there the
outer one does not lead up to the corner and on from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.lane import ROWS_CM, SIDES, rows_of_polyline
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.corner import Corner
from lanenet.perception.network.tracking.leg import PIECE_CM, Leg, LegBorders, pieces_seen

#: Least angle of a corner, [rad]: the rest are bends, which the lines at the label rows show. On 160 roads of
#: one seed all of the eleven findings that were more than 4 cm off had been below 37 degrees.
_LEAST_TURN = math.radians(38.0)
#: By how much a corner of the lane may turn by more or less than that of a line, [rad]. Chosen.
_TRIED_TURNS = np.radians([-12.0, -8.0, -4.0, 0.0, 4.0, 8.0, 12.0])
#: In so many pieces has the inner and the outer line to be seen beyond the corner, and both; the inner one in
#: more where the corner is beside the car, since stop lines lead to such places. Chosen.
_INNER, _OUTER, _BOTH, _INNER_BESIDE, _BESIDE_CM = 2.0, 3.0, 8.0, 4.0, 8.0
#: The outer line is seen within so much before and after its corner, [cm]. It is none where one of them goes
#: straight on beyond, over more than so many pieces between these distances, or both together do, further on.
#: Chosen: with at most four of each up to 60 cm a fifth less corners are found.
_AT_CORNER_CM, _BEYOND_CM, _GOES_ON, _FURTHER_CM, _GO_ON = 9.0, (4.0, 22.0), 3, (4.0, 60.0), 8
#: Where the outer line's corner may be, ahead of the front axle. Chosen.
_CORNERS_CM = (8.0, 80.0)
#: From this cosine on a border belongs to a line that is fitted.
_FIT_COSINE = 0.85
#: Distances, [cm], up to which borders count when a corner is fitted for the first time, and later those of
#: the lane before and beyond it; distance that takes half of a border's weight; between which distances from
#: the corner they count; and the least number of them. Chosen.
_FIRST_CM, _AGAIN_CM, _CAUCHY_CM = (3.0, 1.5, 1.0), (3.0, 2.0), 0.7
_CLEAR_CM, _REACH_CM, _LEAST = 2.0, 40.0, 12
#: Lines whose borders within so many cm bend by more than this, [1/cm], over so many cm, are those of a bend.
#: Chosen: with it none of 448 right-angled bends of 13 to 65 cm about the middle is taken for a corner; 16 of
#: 182 findings of corners are lost, and four of six that were more than 4 cm off.
_BENT_CM, _BENDS, _BENT_OVER_CM = 5.0, 0.006, 15.0
#: Stiffness of a fit: against moving and against turning, and the largest turn at once, [rad]. Chosen.
_STIFF, _STIFF_TURN, _TURN_AT_ONCE = 1e-3, 50.0, 0.1
#: Two findings are the same corner within this distance, [cm], and angle, [rad]; one that was found so often
#: is believed, if the car drove on so far between, [cm]; it begins once the inner line's corner is so near.
#: Chosen: before the last label row is there.
_SAME_CM, _SAME_TURN, _BELIEVED, _APART_CM, _BEGINS_CM = 6.0, 0.2, 2, 1.0, 36.0
#: The car is around it once both lines' corners are behind the front axle, and the lane goes on within this
#: angle. It is given up if nothing of what is beyond has been seen over so many cm, ahead and on the way, or
#: in so many frames, since a caller may have stopped to tell the car's motion; after so many cm in all; where
#: the lane would lead back; and where it has become no corner. Chosen.
_AROUND, _BACK, _NONE = 0.45, 2.2, 0.5 * _LEAST_TURN
_UNSEEN_CM, _UNSEEN_ON_THE_WAY_CM, _UNSEEN_FRAMES, _FARTHEST_CM = 45.0, 60.0, 40, 200.0
#: Sigma of a line, across it, [cm], before the share that a tracker claims, and its growth per cm in which
#: nothing of it was seen. On 28 simulated roads, on which the corners' rules were chosen, 91, 91 and 87 % of
#: 8068 points at 0, 15 and 30 cm lay within one sigma, and 99, 99 and 98 % within two: real cameras are known
#: less closely.
_SIGMA_CM, _GROWTH = 0.7, 0.04
#: Points on a line that runs at more than this angle across the car's direction are not answered, [rad].
_STEEPEST = math.radians(45.0)
#: Length of a line before and beyond its corner, [cm]: more than label rows see.
_LENGTH_CM = 90.0
#: Which way from the lane's middle its lines are: the left one, the right one.
_WAYS = (-1.0, 1.0)


class LaneCorner(NamedTuple):
    """A lane that turns at once.

    Attributes:
        before: The lane up to the corner.
        after: The lane from there on.
        width_cm: Its width.
    """

    before: Leg
    after: Leg
    width_cm: float

    @property
    def turn(self) -> float:
        """By how much it turns to the right, [rad]."""
        return float(wrap_angle(np.array(self.after.angle - self.before.angle)))

    def place_cm(self, way: float) -> Float[np.ndarray, "2"]:
        """Return where a line has its corner, frame car: left -1, right 1, the middle 0."""
        aside_cm = 0.5 * way * self.width_cm
        (right_cm,), _ = self.after.seen_from(self.before.at(aside_cm, 0.0)[None])
        # On the way along the lane before, the distance to the lane beyond changes by the sine of the angle.
        return self.before.at(aside_cm, (right_cm - aside_cm) / math.sin(self.turn))

    def line_cm(self, way: float) -> Float[np.ndarray, "3 2"]:
        """Return a line, or the middle, from before the corner to beyond it, frame car."""
        place_cm = self.place_cm(way)
        back_cm, on_cm = -_LENGTH_CM * self.before.ahead, _LENGTH_CM * self.after.ahead
        return np.array([place_cm + back_cm, place_cm, place_cm + on_cm])

    def is_like(self, other: LaneCorner) -> bool:
        """Return whether another finding is the same corner."""
        apart_cm = max(math.dist(self.place_cm(way), other.place_cm(way)) for way in _WAYS)
        return apart_cm < _SAME_CM and abs(self.turn - other.turn) < _SAME_TURN


class CornerAhead:
    """The corner that the car comes to, or is led around.

    Attributes:
        corner: The last one that was found, as the car sees it now.
        on: Whether the car is led around it.
        is_behind: Whether it came around the last one, which was not given up.
    """

    def __init__(self) -> None:
        """Know of none."""
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self.corner: LaneCorner | None = None
        self.on = self.is_behind = False
        self._found = self._unseen_frames = 0
        self._driven_cm = self._unseen_cm = 0.0

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        """Take the car's motion since the last frame, as :class:`lanenet.perception.estimate.TakesMotion`."""
        if self.corner is None:
            return
        half_rad = 0.5 * turn_rad
        pose = np.array([travel_cm * math.cos(half_rad), travel_cm * math.sin(half_rad), turn_rad])
        if not np.isfinite(pose).all():
            self.reset()
            return
        before, after, width_cm = self.corner
        self.corner = LaneCorner(before.moved(pose, wheelbase_cm), after.moved(pose, wheelbase_cm), width_cm)
        self._driven_cm += abs(travel_cm)
        self._unseen_cm += abs(travel_cm)

    def look(self, found: LaneCorner | None) -> None:
        """Take a frame before the corner: what :func:`find_corner` found in it."""
        if found is not None:
            again = self.corner is not None and found.is_like(self.corner)
            if not again or self._driven_cm >= _APART_CM:
                self._found, self._driven_cm = self._found + 1 if again else 1, 0.0
            self.corner, self._unseen_cm = found, 0.0
        if self.corner is None:
            return
        if self._unseen_cm > _UNSEEN_CM:
            self.reset()
            return
        inner = math.copysign(1.0, self.corner.turn)
        self.on = self._found >= _BELIEVED and float(self.corner.place_cm(inner)[1]) < _BEGINS_CM

    def follow(self, markings_cm: Sequence[float], edges: RoadEdges) -> bool:
        """Take a frame on the way around the corner.

        Args:
            markings_cm: Width of the marking of each line, negative for one that is darker than the floor.
            edges: The frame's edge points.

        Returns:
            Whether the way goes on.
        """
        assert self.corner is not None
        before_cm, after_cm = _AGAIN_CM
        before, count = _fitted(self.corner, False, markings_cm, edges, before_cm)
        if count >= _LEAST:
            self.corner = self.corner._replace(before=before)
        if abs(self.corner.turn) < _NONE:
            self.on = False
            return False
        after, count = _fitted(self.corner, True, markings_cm, edges, after_cm)
        if count >= _LEAST:
            self.corner, self._unseen_cm = self.corner._replace(after=after), 0.0
        self._unseen_frames = 0 if count >= _LEAST else self._unseen_frames + 1
        unseen = self._unseen_cm > _UNSEEN_ON_THE_WAY_CM or self._unseen_frames > _UNSEEN_FRAMES
        too_long = self._driven_cm > _FARTHEST_CM
        self.is_behind = self._is_around()
        self.on = not (unseen or too_long or self.corner.after.away_rad > _BACK or self.is_behind)
        return self.on

    def _is_around(self) -> bool:
        assert self.corner is not None
        return self.corner.after.away_rad < _AROUND and all(
            self.corner.place_cm(way)[1] < 0.0 for way in _WAYS
        )

    def lane(self) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "2 3"]]:
        """Return the lines at the label rows and their sigmas.

        NaN and infinite where a line does not cross the row, or runs along it: its place is not told by x.
        """
        assert self.corner is not None
        across_cm = math.hypot(_SIGMA_CM, _GROWTH * self._unseen_cm)
        points_cm, sigma_cm = (
            np.full((len(SIDES), len(ROWS_CM)), np.nan),
            np.full((len(SIDES), len(ROWS_CM)), np.inf),
        )
        for side, way in enumerate(_WAYS):
            line_cm = self.corner.line_cm(way)
            for leg, piece_cm in ((self.corner.before, line_cm[:2]), (self.corner.after, line_cm[1:])):
                crossed_cm = rows_of_polyline(piece_cm)
                here = np.isfinite(crossed_cm) & (leg.away_rad < _STEEPEST)
                points_cm[side, here], sigma_cm[side, here] = (
                    crossed_cm[here],
                    across_cm / math.cos(leg.angle),
                )
        return points_cm, sigma_cm

    def lane_beyond(self) -> Float[np.ndarray, "2 3"] | None:
        """Return the lines beyond the corner at the label rows; None where they run along these."""
        assert self.corner is not None
        after = self.corner.after
        if after.away_rad > _STEEPEST:
            return None
        aside_cm = 0.5 * self.corner.width_cm / math.cos(after.angle)
        middle_cm = after.x + (np.array(ROWS_CM) - after.y) * math.tan(after.angle)
        return np.array([middle_cm - aside_cm, middle_cm + aside_cm])


def find_corner(
    lines_cm: Float[np.ndarray, "2 3"],
    width_cm: float,
    markings_cm: Sequence[float],
    hints: Sequence[Corner | None],
    edges: RoadEdges,
) -> LaneCorner | None:
    """Find the corner of a lane, by what is seen of both of its lines before and beyond it.

    Args:
        lines_cm: x of the lane's lines at the label rows if it goes straight on, frame car.
        width_cm: Its width.
        markings_cm: Width of the marking of each line, negative for one that is darker than the floor.
        hints: The corners of these lines, see :func:`lanenet.perception.network.corner.corners`.
        edges: The frame's edge points.

    Returns:
        The corner; None if there is none.
    """
    turns = [turn for hint in hints if hint is not None for turn in _tried_turns(hint)]
    if not turns:
        return None
    before = Leg.between(lines_cm)
    borders = [LegBorders.of(before, width_cm, marking_cm, edges) for marking_cm in markings_cm]
    straight = [line.seen_straight(0.5 * way * width_cm) for way, line in zip(_WAYS, borders, strict=True)]
    best, best_start_cm, best_turn = -math.inf, math.nan, math.nan
    for turn in turns:
        inner = SIDES.index("right") if turn > 0.0 else SIDES.index("left")
        seen = [
            line.seen_beyond(0.5 * way * width_cm, turn) for way, line in zip(_WAYS, borders, strict=True)
        ]
        of_inner, of_outer = seen[inner].sum(axis=1), seen[1 - inner].sum(axis=1)
        at_corner = seen[1 - inner][:, : round(_AT_CORNER_CM / PIECE_CM)].any(axis=1)
        likely = at_corner & (of_inner >= _INNER) & (of_outer >= _OUTER) & (of_inner + of_outer >= _BOTH)
        ahead_cm = 0.5 * width_cm * math.tan(0.5 * abs(turn))
        for place in np.flatnonzero(likely).tolist():
            start_cm, score = place / abs(math.sin(turn)), float(of_inner[place] + of_outer[place])
            inner_cm, outer_cm = start_cm - ahead_cm, start_cm + ahead_cm
            is_corner = (
                score > best
                and _CORNERS_CM[0] < outer_cm < _CORNERS_CM[1]
                and (inner_cm >= _BESIDE_CM or of_inner[place] >= _INNER_BESIDE)
                and pieces_seen(straight[1 - inner], outer_cm - _AT_CORNER_CM, outer_cm) > 0
                and not _go_straight_on(straight[inner], inner_cm, straight[1 - inner], outer_cm)
            )
            if is_corner:
                best, best_start_cm, best_turn = score, start_cm, turn
    if math.isnan(best_turn):
        return None
    x, y = before.at(0.0, best_start_cm).tolist()
    found = LaneCorner(before, Leg(x, y, before.angle + best_turn), width_cm)
    for gate_cm in _FIRST_CM:
        after, count = _fitted(found, True, markings_cm, edges, gate_cm)
        if count < _LEAST:
            return None
        found = found._replace(after=after)
        if abs(found.turn) < _LEAST_TURN:
            return None
    bends = (abs(_bend_per_cm(found, is_after, markings_cm, edges)) > _BENDS for is_after in (True, False))
    return None if any(bends) else found


def _tried_turns(hint: Corner) -> list[float]:
    """Return the angles of a lane's corner that one of its lines speaks for."""
    turn = math.copysign(math.acos(min(1.0, max(-1.0, hint.cosine))), hint.aside_cm)
    return [turn + more for more in _TRIED_TURNS.tolist() if _LEAST_TURN < abs(turn + more) < _BACK]


def _go_straight_on(
    inner: Bool[np.ndarray, "b"], inner_cm: float, outer: Bool[np.ndarray, "b"], outer_cm: float
) -> bool:
    """Return whether lines are seen straight on beyond the places of their corners."""
    near, far = (
        [pieces_seen(inner, inner_cm + a, inner_cm + b), pieces_seen(outer, outer_cm + a, outer_cm + b)]
        for a, b in (_BEYOND_CM, _FURTHER_CM)
    )
    return max(near) > _GOES_ON or sum(far) > _GO_ON


def _borders_of_leg(
    corner: LaneCorner, is_after: bool, markings_cm: Sequence[float], edges: RoadEdges, gate_cm: float
) -> tuple[Leg, Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return a leg from the corner's middle, and where borders of its lines lie along it and beside them."""
    leg = corner.after if is_after else corner.before
    x, y = corner.place_cm(0.0).tolist()
    leg = leg._replace(x=x, y=y)
    normals = edges.normals.astype(np.float64)
    facing, _ = Leg(0.0, 0.0, leg.angle).seen_from(normals)
    along_cm, off_cm = [], []
    for way, marking_cm in zip(_WAYS, markings_cm, strict=True):
        right_cm, far_cm = leg.seen_from(edges.points_cm + 0.5 * marking_cm * normals)
        _, (start_cm,) = leg.seen_from(corner.place_cm(way)[None])
        further_cm = far_cm - start_cm if is_after else start_cm - far_cm
        beside_cm = right_cm - 0.5 * way * corner.width_cm
        own = (np.abs(beside_cm) < gate_cm) & (np.abs(facing) > _FIT_COSINE)
        own &= (further_cm > _CLEAR_CM) & (further_cm < _REACH_CM)
        along_cm.append(far_cm[own])
        off_cm.append(beside_cm[own])
    return leg, np.concatenate(along_cm), np.concatenate(off_cm)


def _fitted(
    corner: LaneCorner, is_after: bool, markings_cm: Sequence[float], edges: RoadEdges, gate_cm: float
) -> tuple[Leg, int]:
    """Fit one leg of a corner to the borders of both lines; also how many borders count."""
    leg, along_cm, off_cm = _borders_of_leg(corner, is_after, markings_cm, edges, gate_cm)
    if len(off_cm) < _LEAST:
        return leg, len(off_cm)
    shift_cm, slope = _polynomial(along_cm, off_cm, 1).tolist()
    x, y = leg.at(shift_cm, 0.0).tolist()
    turned = min(max(math.atan(slope), -_TURN_AT_ONCE), _TURN_AT_ONCE)
    return Leg(x, y, leg.angle + turned), len(off_cm)


def _bend_per_cm(corner: LaneCorner, is_after: bool, markings_cm: Sequence[float], edges: RoadEdges) -> float:
    """Return the curvature of the lines of a leg, [1/cm]; 0 where too little of them is seen."""
    _, along_cm, off_cm = _borders_of_leg(corner, is_after, markings_cm, edges, _BENT_CM)
    if len(off_cm) < _LEAST or np.ptp(along_cm) < _BENT_OVER_CM:
        return 0.0
    return 2.0 * float(_polynomial(along_cm, off_cm, 2)[2])


def _polynomial(
    along_cm: Float[np.ndarray, "n"], off_cm: Float[np.ndarray, "n"], degree: int
) -> Float[np.ndarray, "d"]:
    """Fit what lies beside a leg, [cm], as powers of what lies along it; far ones count less."""
    weight = 1.0 / (1.0 + (off_cm / _CAUCHY_CM) ** 2)
    shape = np.stack([along_cm**power for power in range(degree + 1)], axis=1)
    stiff = np.diag([_STIFF, *[_STIFF_TURN] * degree])
    normal = (shape * weight[:, None]).T @ shape + stiff
    return np.linalg.solve(normal, (shape * weight[:, None]).T @ off_cm)
