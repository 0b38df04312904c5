"""A lane at a junction: its lines end, or turn away one without the other, and it goes straight on.

The lane of the last plain frame is continued beside the car's own motion, until its lines are seen again.
Whoever wants to turn there has to know it from elsewhere: a camera sees the roads, and not the route.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.frames import car_from_map, map_from_car
from lanenet.geometry.lane import ROWS_CM

_ROWS, _MIDDLE, _FAR = np.array(ROWS_CM), 1, 2
#: By how much a line turns away within the label rows, as the second difference of its points there, [cm],
#: and as a share of the lane's width; at first and once it does; for how many frames. 7 cm are 43 degrees in
#: 30 cm: an inner line that bends more is rare, since cars cannot follow it.
_TURNS, _TURNS_STILL, _AFTER = (7.0, 0.15), (5.0, 0.12), 2
#: Meanwhile a point that far from the continued lane, as a share of the width, is unknown. Chosen: 3 of 40.
_DOUBTED = 0.08
#: A lane is plain whose lines are both seen in this length, [cm], have its width within this share beside the
#: car and 15 cm ahead, and turn by less than this one. It is worth continuing for so many frames, with and
#: without knowing the car's motion, and begins to be within this distance, [cm]. Chosen: of 44 continued
#: lanes on 205 simulated roads two were 5 cm off at once, which had been plain 51 and 66 cm before; the
#: others, which were not, 36 cm at most, but for one.
_PLAIN_CM, _PLAIN_WIDTH, _PLAIN_TURN, _FRESH, _FRESH_UNTOLD, _FRESH_CM = 9.0, 0.12, 0.12, 25, 6, 45.0
#: A line is the lane's again if it is seen in this length, [cm], and if it is within this share of the width
#: of where it is expected, and turns away by less than this one. Chosen.
_SEEN_CM, _SAME, _STRAIGHT = 12.0, 0.12, 0.08
#: Two lines are, if their distance is between these shares of the width, and their middle not further from
#: the expected one than this. Chosen.
_NARROW, _WIDE, _BESIDE = 0.8, 1.25, 0.35
#: Presence below which the lane's other line may have ended. On `garage_tape` a blurred one that goes on has
#: 0.67 and more. After so many frames in which a line turns away the other one has ended as well if it is
#: hardly seen, since the network may take a reflection for it; and for so many frames after the last of them
#: the turn is remembered. Chosen on 29 lost roads of two seeds.
_ENDED, _LONG, _RECENT = 0.62, 4, 6
#: A line beside one that turns away, where it is not expected, counts if it is seen over this length, [cm].
#: Tried: 12, 16 and 20 pass two, three and three of three mouths of side roads in glare; with no limit, 0.6 %
#: of the points of `garage_tape` are lost.
_SPECK_CM = 20.0
#: Sigma of a plain lane's middle beside the car, [cm], and of its slope, dx/dy; of what the slope changes by
#: per root of a centimetre, since lanes bend; and of what consecutive frames are wrong by alike, [cm]. The
#: third one is fitted to 2046 points on 205 simulated roads, before the share of sigma that a tracker claims;
#: the last one lies between what those points ask for, 1.0, and 1084 others on roads of another seed, 2.
_PLACE_CM, _SLOPE, _BENDS, _ALIKE_CM = 0.57, 0.01, 0.0107, 1.5
#: The same while nobody tells how the car moves: more than what counts as known.
_UNTOLD_CM = 100.0
#: Where the lane is seen again ahead: by how much the direction to there may differ from the lane's slope
#: here, as a sigma; sigma of the points ahead; beyond how many sigmas beside the car it is another lane; how
#: far the car drives at least until that counts again, since a car that stands sees the same again. Chosen.
_BENT, _SEEN_AHEAD_CM, _MOST_SIGMAS, _AGAIN_CM = 0.1, 1.0, 2.0, 2.0
#: In so many frames on end has the lane to be found while a side road is passed. Tried: 1 and 4 lose three
#: and two of 15 roads that were chosen since an earlier version lost them.
_PASSING = 8
#: Distance and frames after which it is given up. Chosen: a junction of four lanes; 2 s at 20 frames/s.
_FARTHEST_CM, _LONGEST = 160.0, 40
#: A car that stands across a lane at a larger slope, cm beside per cm ahead, has left it. Chosen: 45 degrees.
_STEEPEST = 1.0


def turns_away_cm(points_cm: Sequence[float], side: int) -> float:
    """Return by how much a line turns away from its lane: the second difference of its points, [cm]."""
    near, middle, far = points_cm
    second = far - 2.0 * middle + near
    return second if side == 1 else -second


class SeenLines(NamedTuple):
    """The lines of a frame, the left one first.

    Attributes:
        points_cm: x at the label rows, frame car.
        seen_cm: Length in which each is seen.
        seen_at: Whether it is at each label row.
    """

    points_cm: Sequence[Sequence[float]]
    seen_cm: Sequence[float]
    seen_at: Sequence[Sequence[bool]]

    def turn(self, width_cm: float) -> list[float]:
        """By how much each turns away, as a share of the lane's width."""
        return [turns_away_cm(x, side) / width_cm for side, x in enumerate(self.points_cm)]


class StraightOn:
    """Notices that a lane's lines leave it, and continues the lane.

    Attributes:
        on: Whether the lane is continued at present.
        told: Whether the car's motion has been told: without it, the continued lane's place is unknown.
        leaving: The line that turns away, or did so a few frames ago while the other one vanished; 0 for the
            left one, None for neither. Where the lane is continued, the one that left it.
    """

    def __init__(self) -> None:
        """Know of no junction."""
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self.on = self.told = False
        self.leaving: int | None = None
        self._lines_cm: Float[np.ndarray, "2 3"] | None = None
        #: Of the middle's x beside the car, [cm], and of its slope.
        self._covariance: Float[np.ndarray, "2 2"] = np.zeros((2, 2))
        self._frames = self._found = 0
        self._driven_cm, self._driven_since_anchor_cm = 0.0, math.inf
        self.forget_turn()

    @property
    def expected_cm(self) -> Float[np.ndarray, "2 3"] | None:
        """Where the last plain lane's lines are if it goes straight on: x at the label rows, or None."""
        return self._lines_cm

    def start_again(self, lines_cm: Float[np.ndarray, "2 3"]) -> None:
        """Take a straight lane as a plain one, by x of its lines at the label rows."""
        self.forget_lane()
        self._lines_cm = lines_cm.copy()
        self._know_it()

    def forget_lane(self) -> None:
        """Forget the lane: it does not go straight on."""
        self.on, self._lines_cm = False, None
        self.forget_turn()

    def _know_it(self) -> None:
        self._covariance = np.diag([_PLACE_CM**2, _SLOPE**2])
        self._driven_cm, self._driven_since_anchor_cm, self._frames = 0.0, math.inf, 0

    def forget_turn(self) -> None:
        """Forget that a line turned away: the lane bends, or the junction is behind the car."""
        self._suspicious = 0
        self._turned: int | None = None
        self._turning = self._since = 0
        self._unseen = [_RECENT, _RECENT]

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        """Take the car's motion since the last frame, as :class:`lanenet.perception.estimate.TakesMotion`.

        A lane that the car has turned away from is forgotten.
        """
        self.told = True
        if self._lines_cm is None:
            return
        self._driven_cm += abs(travel_cm)
        self._driven_since_anchor_cm += abs(travel_cm)
        half_rad, before = 0.5 * turn_rad, _slope(self._lines_cm)
        pose = np.array([travel_cm * math.cos(half_rad), travel_cm * math.sin(half_rad), turn_rad])
        for line_cm in self._lines_cm:
            ends_cm = map_from_car(np.column_stack([line_cm, _ROWS])[[0, -1]], np.zeros(3), wheelbase_cm)
            (x_0, y_0), (x_1, y_1) = car_from_map(ends_cm, pose, wheelbase_cm)
            # Not a number where the motion is none.
            if not abs(x_1 - x_0) <= _STEEPEST * (y_1 - y_0):
                self.forget_lane()
                return
            line_cm[:] = x_0 + (_ROWS - y_0) * (x_1 - x_0) / (y_1 - y_0)
        # With the car the slope's scale turns, too: it is the tangent of an angle.
        scale = math.sqrt((1.0 + _slope(self._lines_cm) ** 2) / (1.0 + before**2))
        driven = scale * np.array([[1.0, travel_cm], [0.0, scale]])
        # What a slope that walks at random makes of it on the way.
        d = abs(travel_cm)
        bends = _BENDS**2 * np.array([[d**3 / 3.0, d * travel_cm / 2.0], [d * travel_cm / 2.0, d]])
        self._covariance = driven @ self._covariance @ driven.T + bends

    def turns_away(
        self, points_cm: Sequence[float], seen_at: Sequence[bool], side: int, width_cm: float
    ) -> bool:
        """Return whether a line turns away from its lane more than lanes bend.

        Args:
            points_cm: The line at the label rows, frame car.
            seen_at: Whether it is there.
            side: 0 for the left line, 1 for the right one.
            width_cm: The lane's width.
        """
        least_cm, share = _TURNS_STILL if self._suspicious else _TURNS
        if turns_away_cm(points_cm, side) >= max(least_cm, share * width_cm):
            return True
        # Of a sharp corner only the beginning is found.
        if self._lines_cm is None or seen_at[_FAR]:
            return False
        off_cm = float(points_cm[_MIDDLE] - self._lines_cm[side, _MIDDLE])
        return (off_cm if side == 1 else -off_cm) >= _DOUBTED * width_cm

    def is_a_speck(self, points_cm: Sequence[float], seen_cm: float, side: int, width_cm: float) -> bool:
        """Return whether a line is too short for the lane's where the lane, going straight on, has none.

        Args:
            points_cm: The line at the label rows, frame car.
            seen_cm: Length in which it is seen.
            side: 0 for the left line, 1 for the right one.
            width_cm: The lane's width.
        """
        if self._lines_cm is None or seen_cm >= _SPECK_CM:
            return False
        return abs(points_cm[_MIDDLE] - float(self._lines_cm[side, _MIDDLE])) >= _SAME * width_cm

    def look(self, lines: SeenLines, leaving: int | None, presence: Sequence[float], width_cm: float) -> None:
        """Take a frame while the lane is not continued.

        Args:
            lines: Its lines.
            leaving: The one that turns away, while the other one, which would be in sight, does not.
            presence: Probability of each line, by the network.
            width_cm: The lane's width.
        """
        leaves = leaving is not None
        for side, seen_cm in enumerate(lines.seen_cm):
            self._unseen[side] = 0 if seen_cm >= _PLAIN_CM else self._unseen[side] + 1
        self.leaving = self._recently_leaving(leaving)
        if self.leaving is not None and self._has_ended(1 - self.leaving, presence, leaves):
            self._suspicious = min(self._suspicious + 1, _AFTER)
        else:
            self.leaving = leaving
            # A frame that does not show both lines well says nothing against it.
            if min(lines.seen_cm) >= _PLAIN_CM:
                self._suspicious = max(0, self._suspicious - 1)
        self._frames += 1
        if not leaves and self._suspicious == 0 and _is_plain(lines, width_cm):
            # Their direction 15 cm ahead, as far as both are seen.
            far = _FAR if all(at[_FAR] for at in lines.seen_at) else _MIDDLE
            left, right = lines.points_cm
            slope = 0.5 * (left[far] - left[0] + (right[far] - right[0])) / ROWS_CM[far]
            ahead_cm = [slope * (row - ROWS_CM[_MIDDLE]) for row in ROWS_CM]
            self._lines_cm = np.array([[x[_MIDDLE] + dx for dx in ahead_cm] for x in (left, right)])
            self._know_it()
        elif self._frames > (_FRESH if self.told else _FRESH_UNTOLD):
            self._lines_cm = None
        if self._suspicious >= _AFTER:
            self._begin()

    def begin(self, leaving: int) -> None:
        """Continue the lane, if it was plain just now, where a line turns into a side road.

        Args:
            leaving: That line, 0 for the left one.
        """
        if self._begin():
            self.leaving = leaving

    def _begin(self) -> bool:
        if self._lines_cm is not None and self._driven_cm <= _FRESH_CM:
            self.on, self._suspicious, self._frames, self._found = True, 0, 0, 0
        return self.on

    def _recently_leaving(self, leaving: int | None) -> int | None:
        """Take the line that turns away, and return it, or the one that did so a few frames ago."""
        if leaving is None:
            self._since += 1
            return self._turned if self._since <= _RECENT else None
        goes_on = leaving == self._turned and self._since <= _RECENT
        self._turning = self._turning + 1 if goes_on else 1
        self._turned, self._since = leaving, 0
        return leaving

    def _has_ended(self, side: int, presence: Sequence[float], leaves: bool) -> bool:
        """Return whether the line beside one that turns away, or has done so, seems to have ended there."""
        if presence[side] < _ENDED and leaves:
            return True
        # One that has not been seen for long did not end where the other one turns.
        vanishes = 0 < self._unseen[side] < _RECENT
        return vanishes and (presence[side] < _ENDED or self._turning >= _LONG)

    def anchor(self, middle_cm: Float[np.ndarray, "k 2"], width_cm: float) -> None:
        """Turn the continued lane to where it is seen further ahead: the update of a Kalman filter.

        A lane that leads to another place beside the car is another one, and changes nothing.

        Args:
            middle_cm: Points in the middle of the lane there, frame car.
            width_cm: The lane's width.
        """
        assert self._lines_cm is not None
        if self._driven_since_anchor_cm < _AGAIN_CM:
            return
        before_cm, before = float(self._lines_cm[:, 0].mean()), _slope(self._lines_cm)
        covariance = self._covariance + np.diag([0.0, _BENT**2])
        seen = np.column_stack([np.ones(len(middle_cm)), middle_cm[:, 1]])
        spread = seen @ covariance @ seen.T + _SEEN_AHEAD_CM**2 * np.eye(len(seen))
        gain = np.linalg.solve(spread, seen @ covariance).T
        expected = np.array([before_cm, before])
        start_cm, slope = expected + gain @ (middle_cm[:, 0] - seen @ expected)
        if abs(start_cm - before_cm) > _MOST_SIGMAS * math.sqrt(covariance[0, 0]):
            return
        half_cm = 0.5 * width_cm * math.hypot(1.0, slope)
        self._lines_cm = np.array([[-half_cm], [half_cm]]) + start_cm + slope * (_ROWS - _ROWS[0])
        self._covariance, self._driven_since_anchor_cm = covariance - gain @ seen @ covariance, 0.0

    def look_for_its_end(
        self, lines: SeenLines, found: bool, width_cm: float, *, passes: bool = False
    ) -> None:
        """Take a frame while the lane is continued.

        Args:
            lines: Its lines.
            found: Whether they are the lane's for sure.
            width_cm: The lane's width.
            passes: Whether the car is known to pass a side road: then glare shows lines now and then.
        """
        assert self._lines_cm is not None
        self._frames += 1
        too_long = self._frames > _LONGEST or self._driven_cm > _FARTHEST_CM
        again = not passes and self._are_the_lanes(lines, self._lines_cm, width_cm)
        self._found = self._found + 1 if found else 0
        if too_long or again or self._found >= (_PASSING if passes else 1):
            self.forget_lane()

    @staticmethod
    def _are_the_lanes(lines: SeenLines, expected_cm: Float[np.ndarray, "2 3"], width_cm: float) -> bool:
        """Return whether one line is where it is expected, or both together are a lane near there."""
        x, seen = np.array(lines.points_cm), np.array(lines.seen_cm) >= _SEEN_CM
        ahead, turn = np.array(lines.seen_at)[:, _MIDDLE:].all(axis=1), np.array(lines.turn(width_cm))
        off = np.abs(x - expected_cm)[:, :_FAR].max(axis=1) / width_cm
        if (seen & (off < _SAME) & (turn < _STRAIGHT) & ahead).any():
            return True
        across = float(x[1, _MIDDLE] - x[0, _MIDDLE]) / width_cm
        beside = abs(float(x[:, _MIDDLE].mean() - expected_cm[:, _MIDDLE].mean())) / width_cm
        is_lane = bool(seen.all()) and _NARROW < across < _WIDE and float(turn.max()) < _TURNS[1]
        return is_lane and beside < _BESIDE

    def doubts(
        self, points_cm: Float[np.ndarray, "6"], width_cm: float | None
    ) -> Bool[np.ndarray, "6"] | None:
        """Return which points of a frame seem to be those of a line that leaves the lane; None for none."""
        if self._lines_cm is None or width_cm is None or self.leaving is None:
            return None
        return np.abs(points_cm - self._lines_cm.reshape(-1)) > _DOUBTED * width_cm

    def lane(self) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "2 3"]]:
        """Return the continued lines and their sigmas, very large ones while the car's motion is unknown."""
        assert self._lines_cm is not None
        if self.told:
            rows = np.column_stack([np.ones_like(_ROWS), _ROWS])
            sigma_cm = np.hypot(np.sqrt(np.einsum("ri,ij,rj->r", rows, self._covariance, rows)), _ALIKE_CM)
        else:
            sigma_cm = np.full(len(_ROWS), _UNTOLD_CM)
        return self._lines_cm.copy(), np.tile(sigma_cm, (2, 1))


def _slope(lines_cm: Float[np.ndarray, "2 3"]) -> float:
    """Return dx/dy of straight lines."""
    return float(lines_cm[0, -1] - lines_cm[0, 0]) / (ROWS_CM[-1] - ROWS_CM[0])


def _is_plain(lines: SeenLines, width_cm: float) -> bool:
    """Return whether both lines of a lane are seen, and are nearly straight."""
    if min(lines.seen_cm) < _PLAIN_CM:
        return False
    left, right = lines.points_cm
    off = max(abs((right[row] - left[row]) / width_cm - 1.0) for row in range(_FAR))
    return off < _PLAIN_WIDTH and max(map(abs, lines.turn(width_cm))) < _PLAIN_TURN
