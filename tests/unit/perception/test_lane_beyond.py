from __future__ import annotations

import numpy as np
import pytest

from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.tracking.lane_beyond import lane_beyond
from tests.unit.perception.tapes import tape, together

WIDTH_CM, MARKINGS_CM = 40.0, (2.0, 2.0)
LANE = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]])


def straight(
    x_cm: float, slope: float, first_cm: float, last_cm: float, marking_cm: float = 2.0
) -> RoadEdges:
    """Tape along x(y) = x_cm + slope * y."""
    y = np.array([first_cm, last_cm])
    return tape(np.stack([x_cm + slope * y, y], axis=1), marking_cm)


def lane(
    beside_cm: float, slope: float, first_cm: float, width_cm: float = WIDTH_CM, marking_cm: float = 2.0
) -> RoadEdges:
    """Both lines of a lane whose middle is that far beside the car's at y = 60 cm."""
    half_cm = 0.5 * width_cm * np.hypot(1.0, slope)
    sides = [
        straight(beside_cm - 60.0 * slope + x, slope, first_cm, 90.0, marking_cm) for x in (-half_cm, half_cm)
    ]
    return together(*sides)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("beside_cm", "slope"), [(0.0, 0.0), (10.0, 0.2), (-12.0, -0.25), (8.0, -0.15), (-14.0, 0.1)]
)
def test_a_lane_beyond_a_junction_is_found(beside_cm, slope, dtype):
    edges = lane(beside_cm, slope, 45.0)
    edges = RoadEdges(edges.points_cm.astype(dtype), edges.normals.astype(dtype))
    found_cm = lane_beyond(LANE, WIDTH_CM, MARKINGS_CM, edges)
    assert found_cm is not None and found_cm[:, 1].tolist() == [45.0, 60.0, 75.0]
    assert found_cm[:, 0] == pytest.approx(beside_cm + slope * (found_cm[:, 1] - 60.0), abs=0.8)


def test_a_dark_lane_is_found():
    found_cm = lane_beyond(LANE, WIDTH_CM, (-2.0, -2.0), lane(5.0, 0.0, 45.0, marking_cm=-2.0))
    assert found_cm is not None and found_cm[:, 0] == pytest.approx(np.full(3, 5.0), abs=0.5)


def test_only_where_both_lines_are_seen_it_is_known():
    edges = together(straight(-20.0, 0.0, 45.0, 90.0), straight(20.0, 0.0, 69.0, 90.0))
    found_cm = lane_beyond(LANE, WIDTH_CM, MARKINGS_CM, edges)
    assert found_cm is not None and found_cm[:, 1].tolist() == [75.0]
    assert found_cm[:, 0] == pytest.approx([0.0], abs=0.3)


@pytest.mark.parametrize(
    "edges",
    [
        pytest.param(straight(-20.0, 0.0, 45.0, 90.0), id="one line"),
        pytest.param(lane(0.0, 0.0, 82.0), id="both over 5 cm"),
        pytest.param(lane(0.0, 0.0, 45.0, width_cm=30.0), id="narrow"),
        pytest.param(lane(0.0, 0.0, 45.0, width_cm=52.0), id="wide"),
        pytest.param(lane(40.0, 0.0, 45.0), id="the next lane"),
        pytest.param(lane(0.0, 0.8, 45.0), id="a side road"),
        pytest.param(straight(-20.0, 0.0, 0.0, 30.0), id="nothing ahead"),
    ],
)
def test_what_is_not_the_lane_is_not_found(edges):
    assert lane_beyond(LANE, WIDTH_CM, MARKINGS_CM, edges) is None


def test_without_edges_nothing_is_found():
    assert lane_beyond(LANE, WIDTH_CM, MARKINGS_CM, RoadEdges(np.empty((0, 2)), np.empty((0, 2)))) is None


def test_of_two_lanes_the_one_where_it_is_expected_is_found():
    edges = together(*(straight(x, 0.0, 45.0, 90.0) for x in (-36.0, -20.0, 4.0, 20.0)))
    found_cm = lane_beyond(LANE, WIDTH_CM, MARKINGS_CM, edges)
    assert found_cm is not None and found_cm[:, 0] == pytest.approx(np.zeros(3), abs=0.3)
