"""Last stage of Suto's tracker: the steering angle in degrees, positive left, and averages over frames.

Coordinates as in :mod:`lanenet.perception.hough.lines`. Two places of the paper are ambiguous:

- Eq. 11, 13 and 14 measure the horizontal distance between c1 and a line's point pa, whose y is 0: the *top*
  of the region. That is what the text says twice, and it is the default; ``distance_row: bottom`` measures it
  on c1's own row instead.
- Eq. 12 names its result theta_t, like eq. 15. Since the update by eq. 15 follows "at the end of the last
  stage" in every case, eq. 12 is taken for the current angle.
"""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from lanenet.config import Settings
from lanenet.perception.hough.lines import Line, Point, x_at


class HoughSteeringSettings(Settings):
    """Weights of the steering angle (section 4.4).

    Attributes:
        vanishing_weight: Weight of the vanishing point's angle, eq. 8.
        distance_weight: Weight of the distances' angle, eq. 8.
        gain_deg: The 60 of eq. 11, 13 and 14.
        angle_smoothing: w1 of eq. 15.
        line_smoothing: w2 of eq. 16.
        distance_row: Row on which the distances of eq. 11, 13 and 14 are measured.
        max_jump_px: A single line whose distance differs by more than this from its side's last one is
            another line and changes nothing (eq. 13, 14). Not in the paper; None is the paper's.
        max_angle_deg: Bound of the current angle, that of eq. 11; eq. 13 and 14 have none of their own.
        hold_frames: A side that so many frames did not show is forgotten; with the last side, so is the
            angle, which is held until then. None holds for ever, as the paper does.
    """

    vanishing_weight: float = Field(default=0.8, ge=0.0)
    distance_weight: float = Field(default=0.2, ge=0.0)
    gain_deg: float = Field(default=60.0, gt=0.0)
    angle_smoothing: float = Field(default=0.1, gt=0.0, le=1.0)
    line_smoothing: float = Field(default=0.05, gt=0.0, le=1.0)
    distance_row: Literal["top", "bottom"] = "top"
    max_jump_px: float | None = Field(default=10.0, ge=0.0)
    max_angle_deg: float = Field(default=60.0, gt=0.0, le=180.0)
    hold_frames: int | None = Field(default=10, ge=0)


def combine_angles(vanishing_deg: float, distance_deg: float, settings: HoughSteeringSettings) -> float:
    """Return theta_curr = 0.8 theta_vp + 0.2 theta_d.

    Source:
        Suto 2021, eq. 8.
    """
    return settings.vanishing_weight * vanishing_deg + settings.distance_weight * distance_deg


def vanishing_angle_deg(vp: Point, c1: Point, c2: Point) -> float:
    """Return the angle at c1 between the centre line and the vanishing point, positive left.

    a = vp - c1 and b = c2 - c1 are vectors; the printed formula lost the comma between their components. A
    vanishing point at c1 itself has no direction and gives 0.

    Source:
        Suto 2021, eq. 10.
    """
    a = (vp[0] - c1[0], vp[1] - c1[1])
    b = (c2[0] - c1[0], c2[1] - c1[1])
    norm = math.hypot(*a) * math.hypot(*b)
    if norm == 0.0:
        return 0.0
    # Rounding may carry the cosine beyond 1.
    angle = math.degrees(math.acos(max(-1.0, min(1.0, (a[0] * b[0] + a[1] * b[1]) / norm))))
    return -angle if vp[0] > c2[0] else angle


def distance_angle_deg(dnx: float, dpx: float, gain_deg: float) -> float:
    """Return the angle that centres the car between the lines: 60 (dnx - dpx) / (dpx + dnx), positive left.

    The two cases of the paper are the same formula. Two lines through c1 itself give 0.

    Args:
        dnx: Horizontal distance of the left (negative) line, [px], not negative.
        dpx: Horizontal distance of the right (positive) line.
        gain_deg: 60 in the paper.

    Source:
        Suto 2021, eq. 11.
    """
    total = dpx + dnx
    return gain_deg * (dnx - dpx) / total if total > 0.0 else 0.0


def angle_of_one_line_deg(previous_deg: float, change_deg: float) -> float:
    """Return theta = theta_{t-1} + theta_delta.

    Source:
        Suto 2021, eq. 12.
    """
    return previous_deg + change_deg


def change_by_left_line_deg(distance: float, previous: float, gain_deg: float) -> float:
    """Return theta_delta of a left line: towards it (left, positive) as its distance grows.

    No earlier distance to compare with, or one of 0, gives 0.

    Source:
        Suto 2021, eq. 13.
    """
    # The paper's two cases are one formula.
    return gain_deg * (distance - previous) / previous if previous > 0.0 else 0.0


def change_by_right_line_deg(distance: float, previous: float, gain_deg: float) -> float:
    """Return theta_delta of a right line: towards it (right, negative) as its distance grows.

    Source:
        Suto 2021, eq. 14.
    """
    return -change_by_left_line_deg(distance, previous, gain_deg)


def smooth_angle_deg(current_deg: float, previous_deg: float | None, w1: float) -> float:
    """Return theta_t = w1 theta_curr + (1 - w1) theta_{t-1}; the current one where there is none before.

    Source:
        Suto 2021, eq. 15.
    """
    return current_deg if previous_deg is None else w1 * current_deg + (1.0 - w1) * previous_deg


def smooth_line(current: Line, previous: Line | None, w2: float) -> Line:
    """Return m_t and b_t by the same average with w2; the current line where there is none before.

    Source:
        Suto 2021, eq. 16.
    """
    if previous is None:
        return current
    return Line(w2 * current.m + (1.0 - w2) * previous.m, w2 * current.b + (1.0 - w2) * previous.b)


def horizontal_distance(line: Line, c1: Point, row: float) -> float:
    """Return dnx or dpx: the distance along x between c1 and the line's point on a row.

    Source:
        Suto 2021, below eq. 10.
    """
    return abs(x_at(line, row) - c1[0])
