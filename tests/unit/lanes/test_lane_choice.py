"""When a lane that was found freely speaks against the given width."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.lanes.path import PathEdges, path_of_poses
from datagen.lanes.trace import TracedLane, TraceSettings, _fits_better, trace_known_lane
from lanenet.errors import CalibrationError, NoLaneError


def traced(lane_cm: float, centre_cm: float, left: float, right: float) -> TracedLane:
    """A lane whose lines were seen along these shares of the path."""
    n = 100
    sides = [
        np.where(np.arange(n) < share * n, centre_cm + sign * 0.5 * lane_cm, np.nan)
        for share, sign in ((left, 1.0), (right, -1.0))
    ]
    return TracedLane(*sides, np.full(n, centre_cm), lane_cm, 2.0)


@pytest.mark.parametrize(
    ("free", "lane", "better"),
    [
        # Clutter beside a line; figures of simulated drives.
        (traced(30.0, 5.0, 1.0, 0.75), traced(40.0, 0.0, 1.0, 0.96), False),
        # The given lane has one line only.
        (traced(40.0, 0.0, 1.0, 0.9), traced(80.0, 20.0, 1.0, 0.1), True),
        # The whole road was given; the middle line is dashed and the car keeps to the right lane.
        (traced(40.0, 1.0, 0.6, 1.0), traced(80.0, 21.0, 1.0, 1.0), True),
        (traced(40.0, 0.0, 1.0, 1.0), traced(40.0, 0.0, 1.0, 1.0), False),
        # Right, though the far line is solid and that in the middle of the road dashed.
        (traced(46.0, 10.0, 1.0, 1.0), traced(23.0, -1.0, 0.8, 1.0), False),
    ],
)
def test_which_lane_is_driven(free, lane, better):
    assert _fits_better(free, lane) is better


@pytest.mark.parametrize(
    ("free", "lane", "message"),
    [
        # A bare road: pairs of clutter, of any width.
        (traced(19.0, 0.0, 0.21, 0.74), None, "no two lines 40 cm apart run along the drive$"),
        (traced(40.0, 0.0, 0.84, 1.0), None, "but two that are 40 cm apart with this camera"),
        (traced(40.0, 0.0, 0.84, 1.0), traced(36.0, 0.0, 0.05, 1.0), "but two that are 40 cm apart"),
    ],
)
def test_another_width_is_named_where_two_lines_are_seen(monkeypatch, free, lane, message):
    with pytest.raises((CalibrationError, NoLaneError), match=message):
        chosen(monkeypatch, free, lane)


@pytest.mark.parametrize(
    ("free", "lane", "mapped"),
    [
        # A road of two lanes, told as a whole: all its lines are seen, the car keeps to the right lane.
        (traced(20.0, 0.5, 0.8, 1.0), traced(40.0, 10.0, 1.0, 1.0), "free"),
        # The same, but the line in the middle is seen in few places.
        (traced(20.0, 0.5, 0.3, 1.0), traced(40.0, 10.0, 1.0, 1.0), "told"),
        # The driven lane is the wider one: the told lines lie within it, and may be anything.
        (traced(60.0, 0.5, 1.0, 1.0), traced(40.0, 10.0, 1.0, 1.0), "told"),
        # The car keeps to the middle of what was told.
        (traced(20.0, 10.0, 1.0, 1.0), traced(40.0, 0.0, 1.0, 1.0), "agreed"),
    ],
)
def test_the_lane_that_is_driven_is_mapped_where_the_width_of_several_was_told(
    monkeypatch, free, lane, mapped
):
    found, free_cm = chosen(monkeypatch, free, lane)
    assert found is (free if mapped == "free" else lane)
    assert free_cm == (None if mapped == "agreed" else free.lane_cm)


def chosen(monkeypatch, free: TracedLane, lane: TracedLane | None) -> tuple[TracedLane, float | None]:
    """The lane that is mapped where 40 cm were told, if these are found freely and with that width."""

    def trace(path, edges, height_cm, lane_width_cm, settings):
        found = free if lane_width_cm is None else lane
        if found is None:
            raise NoLaneError("no lane")
        return found

    monkeypatch.setattr("datagen.lanes.trace.trace_lane", trace)
    path = path_of_poses(np.column_stack([np.arange(0.0, 99.0, 3.0), np.zeros(33), np.zeros(33)]), 2.0, 9.0)
    none = np.zeros(0, dtype=np.int64)
    edges = PathEdges(*[np.zeros(0)] * 6, none)
    return trace_known_lane(path, edges, 17.0, 40.0, TraceSettings())
