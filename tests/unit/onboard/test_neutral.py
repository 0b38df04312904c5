from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

import pytest

from lanenet.errors import HardwareError
from lanenet.onboard import neutral
from lanenet.onboard.neutral import CONFIRMED, SENT, Neutral, reach_neutral, settle, undisturbed

DOUBT = Neutral(False, "no answer")


def answers(*states: Neutral | None) -> Callable[[], Neutral | None]:
    """Return attempts that come out one after the other, the last one again and again."""
    left = list(states)
    return lambda: left.pop(0) if len(left) > 1 else left[0]


def test_neutral_without_an_addition_is_a_confirmed_one() -> None:
    assert CONFIRMED.text == "neutral"
    assert SENT.text == "neutral sent, not confirmed"
    assert DOUBT.text == "neutral not confirmed (no answer)"
    assert DOUBT.may_run == "the motor may run, disconnect the battery: neutral not confirmed (no answer)"


def test_it_is_repeated_until_it_is_confirmed() -> None:
    begun_s = time.monotonic()
    assert settle(answers(DOUBT, DOUBT, DOUBT, CONFIRMED)) == CONFIRMED
    assert time.monotonic() - begun_s < 0.5
    assert settle(answers(None)) is None


def test_the_time_is_bounded_whatever_the_driver_does() -> None:
    def fail() -> Neutral:
        raise OSError("unplugged")

    hangs = threading.Event()
    begun_s = time.monotonic()
    assert settle(answers(DOUBT), patience_s=0.1) == DOUBT
    assert settle(fail, patience_s=0.1) == Neutral(False, "OSError: unplugged")
    stuck = settle(lambda: CONFIRMED if hangs.wait(9.0) else DOUBT, patience_s=0.1)
    assert stuck is not None and stuck.confirmed is False and "does not return" in stuck.why
    assert time.monotonic() - begun_s < 1.0
    hangs.set()


def test_where_nothing_can_be_read_half_a_second_is_enough() -> None:
    begun_s = time.monotonic()
    assert settle(answers(SENT)) == SENT
    assert 0.4 < time.monotonic() - begun_s < 2.0


def test_an_answer_counts_only_once_nobody_else_drives() -> None:
    owners = answers(*[None] * 5, CONFIRMED)
    seen = []

    def attempt() -> Neutral:
        seen.append(time.monotonic())
        return CONFIRMED

    turns = []

    def turn() -> bool:
        turns.append(time.monotonic())
        return owners() is not None

    assert settle(attempt, turn) == CONFIRMED
    # It is sent all the while, and once more after the owner has gone.
    assert seen[0] < turns[0] and seen[-1] > turns[-1]
    never = settle(attempt, lambda: False, patience_s=0.1)
    assert never is not None and never.confirmed is False and "not ended" in never.why


def test_neutral_is_tried_even_if_the_owner_cannot_be_ended() -> None:
    tried = []

    def turn() -> bool:
        raise HardwareError("of another user")

    with pytest.raises(HardwareError):
        settle(lambda: tried.append(1) or CONFIRMED, turn)
    assert tried


class Chip:
    """An actuator that is there from some attempt on."""

    def __init__(self, opens: bool) -> None:
        self.opens, self.is_open = opens, False

    def open(self) -> None:
        self.is_open = self.opens
        raise HardwareError("no answer, or somebody else's")

    def neutral(self) -> Neutral | None:
        return DOUBT if self.is_open else None


def test_an_actuator_that_does_not_answer_yet_is_tried_and_one_of_somebody_else_is_not() -> None:
    assert reach_neutral(Chip(opens=True)) == DOUBT
    assert reach_neutral(Chip(opens=False)) is None


def test_signals_wait_until_the_motor_is_in_neutral(caplog: pytest.LogCaptureFixture) -> None:
    before = {number: signal.getsignal(number) for number in neutral.ENDING}
    with undisturbed():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
    assert "SIGTERM: neutral is being confirmed first" in caplog.text
    assert {number: signal.getsignal(number) for number in neutral.ENDING} == before
