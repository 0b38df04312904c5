"""Corners at which a line's tape turns off it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tapes import tape, together, turned

from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network import compiled
from lanenet.perception.network import corner as corner_module
from lanenet.perception.network.corner import Corner, corners
from lanenet.perception.network.refinement import RoadBorders

STRAIGHT_CM = [-20.0] * 3


def corner_of(edges: RoadEdges, points_cm=STRAIGHT_CM, marking_cm: float = 3.0) -> Corner | None:
    (corner,) = corners([points_cm], [marking_cm], RoadBorders(edges))
    return corner


@pytest.mark.parametrize("turn_deg", [40.0, 70.0, 85.0, 110.0])
@pytest.mark.parametrize("marking_cm", [2.0, 4.0, -3.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_tape_that_turns_ends_its_line(turn_deg, marking_cm, mirrored):
    sign = -1.0 if mirrored else 1.0
    path = turned(turn_deg, 22.0) * (sign, 1.0)
    corner = corner_of(tape(path, marking_cm), [sign * -20.0] * 3, marking_cm)
    assert corner is not None
    assert corner.ahead_cm == pytest.approx(22.0, abs=1.5)
    assert corner.aside_cm * sign > 0.0
    assert corner.cosine == pytest.approx(math.cos(math.radians(turn_deg)), abs=0.02)


@pytest.mark.parametrize(
    "other",
    [
        # A stop line that meets it, one of the next lane's lines, and a dash that lies aside.
        np.array([[-18.5, 20.0], [20.0, 20.0]]),
        np.array([[20.0, 0.0], [20.0, 60.0]]),
        np.array([[-10.0, 10.0], [0.0, 20.0]]),
    ],
)
def test_a_line_that_goes_on_has_no_corner(other):
    line = tape(np.array([[-20.0, 0.0], [-20.0, 80.0]]), 3.0)
    assert corner_of(together(line, tape(other, 3.0))) is None


def test_a_line_that_ends_has_no_corner():
    line = tape(np.array([[-20.0, 0.0], [-20.0, 22.0]]), 3.0)
    assert corner_of(line) is None
    # What lies aside does not belong to it: there is floor between the two.
    assert corner_of(together(line, tape(np.array([[-12.0, 26.0], [20.0, 30.0]]), 3.0))) is None


def test_a_bend_has_no_corner():
    radius_cm, angle = 60.0, np.linspace(-0.2, 1.2, 60)
    path = np.column_stack([40.0 - radius_cm * np.cos(angle), radius_cm * np.sin(angle)])
    seen_cm = (40.0 - np.sqrt(radius_cm**2 - np.array([0.0, 15.0, 30.0]) ** 2)).tolist()
    assert corner_of(tape(path, 3.0), seen_cm) is None


def test_the_rim_of_a_reflection_is_no_tape():
    line = tape(np.array([[-20.0, 0.0], [-20.0, 22.0]]), 3.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 80)
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    # It begins where the line ends, and goes on aside.
    rim = RoadEdges(out * 9.0 + (-11.0, 28.0), -out)
    assert corner_of(together(line, rim)) is None


def test_the_inner_line_of_a_corner_turns_before_the_outer_one():
    right_angle = Corner(25.0, 10.0, 0.0)
    # A left line that turns to the right is the outer one, and a right line the inner one.
    assert right_angle.of_other_cm(0, 40.0) == pytest.approx(25.0 - 40.0)
    assert right_angle.of_other_cm(1, 40.0) == pytest.approx(25.0 + 40.0)
    sharp = Corner(25.0, 10.0, math.cos(math.radians(120.0)))
    assert sharp.of_other_cm(0, 40.0) == pytest.approx(25.0 - 40.0 * math.tan(math.radians(60.0)))
    half = Corner(25.0, -10.0, math.cos(math.radians(45.0)))
    assert half.of_other_cm(1, 40.0) == pytest.approx(25.0 - 40.0 * math.tan(math.radians(22.5)))


def test_tape_that_only_ends_beside_the_line_is_no_corner():
    """Six edge points are not enough, nor is a spot of tape."""
    line = tape(np.array([[-20.0, 0.0], [-20.0, 22.0]]), 3.0)
    spot = tape(np.array([[-18.0, 23.0], [-15.0, 24.0]]), 3.0)
    assert corner_of(together(line, spot)) is None
    assert corner_of(together(line, tape(np.array([[-18.0, 23.0], [-6.0, 27.0]]), 3.0))) is not None


def test_a_crowded_frame_is_looked_at_in_parts(monkeypatch):
    edges = tape(turned(70.0, 22.0), 3.0)
    found = corner_of(edges)
    monkeypatch.setattr(compiled, "_kernels", None)
    monkeypatch.setattr(corner_module, "_AT_A_TIME", 7)
    assert corner_of(edges) == found


def test_without_edges_or_lines_there_are_none():
    nothing = RoadBorders(RoadEdges(np.zeros((0, 2)), np.zeros((0, 2))))
    assert corners([STRAIGHT_CM, STRAIGHT_CM], [3.0, 3.0], nothing) == [None, None]
    assert corners([], [], nothing) == []
