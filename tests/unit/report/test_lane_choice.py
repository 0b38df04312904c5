"""When a lane that was found freely speaks against the given width."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.lanes.trace import TracedLane
from datagen.report.mappable import _fits_better


def traced(lane_cm: float, centre_cm: float, left: float, right: float) -> TracedLane:
    """A lane whose lines were seen along these shares of the way."""
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
