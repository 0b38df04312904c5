"""Lines of lanes on their markings: what is measured, how surely, and what borders say of a lane."""

from __future__ import annotations

import numpy as np
import pytest
from tapes import tape

from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.lane.lines import NOTHING_CM, LineFinder
from lanenet.perception.network.lane.settings import BorderWeight
from lanenet.perception.network.lane.view import LinesInView
from lanenet.perception.network.refinement import RoadBorders

LANE = np.repeat([-20.0, 20.0], 3)
SIGMA = np.full((1, 6), 2.0)


def finder() -> LineFinder:
    return LineFinder(LinesInView(None), BorderWeight())


def left_line(from_cm: float = -4.0, to_cm: float = 46.0) -> RoadBorders:
    return RoadBorders(tape(np.array([[-20.0, from_cm], [-20.0, to_cm]]), 3.0))


def test_a_line_is_measured_where_it_is_seen_and_nowhere_else():
    lines = finder().find(LANE[None] + 1.0, SIGMA, left_line())
    np.testing.assert_allclose(lines.points_cm[0, :3], -20.0, atol=0.3)
    np.testing.assert_array_equal(lines.points_cm[0, 3:], LANE[3:] + 1.0)
    assert (lines.sigma_cm[0, :3] < 0.6).all() and (lines.sigma_cm[0, 3:] == NOTHING_CM).all()
    assert lines.unseen[0].tolist() == pytest.approx([0.0, 1.0], abs=0.1)
    assert lines.end_cm[0, 0] > 38.0 and lines.end_cm[0, 1] == 0.0


def test_a_short_piece_and_a_far_one_are_measured_less_surely():
    whole = finder().find(LANE[None], SIGMA, left_line()).sigma_cm[0, :3]
    short = finder().find(LANE[None], SIGMA, left_line(10.0, 22.0)).sigma_cm[0, :3]
    far = finder().find(LANE[None] + 5.0, SIGMA, left_line()).sigma_cm[0, :3]
    # It is seen around the middle row.
    assert (short > 3.0 * whole)[[0, 2]].all() and (far > whole).all()


def test_borders_speak_for_a_lane_and_missing_ones_against_it():
    one = finder()
    both = RoadBorders(
        RoadEdges.of_rows(
            np.concatenate([tape(np.array([[x, -4.0], [x, 46.0]]), 3.0).rows() for x in (-20.0, 20.0)])
        )
    )
    lanes = np.array([LANE, LANE + 12.0])
    on, beside = one.log_likelihood(one.find(lanes, np.full((2, 6), 0.5), both))
    assert on > 0.0 > beside


def test_what_the_camera_does_not_show_says_nothing():
    one = LineFinder(LinesInView(None), BorderWeight())
    one._view._shown[:] = False
    nothing = RoadBorders(RoadEdges(np.zeros((0, 2)), np.zeros((0, 2))))
    assert one.log_likelihood(one.find(LANE[None], SIGMA, nothing)).tolist() == [0.0]


def test_the_width_of_a_marking_is_learned_from_the_networks_lines():
    one, wide = finder(), RoadBorders(tape(np.array([[-20.0, -4.0], [-20.0, 46.0]]), 5.0))
    for _ in range(12):
        one.learn_markings(LANE, np.full(6, 2.0), np.ones(2), LANE, 5.0, wide)
    assert one.markings.usual_cm(0) == pytest.approx(5.0, abs=0.3) and one.markings.usual_cm(1) is None
    # Far from the lane that was found, it is another line.
    other = finder()
    for _ in range(12):
        other.learn_markings(LANE, np.full(6, 2.0), np.ones(2), LANE + 8.0, 5.0, wide)
    assert other.markings.usual_cm(0) is None
