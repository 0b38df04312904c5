"""Which lane it is, by the hues and the gaps of its lines."""

from __future__ import annotations

import math

import pytest

from lanenet.perception.network.lane.looks import LineLooks

YELLOW_DASHES, WHITE = [0.8, 0.2, 0.2], [0.0, 0.0, 0.02]
WHITE_DASHES = [0.0, 0.0, 0.25]


def seen(keep, left, right, frames=40):
    looks = LineLooks(keep)
    for _ in range(frames):
        looks.remember(0, left)
        looks.remember(1, right)
        looks.judge()
    return looks


@pytest.mark.parametrize("middle", [YELLOW_DASHES, WHITE_DASHES])
def test_the_line_between_the_lanes_tells_the_lane(middle):
    assert seen("right", middle, WHITE).own_lane > 0.95
    assert seen("right", WHITE, middle).own_lane < 0.05
    assert seen("left", WHITE, middle).own_lane > 0.95
    assert seen("right", WHITE, WHITE).own_lane == pytest.approx(0.5)
    assert math.isnan(seen(None, middle, WHITE).own_lane)


def test_a_few_frames_tell_little():
    assert seen("right", YELLOW_DASHES, WHITE, frames=9).own_lane == 0.5
    assert 0.5 < seen("right", YELLOW_DASHES, WHITE, frames=12).own_lane < 0.8


def test_beyond_the_middle_is_the_other_lane_whose_right_line_that_is():
    looks = seen("right", YELLOW_DASHES, WHITE)
    looks.cross(0)
    assert looks.own_lane < 0.05
    # The line beyond it is as white as the one that was left: that stays the other lane.
    for _ in range(40):
        looks.remember(0, WHITE)
        looks.judge()
    assert looks.own_lane < 0.05


def test_nothing_is_known_after_a_reset():
    looks = seen("right", YELLOW_DASHES, WHITE)
    looks.reset()
    assert looks.own_lane == 0.5
