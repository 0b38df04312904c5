import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.geometry.lane import lane_width_cm, mirror_points
from lanenet.perception.network.detector import confidence

LANE = np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0])
SURE, BOTH, WIDTHS = np.zeros(6), np.ones(2), (40.0, 40.0)


def test_values():
    assert confidence(LANE, SURE, BOTH, WIDTHS) == 1.0
    assert confidence(LANE, SURE, np.array([0.5, 0.5]), WIDTHS) == pytest.approx(0.75)
    assert confidence(LANE, SURE, np.array([1.0, 0.0]), WIDTHS) == 1.0
    assert confidence(LANE, SURE, np.zeros(2), WIDTHS) == 0.0
    # Half the root of 4^2 + (4 sqrt 3)^2 is 4 cm, a tenth of the width.
    sigma = np.array([0.0, 4.0, 0.0, 0.0, 4.0 * math.sqrt(3.0), 0.0])
    assert confidence(LANE, sigma, BOTH, WIDTHS) == pytest.approx(0.5)
    # One tolerance (15 % of 40 cm) too wide.
    assert confidence(LANE * 1.15, SURE, BOTH, WIDTHS) == pytest.approx(math.exp(-0.5))
    assert confidence(LANE * 0.85, SURE, BOTH, WIDTHS) == pytest.approx(math.exp(-0.5))
    assert confidence(LANE * 1.15, SURE, BOTH, (30.0, 46.1)) == 1.0
    assert confidence(-LANE, SURE, BOTH, WIDTHS) == 0.0
    assert confidence(np.full(6, np.nan), SURE, BOTH, WIDTHS) == 0.0


def test_the_known_width_counts_in_place_of_those_of_the_training():
    sigma = np.array([0.0, 4.0, 0.0, 0.0, 4.0 * math.sqrt(3.0), 0.0])
    # 4 cm are a tenth of 40 cm, and a fifth of 20.
    assert confidence(LANE, sigma, BOTH, (20.0, 100.0), 40.0) == pytest.approx(0.5)
    assert confidence(0.5 * LANE, sigma, BOTH, (20.0, 100.0), 20.0) == pytest.approx(0.2)
    assert confidence(LANE * 1.25, SURE, BOTH, (20.0, 100.0), 40.0) == pytest.approx(1.0)
    assert confidence(LANE * 1.25 * 1.15, SURE, BOTH, (20.0, 100.0), 40.0) == pytest.approx(math.exp(-0.5))


def test_one_line_tells_the_lane_where_its_width_is_known():
    for lost in (slice(0, 3), slice(3, 6)):
        points, sigma = LANE.copy(), np.zeros(6)
        points[lost] = sigma[lost] = np.nan
        assert confidence(points, sigma, BOTH, (20.0, 100.0)) == 0.0
        # 0.05 W is half the tolerance of 0.1 W.
        assert confidence(points, sigma, BOTH, (20.0, 100.0), 40.0) == pytest.approx(0.8)


def test_confidence_falls_with_one_line_in_a_bend():
    rows = np.array([0.0, 15.0, 30.0])
    # The radius is 80 cm at y = 15 cm.
    bend = np.concatenate([side + (rows - 15.0) ** 2 / 160.0 for side in (-20.0, 20.0)])
    assert confidence(bend, SURE, BOTH, WIDTHS) == pytest.approx(1.0)
    assert confidence(bend, SURE, np.array([1.0, 0.2]), WIDTHS) == pytest.approx(1.0 - 0.5 * 0.8 * 0.5)
    assert confidence(LANE, SURE, np.array([1.0, 0.2]), WIDTHS) == pytest.approx(1.0)


@pytest.mark.parametrize("sigma", [math.nan, math.inf, -1.0])
def test_a_sigma_that_is_none_gives_no_confidence(sigma):
    for at in range(6):
        assert confidence(LANE, np.where(np.arange(6) == at, sigma, 1.0), BOTH, WIDTHS) == 0.0


@pytest.mark.parametrize("presence", [math.nan, math.inf, -0.1, 4.85])
def test_a_presence_that_is_no_probability_gives_no_confidence(presence):
    for both in ([presence, 0.5], [0.5, presence]):
        assert confidence(LANE, SURE, np.array(both), WIDTHS) == 0.0


def test_lines_at_infinity_give_no_confidence():
    assert confidence(np.where(np.arange(6) == 4, math.inf, LANE), SURE, BOTH, WIDTHS) == 0.0


@given(turn=st.floats(-0.6, 0.6), shift=st.floats(-10, 10))
def test_the_width_is_measured_across_the_lane(turn, shift):
    rows = np.array([0.0, 15.0, 30.0])
    lane = np.concatenate([side / math.cos(turn) + shift + rows * math.tan(turn) for side in (-20.0, 20.0)])
    assert lane_width_cm(lane) == pytest.approx(40.0)
    assert confidence(lane, SURE, BOTH, WIDTHS) == pytest.approx(1.0)
    assert confidence(mirror_points(lane), SURE, BOTH, WIDTHS) == pytest.approx(1.0)


@given(left=st.floats(0, 1), right=st.floats(0, 1), sigma=st.floats(0.0, 30.0), width=st.floats(10.0, 90.0))
def test_it_stays_between_0_and_1_and_sinks_with_doubt(left, right, sigma, width):
    lane, presence = LANE * width / 40.0, np.array([left, right])
    value = confidence(lane, np.full(6, sigma), presence, (30.0, 60.0))
    assert 0.0 <= value <= 1.0
    assert confidence(lane, np.full(6, sigma + 1.0), presence, (30.0, 60.0)) <= value
