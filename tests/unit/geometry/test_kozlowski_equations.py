"""Equations 3, 7 and 8 of Kozlowski et al. 2024, against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lanenet.geometry.lane import (
    POINTS_FROM_PARABOLA,
    ROWS_CM,
    parabolas_from_points,
    proportional_angle_rad,
)

#: Left: a = (x0 - 2 x15 + x30) / 450 = (-21.5 + 38.5 - 11) / 450 = 6 / 450,
#: b = (-3 x0 + 4 x15 - x30) / 30 = (64.5 - 77 + 11) / 30 = -0.05, c = x0.
#: Right: a = (18 - 42 + 27) / 450 = 3 / 450, b = (-54 + 84 - 27) / 30 = 0.1.
POINTS_CM = np.array([-21.5, -19.25, -11.0, 18.0, 21.0, 27.0])
PARABOLAS = np.array([[6.0 / 450.0, -0.05, -21.5], [3.0 / 450.0, 0.1, 18.0]])


def test_parabolas_through_three_points() -> None:
    """Kozlowski et al. 2024, eq. 7 (x = a y^2 + b y + c) through the points of eq. 8, y = 0, 15, 30 cm."""
    np.testing.assert_allclose(parabolas_from_points(POINTS_CM), PARABOLAS, atol=1e-12)


def test_points_of_known_parabolas() -> None:
    """Kozlowski et al. 2024, eq. 8: [x1, x2, x3] = f(y1, y2, y3).

    Left at 15 cm: 6 / 450 * 225 - 0.05 * 15 - 21.5 = 3 - 0.75 - 21.5 = -19.25; at 30 cm: 12 - 1.5 - 21.5.
    """
    assert ROWS_CM == (0.0, 15.0, 30.0)
    np.testing.assert_allclose((PARABOLAS @ POINTS_FROM_PARABOLA.T).ravel(), POINTS_CM, atol=1e-12)


@pytest.mark.parametrize(("y_cm", "left_cm", "right_cm"), [(22.5, -15.875, 23.625), (-15.0, -17.75, 18.0)])
def test_a_parabola_between_and_before_its_points(y_cm: float, left_cm: float, right_cm: float) -> None:
    """Kozlowski et al. 2024, eq. 7, at a distance that is none of the three.

    At 22.5 cm: 6 / 450 * 506.25 - 1.125 - 21.5 = 6.75 - 22.625 = -15.875, and 3.375 + 2.25 + 18 = 23.625.
    At -15 cm: 3 + 0.75 - 21.5 = -17.75, and 1.5 - 1.5 + 18 = 18.
    """
    np.testing.assert_allclose(np.polyval(PARABOLAS.T, y_cm), [left_cm, right_cm], atol=1e-12)


def test_a_straight_lane_has_no_curvature() -> None:
    """Kozlowski et al. 2024, eq. 7-8, for x = -15 + y / 3: the points are -15, -10, -5."""
    parabola = parabolas_from_points(np.array([-15.0, -10.0, -5.0, 0.0, 0.0, 0.0]))[0]
    np.testing.assert_allclose(parabola, [0.0, 1.0 / 3.0, -15.0], atol=1e-12)


@pytest.mark.parametrize(
    ("left_cm", "right_cm", "ahead_cm", "sine"),
    [
        # The centre is 8 cm to the left, 15 ahead: the triangle 8, 15, 17.
        (-24.0, 8.0, 15.0, 8.0 / 17.0),
        # 20 to the right, 15 ahead: 3, 4, 5. Negative, as right is.
        (5.0, 35.0, 15.0, -4.0 / 5.0),
        # 5 to the left, 12 ahead: 5, 12, 13.
        (-20.0, 10.0, 12.0, 5.0 / 13.0),
        (-16.0, 16.0, 15.0, 0.0),
    ],
)
def test_steering_at_the_middle_of_the_lane(
    left_cm: float, right_cm: float, ahead_cm: float, sine: float
) -> None:
    """Kozlowski et al. 2024, eq. 3: the angle is atan(A_y / A_x), A the middle of L and R; left > 0."""
    angle = proportional_angle_rad(0.5 * (left_cm + right_cm), ahead_cm)
    assert math.sin(angle) == pytest.approx(sine, abs=1e-12)
    assert math.cos(angle) == pytest.approx(math.sqrt(1.0 - sine * sine), abs=1e-12)


def test_steering_error_of_the_papers_analysis() -> None:
    """Kozlowski et al. 2024, eq. 3 and section 2.3: 10 mm at 150 mm are atan(1 / 15) = 3.8141 degrees."""
    assert math.degrees(proportional_angle_rad(-1.0, 15.0)) == pytest.approx(3.8141, abs=1e-4)
