from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.geometry.lane import proportional_angle_rad, pure_pursuit_angle_rad

WHEELBASE_CM = 26.0


@pytest.mark.parametrize(
    ("right_cm", "ahead_cm", "degrees"), [(0.0, 15.0, 0.0), (-15.0, 15.0, 45.0), (15.0, 15.0, -45.0)]
)
def test_proportional_by_hand(right_cm: float, ahead_cm: float, degrees: float) -> None:
    assert math.degrees(proportional_angle_rad(right_cm, ahead_cm)) == pytest.approx(degrees, abs=1e-12)


def test_proportional_angle_of_the_papers_error_analysis() -> None:
    # Kozlowski et al. 2024: 10 mm at 150 mm is 3.8 degrees.
    assert math.degrees(proportional_angle_rad(-1.0, 15.0)) == pytest.approx(3.8, abs=0.05)


def test_pure_pursuit_by_hand() -> None:
    # Wheelbase 25, aim 15 ahead of the front axle and 30 to the left: 40 ahead of the rear axle and 50 away,
    # so the curvature is 2 * 30 / 2500 = 0.024 per cm, and tan(angle) = 25 * 0.024 = 0.6.
    assert pure_pursuit_angle_rad(-30.0, 15.0, 25.0) == pytest.approx(math.atan(0.6), abs=1e-12)
    assert pure_pursuit_angle_rad(30.0, 15.0, 25.0) == pytest.approx(-math.atan(0.6), abs=1e-12)
    assert pure_pursuit_angle_rad(0.0, 15.0, 25.0) == 0.0


@given(st.floats(-60.0, 60.0), st.floats(1.0, 100.0))
def test_left_is_positive_and_mirroring_flips_the_sign(right_cm: float, ahead_cm: float) -> None:
    for angle, mirrored in (
        (proportional_angle_rad(right_cm, ahead_cm), proportional_angle_rad(-right_cm, ahead_cm)),
        (
            pure_pursuit_angle_rad(right_cm, ahead_cm, WHEELBASE_CM),
            pure_pursuit_angle_rad(-right_cm, ahead_cm, WHEELBASE_CM),
        ),
    ):
        assert angle == pytest.approx(-mirrored, abs=1e-15)
        assert angle * right_cm <= 0.0


@given(st.floats(-0.5, 0.5).filter(lambda a: abs(a) > 1e-3), st.floats(0.2, 1.4))
def test_pure_pursuit_finds_the_steering_that_drives_through_the_point(
    steering_rad: float, turned_rad: float
) -> None:
    # The bicycle drives its rear axle on a circle of this signed radius (left positive), turned_rad along it.
    radius_cm = WHEELBASE_CM / math.tan(steering_rad)
    forward_cm = abs(radius_cm) * math.sin(turned_rad)
    left_cm = radius_cm * (1.0 - math.cos(turned_rad))
    angle = pure_pursuit_angle_rad(-left_cm, forward_cm - WHEELBASE_CM, WHEELBASE_CM)
    assert angle == pytest.approx(steering_rad, abs=1e-9)


def test_small_angles_of_the_two_laws_by_hand() -> None:
    # One wheelbase L ahead: lateral / L against L * 2 * lateral / (2 L)^2 = lateral / (2 L).
    proportional = proportional_angle_rad(-0.01, WHEELBASE_CM)
    pursuit = pure_pursuit_angle_rad(-0.01, WHEELBASE_CM, WHEELBASE_CM)
    np.testing.assert_allclose(proportional / pursuit, 2.0, rtol=1e-4)
