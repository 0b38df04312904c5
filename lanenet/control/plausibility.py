"""Answers that cannot be the car's lane: impossible in themselves, or after the answers before."""

from __future__ import annotations

import math

from lanenet.geometry.lane import ROWS_CM, lane_width_cm
from lanenet.perception.estimate import SEEN, LaneEstimate

#: No point of a lane lies further to the side. Chosen: as far as edge points are looked for ahead
#: (``RangeSettings.far_cm``), twice what the networks' windows show to the side.
_REACH_CM = 120.0
#: The lane's centre 15 cm ahead of a car that drives in it, at most, in lane widths to the side. Chosen: the
#: car has left the lane at 0.5, and a car across its lane sees the centre half a lane further.
_BESIDE_LANES = 1.25
#: Narrowest and widest answer, as shares of the lane's width. Chosen: beyond what good frames give; on seven
#: synthetic drives the networks that ship answered 0.9 to 1.23 (one frame of 3900: 0.56), the lane filter
#: 0.79 to 1.1.
_NARROWEST, _WIDEST = 0.6, 1.6
#: A line moves by this share of the lane's width from one frame to the next without the car's motion: noise.
#: Chosen: half of what a change to the adjacent lane would be, less the car's motion.
_NOISE_LANES = 0.35
#: Width where none is known. Chosen: that of common tracks for 1:10 cars.
_COMMON_WIDTH_CM = 40.0
#: A line's place moves sideways by at most this share of the distance driven: full lock of 0.45 rad turns a
#: car of 17 cm wheelbase by 0.43 rad in 15 cm, which moves what is 15 cm ahead by half of that distance, and
#: a lane that is crossed at 45 degrees moves by all of it. Chosen: the sum.
_SIDEWAYS = 1.5
#: However long ago it was seen, a lane does not move by more than this share of its width. Chosen: less than
#: to the adjacent lane.
_MOST_LANES = 0.9
#: Answers that contradict the lane before, but agree with each other for this long, are the lane. Chosen: a
#: dozen frames of a common camera; by then an armed car is in neutral.
SETTLE_S = 0.4
#: Place of the row whose points are compared.
_AT = ROWS_CM.index(15.0)
#: Rounding error of frame times.
_ROUNDING_S = 1e-6


def fault_of(estimate: LaneEstimate) -> str:
    """Return what makes an answer impossible in itself; empty if nothing does.

    Args:
        estimate: The lane of one frame.

    Returns:
        A value that is not finite or out of range (NaN is a known absence, of all sigmas or none), a point
        out of reach, or lines that cross.
    """
    points, sigmas = estimate.points_cm.tolist(), estimate.sigma_cm.tolist()
    if not 0.0 <= estimate.confidence <= 1.0:
        return f"confidence {estimate.confidence:g}"
    # Lists, not generators: for so few values these cost more than what is compared.
    if [p for p in estimate.presence.tolist() if not (0.0 <= p <= 1.0 or math.isnan(p))]:
        return f"presence {estimate.presence}"
    if abs(estimate.steering_rad) > 0.5 * math.pi:
        return f"steering {estimate.steering_rad:g} rad"
    if beyond_cm := [abs(x) for x in points if abs(x) > _REACH_CM]:
        return f"a line {max(beyond_cm):.0f} cm to the side"
    known = [sigma for x, sigma in zip(points, sigmas, strict=True) if x == x]
    if [s for s in known if not 0.0 <= s < math.inf] and not all(map(math.isnan, known)):
        return f"sigma {known}"
    if [left for left, right in zip(points[:3], points[3:], strict=True) if right <= left]:
        return "lines that cross"
    return ""


def misfit_of(estimate: LaneEstimate, width_cm: float) -> str:
    """Return by what an answer that is possible in itself is not the car's lane; empty if nothing speaks so.

    Args:
        estimate: The lane of one frame.
        width_cm: The lane's width.

    Returns:
        A lane too narrow or too wide, or beside the car; where one line is missing, it lies a width beside
        the other.
    """
    seen_cm = lane_width_cm(estimate.points_cm)
    if not math.isnan(seen_cm) and not _NARROWEST * width_cm <= seen_cm <= _WIDEST * width_cm:
        return f"a lane {seen_cm:.0f} cm wide, expected {width_cm:.0f} cm"
    left, right = estimate.points_cm.tolist()[_AT :: len(ROWS_CM)]
    centre_cm = 0.5 * (_or(left, right - width_cm) + _or(right, left + width_cm))
    if abs(centre_cm) > _BESIDE_LANES * width_cm:
        return f"a lane {abs(centre_cm):.0f} cm beside the car"
    return ""


def _or(x: float, other: float) -> float:
    return other if math.isnan(x) else x


class JumpCheck:
    """Finds answers that lie where the lane of the answers before cannot be."""

    def __init__(self) -> None:
        """Know no lane."""
        self.reset()

    def reset(self) -> None:
        """Forget the answers before."""
        # Both lines 15 cm ahead, and when: of the lane, and of the last answer that contradicted it.
        self._lane: tuple[float, float] | None = None
        self._lane_s = math.nan
        self._other: tuple[float, float] | None = None
        self._other_s = self._other_since_s = math.nan

    def fault_of(self, estimate: LaneEstimate, t_s: float, speed_cm_s: float, width_cm: float | None) -> str:
        """Return by how much a frame's lane has jumped; empty if it has not.

        A lane that stays where it has jumped to is accepted after ``SETTLE_S``, as is the first answer after
        as long without one.

        Args:
            estimate: The lane of one frame; the place of a line that is probably not seen does not count,
                unless neither is.
            t_s: Time of the frame.
            speed_cm_s: The car's largest speed.
            width_cm: The lane's width; None while it is unknown.
        """
        left, right = estimate.points_cm.tolist()[_AT :: len(ROWS_CM)]
        left_seen, right_seen = (not presence < SEEN for presence in estimate.presence.tolist())
        if left_seen != right_seen:
            left, right = left if left_seen else math.nan, right if right_seen else math.nan
        if math.isnan(left) and math.isnan(right):
            return ""
        lane, unit_cm = (left, right), width_cm or _COMMON_WIDTH_CM

        def allowed_cm(since_s: float) -> float:
            moved_cm = _NOISE_LANES * unit_cm + _SIDEWAYS * speed_cm_s * (t_s - since_s)
            return min(moved_cm, _MOST_LANES * unit_cm)

        before = self._moved_cm(self._lane, lane, t_s - self._lane_s, width_cm)
        since_other = self._moved_cm(self._other, lane, t_s - self._other_s, width_cm)
        if (math.isnan(before) and math.isnan(since_other)) or before <= allowed_cm(self._lane_s):
            self._lane, self._lane_s, self._other = lane, t_s, None
            return ""
        if not since_other <= allowed_cm(self._other_s):
            self._other_since_s = t_s
        self._other, self._other_s = lane, t_s
        if t_s - self._other_since_s >= SETTLE_S - _ROUNDING_S:
            self._lane, self._lane_s, self._other = lane, t_s, None
            return ""
        if math.isnan(before):
            return "the lane is in another place in every frame"
        return f"the lane has jumped by {before:.0f} cm"

    @staticmethod
    def _moved_cm(
        before: tuple[float, float] | None, now: tuple[float, float], passed_s: float, width_cm: float | None
    ) -> float:
        """Return the larger motion of the two lines; NaN if it was too long ago.

        If none is known twice, it is that of one line against the parallel of the other; 0 without a width.
        """
        if before is None or passed_s > SETTLE_S + _ROUNDING_S:
            return math.nan
        left, right = now[0] - before[0], now[1] - before[1]
        if math.isnan(left) and math.isnan(right):
            across = _or(now[1] - before[0], before[1] - now[0])
            return 0.0 if width_cm is None else abs(across - width_cm)
        return max(abs(_or(left, 0.0)), abs(_or(right, 0.0)))
