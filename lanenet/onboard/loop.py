"""The drive loop: frame -> detector -> steering and speed -> safety -> actuator, in one thread.

Signals that end a drive: Ctrl-C, a service that is stopped, a terminal that is gone.
"""

from __future__ import annotations

import gc
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from lanenet.control.controller import LaneController, SpeedSettings, throttle_of
from lanenet.errors import HardwareError
from lanenet.onboard.drive_report import DriveReport, Step
from lanenet.onboard.guard import CommandSink
from lanenet.onboard.hardware import Frame, FrameSource, SourceEnded
from lanenet.onboard.safety import CommandLimiter, FrameCheck, SafetyJudge, SafetySettings, State, Verdict
from lanenet.perception.estimate import Detector, LaneEstimate

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def ending_signals(stop: Callable[[str], None]) -> Iterator[None]:
    """Call ``stop`` with the signal's name instead of dying; a second signal raises KeyboardInterrupt.

    A hang-up that is ignored, as under ``nohup``, stays ignored. Elsewhere than in the main thread, where
    Python allows no handlers, nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = False

    def handle(number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        stop(signal.Signals(number).name)

    wanted = [n for n in ENDING if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
    before: dict[signal.Signals, Any] = {number: signal.signal(number, handle) for number in wanted}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


log = logging.getLogger(__name__)

#: The longest wait for a frame; the loop looks after everything else at least this often.
_WAIT_S = 0.04


@runtime_checkable
class FrameRecorder(Protocol):
    """Takes the frames of a drive; never blocks and never raises."""

    path: Path
    recorded: int
    dropped: int

    def add(self, frame_bgr: UInt8[np.ndarray, "h w 3"], t_s: float, **commands: float) -> None:
        """Hand over a frame and what the car was told."""
        ...

    def close(self) -> None:
        """Write out what waits."""
        ...


class DriveLoop:
    """Runs the car until the source ends, a signal comes, or the car has to stop for good.

    Attributes:
        report: Figures of the drive so far.
        problems: What is known to be wrong with what the detector was given, a line each.
    """

    def __init__(
        self,
        source: FrameSource,
        detector: Detector,
        controller: LaneController,
        sink: CommandSink,
        safety: SafetySettings,
        limiter: CommandLimiter,
        speed: SpeedSettings,
        *,
        armed: bool = False,
        steering_only: bool = False,
        recorder: FrameRecorder | None = None,
        record_commands: bool = True,
        watch: Callable[[Step], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Put a car together; nothing is opened.

        Args:
            source: Camera or recording.
            detector: Finds the lane.
            controller: Turns it into steering and speed.
            sink: Takes the commands.
            safety: When to slow down and stop.
            limiter: What no command exceeds.
            speed: Throttle for a speed.
            armed: Lets the motor turn, after a countdown.
            steering_only: Moves the wheels of a car that is not armed.
            recorder: Keeps the frames.
            record_commands: Record what the car was told; not where nobody hears it.
            watch: Called after every turn.
            clock: The clock of the frames' times.
        """
        self.report = DriveReport()
        self.problems: Sequence[str] = getattr(detector, "problems", ())
        self._source, self._detector, self._controller, self._sink = source, detector, controller, sink
        self._safety, self._limiter, self._speed = safety, limiter, speed
        self._armed, self._moves = armed, armed or steering_only
        self._recorder, self._watch, self._clock = recorder, watch, clock
        self._record_commands = record_commands
        self._judge, self._check = SafetyJudge(safety, armed), FrameCheck(safety)
        self._until_s = -math.inf
        self._number = -1
        self._verdict = Verdict(State.DISARMED, 0.0, False)
        self._step = Step(-1, State.DISARMED, "", 0.0, 0.0, math.nan)
        self._told = (State.DISARMED, "")
        self._asked = ""

    def run(self, max_frames: int | None = None) -> DriveReport:
        """Drive.

        Args:
            max_frames: Ends the drive after this many frames; None goes on.

        Returns:
            Figures of the drive, and why it ended.

        Raises:
            LanenetError: If camera, detector or actuator fail; the motor is in neutral by then, as after any
                other error.
        """
        with ending_signals(self.stop), _settled_memory():
            try:
                self._sink.open()
                self._source.open()
                start_s = self._clock()
                while not self._over(max_frames):
                    self.step()
                    self.report.seconds = self._clock() - start_s
            except SourceEnded:
                self.report.ended = "the recording is over"
            except BaseException as error:
                self._sink.neutral()
                if not self._asked or not isinstance(error, HardwareError):
                    when = "before the first frame" if self._number < 0 else f"in frame {self._number}"
                    log.error("neutral: %s %s: %s", type(error).__name__, when, error)
                    raise
                # Who ends this process often ends the guard as well, and that is no fault.
                self.report.ended = self._asked
            finally:
                self._close()
        log.info("neutral: %s", self.report.ended)
        return self.report

    def stop(self, why: str) -> None:
        """Go to neutral and end the drive after this turn; safe in a signal handler."""
        self._asked = why
        self._sink.neutral()

    def step(self) -> Step:
        """Take one turn: wait for a frame, answer to it.

        Raises:
            SourceEnded: If there will be no more frames.
            LanenetError: If camera, detector or actuator fail.
        """
        frame = self._source.read(_WAIT_S)
        begin_s = now_s = self._clock()
        fault = self._check.fault_of(frame, now_s)
        steering_rad, speed_cm_s, estimate = math.nan, 0.0, LaneEstimate(confidence=math.nan)
        if frame is not None:
            self._count(frame)
        if frame is not None and not fault:
            estimate = self._detector.detect(frame.image_bgr)
            gone_cm_s = self._speed_cm_s()
            wish = self._controller.wish(estimate, frame.t_s, gone_cm_s, self._limiter.steering_rad)
            steering_rad, speed_cm_s = wish.steering_rad, wish.speed_cm_s
            now_s = self._clock()
            fault = self._fault_of_answer(frame, steering_rad, now_s)
        verdict = self._judge.judge(now_s, fault, estimate.confidence)
        if now_s >= self._until_s:
            # The guard has been in neutral since then.
            self._limiter.neutral(now_s)
        if frame is not None and verdict.steers and not self._asked:
            allowed = throttle_of(verdict.speed_share * speed_cm_s, self._speed) if self._armed else 0.0
            command = self._limiter.limit(steering_rad, allowed, now_s)
            self._until_s = min(now_s + self._safety.watchdog_s, frame.t_s + self._safety.max_age_s)
            self._send(*command, self._until_s)
            self.report.work.add(self._clock() - begin_s)
            self.report.latency.add(self._clock() - frame.t_s)
        elif now_s < self._until_s and verdict.state is not State.ENDED:
            # The last command still holds: a frame may be missing without any harm.
            if frame is None:
                return self._step
            verdict = self._verdict
        else:
            # Standing, the wheels stay as they are: a car that still rolls keeps to its bend.
            self._limiter.neutral(now_s)
            self._send(self._limiter.steering_rad, 0.0, now_s + self._safety.watchdog_s)
        return self._finish(frame, verdict, estimate.confidence)

    def _fault_of_answer(self, frame: Frame, steering_rad: float, now_s: float) -> str:
        if not math.isfinite(steering_rad):
            return f"no lane in frame {frame.number}"
        age_s = now_s - frame.t_s
        if age_s > self._safety.max_age_s:
            return f"the answer to frame {frame.number} came when it was {1e3 * age_s:.0f} ms old"
        return ""

    def _send(self, steering_rad: float, throttle: float, until_s: float) -> None:
        if self._moves and not self._asked:
            self._sink.send(steering_rad, throttle, until_s)
        else:
            self._sink.idle()

    def _speed_cm_s(self) -> float:
        """Speed that the throttle stands for: nothing on the car measures it."""
        above = self._limiter.throttle - self._speed.throttle_at_rest
        return max(0.0, above) * self._speed.cm_s_per_throttle

    def _count(self, frame: Frame) -> None:
        if self._number >= 0:
            self.report.skipped += max(0, frame.number - self._number - 1)
        self._number = frame.number
        self.report.frames += 1

    def _finish(self, frame: Frame | None, verdict: Verdict, confidence: float) -> Step:
        steering_rad, throttle = self._limiter.steering_rad, self._limiter.throttle
        if frame is not None and self._recorder is not None:
            # What an unarmed car is not told is not recorded: whoever drives it then is somebody else.
            steers, drives = self._record_commands and self._moves, self._record_commands and self._armed
            commands = {"steering_rad": steering_rad} if steers else {}
            commands |= {"throttle": throttle} if drives else {}
            self._recorder.add(frame.image_bgr, frame.t_s, **commands)
        self.report.states[verdict.state] += 1
        number = -1 if frame is None else frame.number
        step = Step(number, verdict.state, verdict.reason, steering_rad, throttle, confidence)
        self._verdict, self._step = verdict, step
        self._tell(verdict)
        if verdict.state is State.ENDED:
            self.report.ended, self.report.by_fault = verdict.reason, True
        if self._watch is not None:
            self._watch(step)
        return step

    def _tell(self, verdict: Verdict) -> None:
        """Log each change once; reasons that differ in their figures are the same reason."""
        now = (verdict.state, "".join(c for c in verdict.reason if not c.isdigit()))
        if now == self._told:
            return
        self._told = now
        standing = verdict.state in (State.STOPPED, State.ENDED) or verdict.reason
        log.log(
            logging.WARNING if standing and verdict.state is not State.COUNTDOWN else logging.INFO,
            "%s%s", verdict.state, f": {verdict.reason}" if verdict.reason else "",
        )  # fmt: skip

    def _over(self, max_frames: int | None) -> bool:
        if self._asked:
            self.report.ended = self._asked
        elif max_frames is not None and self.report.frames >= max_frames:
            self.report.ended = f"{max_frames} frames, as asked"
        return bool(self.report.ended)

    def _close(self) -> None:
        self._sink.neutral()
        self._sink.close()
        try:
            self._source.close()
        finally:
            if self._recorder is not None:
                self._recorder.close()
                self.report.recorded = self._recorder.recorded
                self.report.recording = self._recorder.path if self._recorder.recorded else None
                self.report.unrecorded = self._recorder.dropped


@contextmanager
def _settled_memory() -> Iterator[None]:
    """Keep what exists out of the garbage collector's rounds, which would be pauses."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
