"""From an aim point on the road to a front-wheel angle, [rad], positive to the left."""

from __future__ import annotations

import math


def proportional_angle_rad(aim_right_cm: float, aim_ahead_cm: float) -> float:
    """Aim the front wheels at a point: atan of lateral over ahead.

    Args:
        aim_right_cm: Lateral position of the lane centre A, [cm], frame car, positive right.
        aim_ahead_cm: Distance of A ahead of the front axle, [cm], > 0.

    Returns:
        Steering angle, [rad], positive left.

    Source:
        Kozlowski et al. 2024, eq. 3, with the sign of REP 103.
    """
    return math.atan2(-aim_right_cm, aim_ahead_cm)


def pure_pursuit_angle_rad(aim_right_cm: float, aim_ahead_cm: float, wheelbase_cm: float) -> float:
    """Steer the rear axle onto the circle through a point.

    The circle through the rear axle, tangent to the heading, that meets the aim point has curvature
    2 * lateral / distance^2; the bicycle's front wheel makes it with atan(wheelbase * curvature).

    Args:
        aim_right_cm: Lateral position of the aim point, [cm], frame car, positive right.
        aim_ahead_cm: Distance of the aim point ahead of the front axle, [cm].
        wheelbase_cm: Distance between the axles, [cm].

    Returns:
        Steering angle, [rad], positive left.

    Source:
        Coulter 1992, "Implementation of the Pure Pursuit Path Tracking Algorithm", CMU-RI-TR-92-01.
    """
    forward = aim_ahead_cm + wheelbase_cm
    curvature = -2.0 * aim_right_cm / (forward * forward + aim_right_cm * aim_right_cm)
    return math.atan(wheelbase_cm * curvature)
