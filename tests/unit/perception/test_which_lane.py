"""Whether it is known in which lane a car is."""

from __future__ import annotations

import pytest

from lanenet.perception.network.tracking.which_lane import WhichLane

FAR = 0.5


def lost(frames: int) -> WhichLane:
    which = WhichLane()
    assert which.find(shown=True)
    for _ in range(frames):
        which.keep(known=False)
    return which


def test_a_lane_that_was_out_of_sight_for_a_moment_is_the_same():
    assert lost(2).find(shown=False)


def test_a_lane_that_was_lost_is_found_with_both_of_its_lines():
    which = lost(3)
    assert [which.find(shown) for shown in (False, False, True, False)] == [False, False, True, True]


def test_a_single_line_that_stays_in_sight_is_the_lanes_in_the_end():
    which = lost(3)
    assert [which.find(shown=False) for _ in range(14)] == [False] * 12 + [True] * 2


def test_frames_without_a_lane_count_while_it_is_looked_for_and_do_not_begin_it_anew():
    which = lost(3)
    assert not which.find(shown=False)
    for _ in range(8):
        which.keep(known=False)
    assert [which.find(shown=False) for _ in range(5)] == [False] * 3 + [True] * 2


def test_a_lane_that_was_never_known_is_not_lost():
    which = WhichLane()
    for _ in range(5):
        which.keep(known=False)
    assert which.find(shown=False)


def test_a_lane_that_is_known_without_its_lines_is_not_lost():
    which = lost(2)
    which.keep(known=True)
    which.keep(known=False)
    assert which.find(shown=False)


@pytest.mark.parametrize(
    ("beside", "seen", "guess"),
    [(0.01, True, True), (0.03, True, False), (0.2, False, True), (0.2, True, False), (0.3, False, False)],
)
def test_near_a_line_that_is_not_seen_the_side_is_a_guess(beside, seen, guess):
    assert WhichLane().is_a_guess(beside, seen) is guess


def test_beyond_a_crossed_line_the_side_is_a_guess_until_the_car_has_arrived():
    which = WhichLane()
    which.enter()
    which.arrive(0.2, shown=False)
    assert which.is_a_guess(FAR, seen=True)
    which.arrive(0.2, shown=True)
    assert not which.is_a_guess(FAR, seen=True)
    which.enter()
    which.arrive(0.3, shown=False)
    assert not which.is_a_guess(FAR, seen=True)


def test_reset_forgets():
    which = lost(5)
    which.enter()
    which.reset()
    assert which.find(shown=False) and not which.is_a_guess(FAR, seen=True)
