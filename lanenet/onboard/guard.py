"""The loop's side of the guard, a watchdog process that owns the actuator.

The loop sends commands with the time at which they expire. The guard (:mod:`lanenet.onboard.guard_process`)
goes to neutral when the last one has expired, when the loop's process is gone, and when the actuator fails.
It is a process, not a thread, so that it survives whatever stops the loop: a driver that hangs, a network
that hangs, SIGKILL. If the guard itself is stopped or dies, a thread in the loop's process notices it by the
silence of its pipe, and puts the actuator into neutral through a spare access. An actuator without one is
opened again. Whoever is left repeats neutral until the actuator confirms it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from lanenet.errors import HardwareError, LanenetError
from lanenet.onboard.actuators.actuator import Actuator, Spare
from lanenet.onboard.guard_process import DRIVE, MESSAGE, NEUTRAL, QUIT
from lanenet.onboard.i2c import GUARD_MODULE
from lanenet.onboard.neutral import AGAIN_S, HOLD_S, PATIENCE_S, Neutral, reach_neutral, settle, undisturbed
from lanenet.search_path import without_working_folder

log = logging.getLogger(__name__)

#: What runs in the guard's process; -P: nothing is imported from the working folder.
PROGRAM = (sys.executable, "-P", "-m", GUARD_MODULE)
#: For the interpreter, the driver and the device; chosen ample: imports are slow on a small board,
#: and an Arduino restarts when its port is opened.
_START_S = 30.0
#: If commands stay unanswered for this long, the guard hangs in the actuator's driver. Chosen: three
#: watchdog times.
_STUCK_S = 0.25
#: A guard without a sign of life for this long is stopped, and its last command may run on. Chosen: three of
#: its turns; with the time of a write it leaves neutral within 100 ms of whatever stopped it.
_SILENT_S = 0.05
#: Neutral again this often, while it is silent.
_AGAIN_S = 0.02
#: The guard says within this time after its patience in which state it leaves the actuator; chosen ample,
#: and below the rest of ``TimeoutStopSec=`` in the service.
_LATE_S = 1.0
#: A guard that has released the actuator is gone within this time; chosen ample, since it may wait for a
#: terminal.
_CLOSE_S = 2.0
#: A killed process is gone within this time, unless it hangs in the kernel.
_DIE_S = 0.1


class StoppedError(HardwareError):
    """The guard was asked to end, as by ``lanenet stop``: no fault."""


@runtime_checkable
class CommandSink(Protocol):
    """Receiver of the loop's commands."""

    def open(self) -> None:
        """Get ready, in neutral."""
        ...

    def send(self, steering_rad: float, throttle: float, until_s: float) -> None:
        """Send a command that is valid until a time of the monotonic clock."""
        ...

    def idle(self) -> None:
        """Stay in neutral; raises HardwareError if the actuator or its guard has failed."""
        ...

    def neutral(self) -> None:
        """Go to neutral at once; safe in a signal handler, never raises."""
        ...

    def close(self) -> Neutral | None:
        """Go to neutral and release the actuator; never raises.

        Returns:
            Whether the actuator confirmed neutral; None if there is none, or it was not reached.
        """
        ...


class NoActuator:
    """Ignores commands: a dry run."""

    def open(self) -> None:
        """Do nothing."""

    def send(self, steering_rad: float, throttle: float, until_s: float) -> None:
        """Do nothing."""

    def idle(self) -> None:
        """Do nothing."""

    def neutral(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing; there is no motor."""


class GuardedActuator:
    """Starts the guard, sends it commands and reads its answers; a ``CommandSink``."""

    def __init__(
        self,
        settings_json: str,
        make_actuator: Callable[[], Actuator],
        watchdog_s: float,
        give_up_s: float,
        program: Sequence[str] = PROGRAM,
        first_json: str = "null",
    ) -> None:
        """Prepare; nothing is started.

        Args:
            settings_json: Settings of the actuator, for the guard.
            make_actuator: Makes the same actuator in this process, in case the guard dies.
            watchdog_s: The longest time that a command is valid.
            give_up_s: After a silence this long the guard accepts no more commands.
            program: Command that starts the guard; the socket and these values follow as arguments.
            first_json: The actuator's first writes (:func:`lanenet.onboard.actuators.first_writes`).
        """
        self._values = (settings_json, first_json, str(watchdog_s), str(give_up_s))
        self._make_actuator, self._program = make_actuator, program
        self._spare: Spare | None = None
        self._watch: _Watch | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None
        self._heard = b""
        self._sent = self._answered = 0
        self._waiting_since_s = 0.0
        self._ready = self._closed = self._stopped = False
        #: In which state the actuator was left, once that is known.
        self._left: Neutral | None = None

    @property
    def pid(self) -> int:
        """Process id of the guard; 0 before it is started."""
        return 0 if self._process is None else self._process.pid

    def open(self) -> None:
        """Start the guard and wait until it holds the actuator, in neutral.

        Raises:
            HardwareError: If the actuator does not answer; the message is the guard's.
        """
        self._left, self._spare = None, _spare_of(self._make_actuator())
        ours, theirs = socket.socketpair()
        heard, pulse = os.pipe()
        try:
            path = os.pathsep.join(without_working_folder(sys.path))
            # Its own session: Ctrl-C at the terminal is for the loop, which then ends the guard.
            self._process = subprocess.Popen(
                [*self._program, str(theirs.fileno()), str(pulse), *self._values],
                pass_fds=[theirs.fileno(), pulse],
                start_new_session=True,
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": path},
            )
        except BaseException:
            os.close(heard)
            ours.close()
            if self._spare is not None:
                self._spare.release()
            raise
        finally:
            os.close(pulse)
            theirs.close()
        self._line = ours
        ours.setblocking(False)
        end_s = time.monotonic() + _START_S
        try:
            while not self._ready:
                left_s = end_s - time.monotonic()
                if left_s <= 0.0:
                    raise HardwareError(f"the actuator was not ready within {_START_S:.0f} s")
                select.select([ours], [], [], left_s)
                self._listen()
        except BaseException:
            os.close(heard)
            self.close()
            raise
        self._watch = _Watch(heard, self._spare)

    def send(self, steering_rad: float, throttle: float, until_s: float) -> None:
        """Send a command; see :class:`CommandSink`.

        Raises:
            HardwareError: If the actuator failed or takes no more commands, or the guard is gone; it is for
                ``close`` to find out whether the motor is in neutral.
            StoppedError: If the guard was asked to end.
        """
        self._order(DRIVE, steering_rad, throttle, until_s)

    def idle(self) -> None:
        """Stay in neutral; see :class:`CommandSink`.

        Raises:
            HardwareError: As :meth:`send`.
        """
        self._order(NEUTRAL, 0.0, 0.0, 0.0)

    def _order(self, kind: bytes, steering_rad: float, throttle: float, until_s: float) -> None:
        self._listen()
        if self._stopped or self._closed:
            # Its process may still be ending, which is not a hanging driver.
            raise self._end()
        self._post(kind, steering_rad, throttle, until_s)
        waits = self._sent != self._answered and time.monotonic() - self._waiting_since_s > _STUCK_S
        if waits:
            # The guard cannot go to neutral any more, and the motor runs on.
            self._kill()
            raise HardwareError(
                f"the guard of the actuator has not answered for {_STUCK_S:g} s (a driver that hangs, or a "
                "busy computer) and was killed"
            )

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            # A process that hangs in the kernel cannot be killed.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_DIE_S)
        if self._line is not None:
            self._line.close()
            self._line = None

    def neutral(self) -> None:
        """Go to neutral at once; never raises."""
        if not self._ready:
            # It is in neutral by itself, and a signal must not close the line on which ``open`` waits.
            return
        with contextlib.suppress(HardwareError):
            self._post(NEUTRAL, 0.0, 0.0, 0.0)

    def close(self) -> Neutral | None:
        """Go to neutral, end the guard and wait for it; see :class:`CommandSink`.

        A guard that hangs or is gone is replaced by attempts of this process.
        """
        if self._process is None:
            return self._left
        end_s = time.monotonic() + PATIENCE_S
        with undisturbed():
            with contextlib.suppress(HardwareError):
                self._post(QUIT, 0.0, 0.0, 0.0)
            self._hear_out(end_s + _LATE_S)
            if not self._closed:
                self._kill()
                # A guard that died while it started may have left the motor of an earlier drive running.
                if self._ready or self._spare is not None:
                    left_s = max(end_s - time.monotonic(), 0.0)
                    # A line of its own is nobody else's.
                    hold_s = 0.0 if self._spare is None else HOLD_S
                    self._left = settle(self._rescue, patience_s=left_s, hold_s=hold_s)
            if self._watch is not None:
                self._watch.end()
        try:
            self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._kill()
        if self._line is not None:
            self._line.close()
        if self._spare is not None:
            self._spare.release()
        self._process = self._line = self._spare = self._watch = None
        return self._left

    def _hear_out(self, end_s: float) -> None:
        """Listen until the guard says in which state it leaves the actuator, is gone, or hangs."""
        while self._line is not None and not self._closed:
            left_s = end_s - time.monotonic()
            if left_s <= 0.0 or (self._watch is not None and self._watch.silent_s > _STUCK_S):
                log.error("the guard does not end, its driver hangs: killing it")
                return
            select.select([self._line], [], [], min(left_s, AGAIN_S))
            # Each of its lines may be an error, which was told already.
            with contextlib.suppress(HardwareError):
                self._listen()

    def _post(self, kind: bytes, steering_rad: float, throttle: float, until_s: float) -> None:
        if self._line is None:
            return
        if self._sent == self._answered:
            self._waiting_since_s = time.monotonic()
        self._sent = (self._sent + 1) & 0xFFFFFFFF
        try:
            self._line.send(MESSAGE.pack(kind, self._sent, steering_rad, throttle, until_s))
        except BlockingIOError:
            raise HardwareError("the actuator takes no more commands: its driver hangs") from None
        except OSError:
            # What it said before it closed the line.
            self._listen()
            self._lost()

    def _listen(self) -> None:
        """Read the guard's answers."""
        if self._line is None:
            return
        while True:
            # First what is left since a line was an error.
            while b"\n" in self._heard:
                line, _, self._heard = self._heard.partition(b"\n")
                self._take(line.decode("utf-8", errors="replace"))
            try:
                data = self._line.recv(4096)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._lost()
            self._heard += data

    def _take(self, line: str) -> None:
        word, _, text = line.partition(" ")
        if word == "ok":
            self._answered = int(text)
            self._waiting_since_s = time.monotonic()
        elif word == "ready":
            self._ready = True
        elif word == "neutral":
            log.debug("the guard: %s", text)
        elif word == "stopped":
            self._stopped = True
        elif word == "closed":
            self._closed = True
            left = json.loads(text)
            self._left = None if left is None else Neutral(*left)
        else:
            raise HardwareError(text)

    def _lost(self) -> None:
        """Close the line to a guard that is gone, and raise its error."""
        if self._line is not None:
            self._line.close()
            self._line = None
        raise self._end()

    def _end(self) -> HardwareError:
        if self._stopped:
            return StoppedError("stopped from outside")
        if self._closed:
            return HardwareError("the guard of the actuator has ended")
        when = "" if self._ready else " while it started"
        return HardwareError(f"the guard of the actuator (process {self.pid}) died{when}")

    def _rescue(self) -> Neutral:
        """Try to bring the actuator into neutral without the guard."""
        if self._spare is not None:
            left = self._spare.neutral()
        else:
            actuator = self._make_actuator()
            try:
                left = reach_neutral(actuator)
            finally:
                actuator.close()
        return left or Neutral(False, "the actuator cannot be opened")


def _spare_of(actuator: Actuator) -> Spare | None:
    """Return the actuator as a spare access, open; None if there is none."""
    if not isinstance(actuator, Spare):
        return None
    try:
        actuator.attach()
    except LanenetError:
        # The guard will say so.
        return None
    return actuator


class _Watch:
    """Puts the actuator into neutral while the guard gives no sign of life."""

    def __init__(self, heard: int, spare: Spare | None) -> None:
        """Start the thread; ``heard`` is the reading end of the guard's pipe."""
        self._heard, self._spare = heard, spare
        self._over = False
        self._heard_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="watch of the guard", daemon=True)
        self._thread.start()

    @property
    def silent_s(self) -> float:
        """For how long the guard has given no sign of life, [s]."""
        return time.monotonic() - self._heard_s

    def end(self) -> None:
        """End the thread, once the guard is gone; one that hangs in the driver is left behind."""
        self._over = True
        self._thread.join(_DIE_S)

    def _run(self) -> None:
        poll = select.poll()
        poll.register(self._heard, select.POLLIN)
        silent = False
        while not self._over:
            if poll.poll(1e3 * (_AGAIN_S if silent else _SILENT_S)):
                if not os.read(self._heard, 4096):
                    break
                self._heard_s, silent = time.monotonic(), False
                continue
            text = self._neutral()
            if not silent and not self._over:
                log.warning("the guard of the actuator has been silent for %g s: %s", _SILENT_S, text)
            silent = True
        os.close(self._heard)
        if self._spare is None or self._over:
            return
        # The guard is gone. A loop that is not held up finds that out, too, and takes over.
        left = settle(self._spare.neutral)
        if left is not None and left.confirmed is False and not self._over:
            log.critical("the guard of the actuator is gone: %s", left.may_run)

    def _neutral(self) -> str:
        if self._spare is None:
            return "a watchdog of the actuator's own has to stop the motor"
        left = self._spare.neutral()
        return "not open" if left is None else left.text
