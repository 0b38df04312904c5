import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.geometry.lane import PARABOLA_FROM_POINTS, parallel_points

ROWS = np.array([0.0, 15.0, 30.0])


@given(turn=st.floats(-0.8, 0.8), place=st.floats(-40, 40), distance=st.floats(-70, 70))
def test_straight_lines_are_exact(turn, place, distance):
    line = place + ROWS * math.tan(turn)
    np.testing.assert_allclose(parallel_points(line, distance), line + distance / math.cos(turn), atol=1e-6)


@given(
    a=st.floats(-0.004, 0.004),
    b=st.floats(-0.4, 0.4),
    c=st.floats(-30, 30),
    distance=st.sampled_from([-40.0, 25.0]),
)
def test_each_point_lies_at_the_distance_from_the_line(a, b, c, distance):
    line = (a * ROWS + b) * ROWS + c
    y = np.linspace(-80.0, 120.0, 20_001)
    x = (a * y + b) * y + c
    for row, found in zip(ROWS, parallel_points(line, distance), strict=True):
        nearest = np.hypot(x - found, y - row).min()
        assert nearest == pytest.approx(abs(distance), abs=0.01)
        at_row = (a * row + b) * row + c
        assert (found - at_row) * distance > 0.0


def test_circles_about_one_centre():
    # Near its vertex a parabola is a circle; both rows beside the vertex stay within half a millimetre.
    radius, distance = 400.0, 40.0
    rows = ROWS - 15.0
    a = 0.5 / radius
    line = a * rows**2
    inner = parallel_points(line, distance) - distance
    curvature = 2.0 * (PARABOLA_FROM_POINTS @ inner)[0]
    assert curvature == pytest.approx(1.0 / (radius - distance), rel=0.01)


def test_no_parallel_inside_a_tight_bend_and_none_without_a_point():
    assert np.isnan(parallel_points(0.02 * ROWS**2, 40.0)).any()
    assert np.isfinite(parallel_points(0.02 * ROWS**2, -40.0)).all()
    assert np.isnan(parallel_points(np.array([0.0, np.nan, 1.0]), 5.0)).all()


def test_a_line_is_believed_only_so_far_beyond_its_points():
    # At 30 degrees the parallel 40 cm to the right lies across the line's points 20 cm further on.
    line = ROWS * math.tan(math.radians(30.0))
    assert np.isfinite(parallel_points(line, 40.0, 21.0)).all()
    np.testing.assert_array_equal(np.isfinite(parallel_points(line, 40.0, 19.0)), [True, True, False])
    np.testing.assert_array_equal(np.isfinite(parallel_points(line, -40.0, 19.0)), [False, True, True])
