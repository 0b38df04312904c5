from __future__ import annotations

import os
import signal
import threading

import pytest

from lanenet.onboard.loop import ENDING, ending_signals


@pytest.mark.usefixtures("hang_up_ends")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_asks_and_a_second_ctrl_c_insists(number: signal.Signals) -> None:
    before = [signal.getsignal(n) for n in ENDING]
    heard: list[str] = []
    with pytest.raises(KeyboardInterrupt), ending_signals(heard.append):
        os.kill(os.getpid(), number)
        assert heard == [number.name]
        # As from `lanenet stop` or systemd, which do not ask whether somebody has.
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
    assert heard == [number.name]
    assert [signal.getsignal(n) for n in ENDING] == before


def test_an_ignored_hang_up_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ending_signals(lambda _: pytest.fail("was ignored before")):
            os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_leaves_the_handlers_alone() -> None:
    before = [signal.getsignal(n) for n in ENDING]
    seen: list[object] = []

    def run() -> None:
        with ending_signals(lambda _: None):
            seen.extend(signal.getsignal(n) for n in ENDING)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == before
