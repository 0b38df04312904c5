"""Neutral as a fact: what the hardware confirms of it, and its repetition until it does.

Imports little: the guard and ``lanenet stop`` need it before anything else.
"""

from __future__ import annotations

import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, Protocol, runtime_checkable

from lanenet.errors import HardwareError

log = logging.getLogger(__name__)

#: Ctrl-C, a stopped service, a closed terminal.
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Neutral is repeated for this long until the hardware confirms it. Chosen: a connector that slipped is back
#: within seconds, and a person who waits for longer has disconnected the battery.
PATIENCE_S = 15.0
#: Where nothing can be read back, neutral is repeated for this long: an outage of the wire by motor noise is
#: shorter.
SENT_S = 0.5
#: Between two attempts; a command takes a few milliseconds.
AGAIN_S = 0.01
#: An attempt is over within this time, unless its driver hangs.
_JOIN_S = 0.1
#: Neutral has to hold for this long at the end of a drive: another program that moves the car, as Donkeycar's
#: loop does 20 times per second, has written again by then.
HOLD_S = 0.25


class Neutral(NamedTuple):
    """What is known of the motor after neutral was sent.

    Attributes:
        confirmed: Whether the hardware holds neutral; None where nothing can be read back.
        why: Why it is not confirmed.
    """

    confirmed: bool | None
    why: str = ""

    @property
    def text(self) -> str:
        """The state in words; "neutral" without an addition only where it is confirmed."""
        if self.confirmed:
            return "neutral"
        reason = f" ({self.why})" if self.why else ""
        return f"neutral {'sent, ' if self.confirmed is None else ''}not confirmed{reason}"

    @property
    def may_run(self) -> str:
        """What a person has to do if neutral could be confirmed and was not."""
        return f"the motor may run, disconnect the battery: {self.text}"


CONFIRMED, SENT = Neutral(True), Neutral(None)


def settle(
    neutral: Callable[[], Neutral | None],
    turn: Callable[[], bool] | None = None,
    patience_s: float | None = None,
    hold_s: float = 0.0,
) -> Neutral | None:
    """Repeat neutral until the hardware confirms it, or the time is over.

    A driver may hang, so the attempts are made in a thread, which is left behind if it does not return.

    Args:
        neutral: One attempt; None if its device is not open, which ends the attempts.
        turn: Called after the first attempt, and then every ``AGAIN_S``; no answer counts of an attempt that
            began before it has returned True. None for a device that nobody else drives.
        patience_s: Longest time, [s], ``PATIENCE_S`` by default; ``SENT_S`` where nothing can be read back.
        hold_s: For this long all attempts have to be confirmed, [s].

    Returns:
        The last attempt's answer; None if the device is not open.
    """
    doubt, since_s = Neutral(False, "the actuator's driver does not return"), math.inf
    answer: Neutral | None = doubt
    begun = done = 0
    over, fresh = threading.Event(), threading.Event()

    def repeat() -> None:
        nonlocal answer, begun, done
        while not over.is_set():
            begun += 1
            try:
                answer = neutral()
            except Exception as error:
                answer = Neutral(False, f"{type(error).__name__}: {error}")
            done = begun
            fresh.set()
            over.wait(AGAIN_S)

    patience_s = PATIENCE_S if patience_s is None else patience_s
    start_s = time.monotonic()
    counts, ignored, told = turn is None, 0, False
    attempts = threading.Thread(target=repeat, name="neutral", daemon=True)
    attempts.start()
    try:
        while True:
            fresh.wait(AGAIN_S)
            fresh.clear()
            now_s = time.monotonic()
            passed_s, holds = now_s - start_s, counts and done > ignored
            if holds and (answer is None or answer.confirmed):
                since_s = min(since_s, now_s)
                if answer is None or now_s - since_s >= hold_s:
                    return answer
            elif holds:
                since_s = math.inf
            if answer is not None and not answer.confirmed:
                doubt = answer
            unreadable = counts and answer is not None and answer.confirmed is None
            if passed_s >= (SENT_S if unreadable else patience_s):
                return doubt if counts else Neutral(False, "what drives has not ended")
            if not told and passed_s >= SENT_S and answer is not None and not unreadable:
                told = True
                text = (
                    doubt.may_run
                    if counts
                    else "a command or a drive has not ended yet; neutral is sent meanwhile"
                )
                log.warning("%s; tried for %g s", text, patience_s)
            if turn is not None:
                if (agreed := turn()) and not counts:
                    # An attempt that had begun before may have been undone since.
                    ignored = begun
                counts = agreed
    finally:
        over.set()
        # The device is closed next; a driver that hangs is not waited for.
        attempts.join(_JOIN_S)


@runtime_checkable
class Reachable(Protocol):
    """An actuator or a spare access to one."""

    def open(self) -> None:
        """Connect."""
        ...

    def neutral(self) -> Neutral | None:
        """Put the motor into neutral; None if it is not open."""
        ...


def reach_neutral(actuator: Reachable) -> Neutral | None:
    """Try once to bring an actuator into neutral, which is opened for it if it is not open.

    Returns:
        As of :meth:`Reachable.neutral`; None if it cannot be opened, or another process owns it.
    """
    left = actuator.neutral()
    if left is None:
        # One that is there and does not answer stays open.
        with suppress(HardwareError):
            actuator.open()
        left = actuator.neutral()
    return left


@contextmanager
def undisturbed() -> Iterator[None]:
    """Let no ending signal interrupt what brings the motor into neutral; does nothing in other threads."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def refuse(number: int, _frame: Any) -> None:
        log.warning("%s: neutral is being confirmed first", signal.Signals(number).name)

    before = {n: signal.signal(n, refuse) for n in ENDING if signal.getsignal(n) != signal.SIG_IGN}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
