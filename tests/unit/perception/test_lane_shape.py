"""The lane as four numbers: its points, how they move with the car, and what a measurement does to it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.onboard.bench import example_camera
from lanenet.perception.network.lane.filter import PARTS
from lanenet.perception.network.lane.hypotheses import Hypotheses, fitted
from lanenet.perception.network.lane.settings import DoubtWeights, LaneFilterSettings
from lanenet.perception.network.lane.shape import linearised, moved, points_of
from lanenet.perception.network.lane.view import LinesInView

STEPS = np.array([1e-3, 1e-5, 1e-7, 1e-5])
lanes = st.tuples(st.floats(-15, 15), st.floats(-0.4, 0.4), st.floats(-0.01, 0.01), st.floats(20, 70)).map(
    lambda lane: np.array([[*lane[:3], math.log(lane[3])]])
)


def circle(radius_cm: float, width_cm: float) -> np.ndarray:
    """x at the label rows of a lane around (radius_cm, 0), whose centre line passes under the axle."""
    rows = np.array([0.0, 15.0, 30.0])
    return np.concatenate(
        [radius_cm - np.sqrt((radius_cm + side * width_cm) ** 2 - rows**2) for side in (0.5, -0.5)]
    )


def test_both_lines_run_beside_the_centre_line():
    straight = np.array([[2.0, 0.5, 0.0, math.log(40.0)]])
    x = 2.0 + 0.5 * np.array([0.0, 15.0, 30.0])
    half_cm = 20.0 * math.hypot(1.0, 0.5)
    np.testing.assert_allclose(points_of(straight)[0], np.concatenate([x - half_cm, x + half_cm]), atol=1e-9)
    # A parabola for a circle: 0.15 cm at the last row of 150 cm.
    bent = np.array([[0.0, 0.0, 1.0 / 150.0, math.log(40.0)]])
    np.testing.assert_allclose(points_of(bent)[0], circle(150.0, 40.0), atol=0.2)


@given(lanes)
def test_derivatives_are_those_of_small_steps(lane):
    points, change = linearised(lane)
    by_steps = (points_of(lane + np.diag(STEPS)) - points) / STEPS[:, None]
    # The foot of a point is found in two steps only, which counts in tight bends.
    off = np.abs(change[0] - by_steps.T)
    assert (off < 0.03 * np.abs(by_steps.T) + 0.15 * np.array([1.0, 10.0, 300.0, 20.0])).all()
    arguments = 4.0, 0.1, 17.0
    found, change = moved(lane, *arguments)
    by_steps = (moved(lane + np.diag(STEPS), *arguments)[0] - found) / STEPS[:, None]
    # That the new axis meets a bend further ahead is of second order.
    off = np.abs(change[0] - by_steps.T)
    assert (off < 0.03 * np.abs(by_steps.T) + 0.02 * np.array([1.0, 1.0, 100.0, 1.0])).all()


@pytest.mark.parametrize("turn_rad", [0.0, 0.12, -0.12])
def test_a_straight_line_stays_where_it_is_while_the_car_moves(turn_rad):
    travel_cm, wheelbase_cm, slope = 6.0, 17.0, 0.3
    line = np.array([[5.0, slope, 0.0, math.log(40.0)]])
    found, _ = moved(line, travel_cm, turn_rad, wheelbase_cm)
    # The axle's middle after a circle of the rear axle, in the frame before.
    x = -wheelbase_cm * math.sin(turn_rad) - travel_cm * 0.5 * turn_rad
    y = travel_cm - wheelbase_cm * (1.0 - math.cos(turn_rad))
    # A point on the line, seen from there.
    for ahead_cm in (0.0, 30.0):
        dx, dy = 5.0 + slope * ahead_cm - x, ahead_cm - y
        seen_x = dx * math.cos(turn_rad) + dy * math.sin(turn_rad)
        seen_y = -dx * math.sin(turn_rad) + dy * math.cos(turn_rad)
        assert found[0, 0] + found[0, 1] * seen_y == pytest.approx(seen_x, abs=1e-6)


def test_one_line_tells_the_other_by_what_is_known_of_the_width():
    start = Hypotheses(
        np.array([[0.0, 0.0, 0.0, math.log(40.0)]]), np.diag([30.0, 0.4, 0.02, 0.03])[None] ** 2, np.zeros(1)
    )
    true_cm = np.array([[-18.0, -16.5, -15.0, 22.2, 23.7, 25.2]])
    sigma_cm = np.array([[0.3] * 3 + [1e3] * 3])
    found = fitted(start, true_cm * [1, 1, 1, 0, 0, 0], sigma_cm, 0.3)
    np.testing.assert_allclose(points_of(found.states), true_cm, atol=0.4)
    covariance = found.covariances[0]
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-9)
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    # Nothing told of the width.
    assert math.sqrt(covariance[3, 3]) == pytest.approx(0.03, rel=0.02)


def test_bins_in_view_are_those_that_the_camera_shows():
    camera, line = example_camera(), np.zeros((1, 3))
    further = replace(camera, mounting=replace(camera.mounting, ahead_of_front_axle_cm=40.0))
    bins = [LinesInView(each).bins(line)[0] for each in (None, camera, further)]
    assert bins[0] == 15.0 and bins[0] >= bins[1] > bins[2]


def test_weights_of_the_doubt_are_all_but_the_bound():
    assert len(DoubtWeights().weights) == len(DoubtWeights.model_fields) - 1
    assert list(DoubtWeights.model_fields)[:-1] == list(PARTS)
    assert LaneFilterSettings().doubt.most_lanes < 0.5
