"""The line that is not seen, told by the other one."""

from __future__ import annotations

import numpy as np
import pytest
from tapes import tape, turned

from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.tracking.line_beside import SeenLine, WidthHere, line_beside

LANE_CM = 40.0


@pytest.mark.parametrize("marking_cm", [3.0, -3.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_the_inner_line_turns_a_lane_before_the_outer_one(marking_cm, mirrored):
    sign = -1.0 if mirrored else 1.0
    path = turned(90.0) * (sign, 1.0)
    line = SeenLine(int(mirrored), np.full(3, sign * -20.0), True, marking_cm)
    told_cm = line_beside(line, LANE_CM, tape(path, marking_cm))
    # Across the lane the inner line lies at y = 20, so there is none at 30 cm.
    np.testing.assert_allclose(told_cm[:2], sign * 20.0, atol=0.1)
    assert np.isnan(told_cm[2])


def test_at_a_corner_that_is_not_so_sharp_it_is_a_lane_away_from_what_comes_after():
    line = SeenLine(0, np.full(3, -20.0), True, 3.0)
    told_cm = line_beside(line, LANE_CM, tape(turned(45.0, 40.0), 3.0))
    # The line goes on along (1, 1) / root 2, and the other one 40 cm along (1, -1) / root 2 beside it.
    across_cm = LANE_CM / np.sqrt(2.0)
    expected_cm = -20.0 + across_cm + (30.0 - 40.0 + across_cm)
    np.testing.assert_allclose(told_cm, [20.0, 20.0, expected_cm], atol=0.5)
    assert expected_cm > 26.0


@pytest.mark.parametrize(("side", "x_cm"), [(0, -20.0), (1, 20.0)])
def test_beside_a_straight_line_it_is_straight(side, x_cm):
    path = np.array([[x_cm, 0.0], [x_cm, 100.0]])
    told_cm = line_beside(SeenLine(side, np.full(3, x_cm), True, 3.0), LANE_CM, tape(path, 3.0))
    np.testing.assert_allclose(told_cm, -x_cm, atol=0.1)


def test_beside_a_bend_it_has_the_same_centre():
    radius_cm, angle = 100.0, np.linspace(-0.5, 1.2, 60)
    # The left line of a bend to the right about (80, 0).
    path = np.column_stack([80.0 - radius_cm * np.cos(angle), radius_cm * np.sin(angle)])
    rows = np.array([0.0, 15.0, 30.0])
    seen_cm, inner_cm = (80.0 - np.sqrt(r * r - rows * rows) for r in (radius_cm, radius_cm - LANE_CM))
    told_cm = line_beside(SeenLine(0, seen_cm, True, 3.0), LANE_CM, tape(path, 3.0))
    np.testing.assert_allclose(told_cm, inner_cm, atol=0.6)


def test_what_the_end_of_the_line_would_tell_is_not_told():
    line = SeenLine(0, np.full(3, -20.0), False, 3.0)
    told_cm = line_beside(line, LANE_CM, tape(turned(90.0), 3.0))
    np.testing.assert_allclose(told_cm[:2], 20.0, atol=0.1)
    assert np.isnan(told_cm[2])
    nothing = RoadEdges(np.zeros((0, 2)), np.zeros((0, 2)))
    assert np.isnan(line_beside(line._replace(far=True), LANE_CM, nothing)[2])


def test_where_a_lane_has_widened_its_usual_width_tells_nothing():
    here = WidthHere()
    assert here.instead_of(LANE_CM) == (LANE_CM, 0.0)
    for across_cm in np.linspace(LANE_CM, 1.4 * LANE_CM, 30):
        here.look(float(across_cm))
    width_cm, sigma_cm = here.instead_of(LANE_CM)
    assert 1.3 * LANE_CM < width_cm < 1.4 * LANE_CM and 0.0 < sigma_cm < 0.1 * LANE_CM
    # Where nobody looks it may go on widening, or end.
    sigmas_cm = []
    for _ in range(10):
        here.look(None)
        sigmas_cm.append(here.instead_of(LANE_CM)[1])
    assert sigmas_cm == sorted(sigmas_cm) and sigmas_cm[-1] > 0.25 * LANE_CM
    for _ in range(60):
        here.look(None)
    assert here.instead_of(LANE_CM) == (LANE_CM, 0.0)


def test_a_lane_that_is_nearly_as_wide_as_ever_has_its_usual_width():
    here = WidthHere()
    for across_cm in (38.0, 41.0, 43.0):
        here.look(across_cm)
    assert here.instead_of(LANE_CM) == (LANE_CM, 0.0)
