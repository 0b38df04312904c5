from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.config import check_settings
from lanenet.control.steering import (
    SteeringSettings,
    lane_centre_cm,
    steering_target_rad,
)
from lanenet.errors import ConfigError
from lanenet.geometry.lane import ROWS_CM, mirror_points
from lanenet.perception.estimate import LaneEstimate

ROWS = np.array(ROWS_CM)
NAN = float("nan")


def straight_lane(centre_cm: float, slope: float, width_cm: float = 40.0) -> np.ndarray:
    half = 0.5 * width_cm * math.hypot(1.0, slope)
    middle = centre_cm + slope * ROWS
    return np.concatenate([middle - half, middle + half])


def settings(**changes: object) -> SteeringSettings:
    return check_settings(SteeringSettings, {"wheelbase_cm": 26.0, **changes}, "test")


def test_hand_computed_angles() -> None:
    # Lane centre 5 cm to the right, so both laws steer right: negative.
    estimate = LaneEstimate(straight_lane(5.0, 0.0))
    proportional = settings(law="proportional", max_steering_rad=1.0)
    assert steering_target_rad(estimate, proportional) == pytest.approx(-math.atan(5.0 / 15.0))
    # Curvature 2 * 5 / (41^2 + 5^2) = 10 / 1706.
    pursuit = settings(law="pure-pursuit", max_steering_rad=1.0)
    assert steering_target_rad(estimate, pursuit) == pytest.approx(-math.atan(26.0 * 10.0 / 1706.0))


def test_look_ahead_between_the_rows_uses_the_parabola() -> None:
    x = 0.01 * ROWS**2
    estimate = LaneEstimate(np.concatenate([x - 20.0, x + 20.0]))
    assert lane_centre_cm(estimate, 20.0) == pytest.approx(4.0)
    at_20 = settings(law="proportional", look_ahead_cm=20.0, max_steering_rad=1.0)
    assert steering_target_rad(estimate, at_20) == pytest.approx(-math.atan2(4.0, 20.0))


@given(st.floats(-15.0, 15.0), st.floats(-0.6, 0.6), st.sampled_from([0.0, 10.0, 15.0, 40.0]))
def test_one_line_and_the_width_give_the_same_centre(centre: float, slope: float, y: float) -> None:
    points = straight_lane(centre, slope)
    both = lane_centre_cm(LaneEstimate(points), y)
    left, right = points.copy(), points.copy()
    left[3:], right[:3] = NAN, NAN
    assert lane_centre_cm(LaneEstimate(left), y, 40.0) == pytest.approx(both, abs=1e-9)
    assert lane_centre_cm(LaneEstimate(right), y, 40.0) == pytest.approx(both, abs=1e-9)
    assert math.isnan(lane_centre_cm(LaneEstimate(left), y))


@given(
    st.lists(st.floats(-60.0, 60.0), min_size=6, max_size=6),
    st.sampled_from(["pure-pursuit", "proportional"]),
)
def test_mirrored_lane_mirrors_the_angle_within_the_limit(points: list[float], law: str) -> None:
    law_settings = settings(law=law, max_steering_rad=0.4)
    x = np.array(points)
    one = steering_target_rad(LaneEstimate(x), law_settings)
    other = steering_target_rad(LaneEstimate(mirror_points(x)), law_settings)
    assert one == pytest.approx(-other, abs=1e-9)
    assert abs(one) <= 0.4


def test_unknown_lane_gives_nan() -> None:
    assert math.isnan(steering_target_rad(LaneEstimate(), settings()))
    assert math.isnan(steering_target_rad(LaneEstimate(), settings(lane_width_cm=40.0)))


def test_two_known_rows_make_a_chord_and_no_more() -> None:
    points = np.array([NAN, -20.0, -17.0, NAN, 20.0, 23.0])
    estimate = LaneEstimate(points)
    assert lane_centre_cm(estimate, 15.0) == pytest.approx(0.0)
    assert lane_centre_cm(estimate, 25.0) == pytest.approx(2.0)
    assert math.isnan(lane_centre_cm(estimate, 10.0))
    assert math.isnan(lane_centre_cm(estimate, 31.0))


def test_one_known_row_answers_only_there() -> None:
    estimate = LaneEstimate(np.array([NAN, -19.0, NAN, NAN, 21.0, NAN]))
    assert lane_centre_cm(estimate, 15.0) == pytest.approx(1.0)
    assert math.isnan(lane_centre_cm(estimate, 16.0))


def test_settings_refuse_nonsense() -> None:
    with pytest.raises(ConfigError, match="wheelbase_cm"):
        check_settings(SteeringSettings, {}, "test")
    with pytest.raises(ConfigError, match="law"):
        settings(law="stanley")
    with pytest.raises(ConfigError, match="max_steering_rad"):
        settings(max_steering_rad=2.0)
