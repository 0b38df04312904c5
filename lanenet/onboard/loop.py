"""The drive loop: frame -> detector -> steering and speed -> safety -> actuator, in one thread.

Its report, with rate, latencies and states, takes constant memory.
"""

from __future__ import annotations

import gc
import logging
import math
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from jaxtyping import Int

from lanenet.control.controller import LaneController, SpeedSettings, Target, throttle_of
from lanenet.data.drives.recorder import DriveRecorder
from lanenet.errors import HardwareError, MotorMayRunError, counted
from lanenet.onboard.arming import ArmGate, HoldFile
from lanenet.onboard.devices import Frame, FrameSource, SourceEnded
from lanenet.onboard.frame_check import FrameCheck
from lanenet.onboard.guard import CommandSink, StoppedError
from lanenet.onboard.neutral import ENDING, undisturbed
from lanenet.onboard.safety import (
    CommandLimiter,
    LimitSettings,
    SafetyJudge,
    SafetySettings,
    State,
    Verdict,
)
from lanenet.perception.camera_check import CameraCheck, Concern, Finding
from lanenet.perception.estimate import Detector, LaneEstimate

log = logging.getLogger(__name__)

#: Longest wait for a frame, after which the loop looks after everything else. Chosen: half the watchdog's
#: 80 ms, so that a missing frame is judged before the last command runs out.
_WAIT_S = 0.04
#: Fine beside a frame's work of a few milliseconds; the bins reach to 500 ms, five times the largest age.
_BIN_MS = 0.05
_BINS = 10_000


@dataclass(frozen=True)
class CarParts:
    """What a drive loop connects; nothing is open yet.

    Attributes:
        source: Camera or recording.
        detector: Finds the lane.
        controller: Turns the lane into steering and speed.
        sink: Takes the commands.
        recorder: Keeps the frames; None for no recording.
        camera_check: Compares the images with the calibration; None for no check.
        gate: Checks before the countdown of an armed car; None for none.
        hold: The operator's file, without which the car stops; None for none.
    """

    source: FrameSource
    detector: Detector
    controller: LaneController
    sink: CommandSink
    recorder: DriveRecorder | None = None
    camera_check: CameraCheck | None = None
    gate: ArmGate | None = None
    hold: HoldFile | None = None


@dataclass(frozen=True)
class DriveMode:
    """What the car is allowed to do.

    Attributes:
        armed: The motor may turn, after a countdown.
        steering_only: The wheels of a car that is not armed may move.
        record_commands: Record the commands; not in a dry run, where they do not move the car.
    """

    armed: bool = False
    steering_only: bool = False
    record_commands: bool = True

    @property
    def moves(self) -> bool:
        """Whether any command is sent."""
        return self.armed or self.steering_only

    @property
    def drives(self) -> bool:
        """Whether the car moves as commanded; else somebody pushes or steers it, or it is a recording."""
        return self.armed and self.record_commands


class DriveLoop:
    """Runs the car until the source ends, a signal comes, or the car has to stop for good.

    Attributes:
        report: Figures of the drive so far.
        problems: What the detector warns of, a line each.
    """

    def __init__(
        self,
        parts: CarParts,
        safety: SafetySettings,
        limits: LimitSettings,
        speed: SpeedSettings,
        mode: DriveMode,
        watch: Callable[[Step], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
        show: Callable[[Frame, LaneEstimate, Step], None] | None = None,
    ) -> None:
        """Connect the parts; nothing is opened.

        Args:
            parts: Camera, detector, controller, actuator and recorder.
            safety: When to slow down and stop.
            limits: Limits of every command.
            speed: Throttle for a speed.
            mode: What the car is allowed to do.
            watch: Called after every turn of the loop.
            clock: The clock of the frames' times, [s].
            show: Called with each frame, what was seen in it and its turn, after the command.
        """
        self.report = DriveReport()
        self.problems: Sequence[str] = getattr(parts.detector, "problems", ())
        self._parts, self._mode, self._safety, self._speed = parts, mode, safety, speed
        self._watch, self._clock, self._show = watch, clock, show
        self._limiter = CommandLimiter(limits)
        self._judge, self._check = SafetyJudge(safety, mode.armed), FrameCheck(safety)
        self._until_s = -math.inf
        self._number = -1
        self._verdict = Verdict(State.DISARMED, 0.0, False)
        self._step = Step(-1, State.DISARMED, "", 0.0, 0.0, math.nan)
        self._logged = (State.DISARMED, "")
        self._finding = Finding()
        #: Why the drive was asked to end: a signal's name; empty while it goes on.
        self._asked = ""

    def run(self, max_frames: int | None = None) -> DriveReport:
        """Drive.

        Args:
            max_frames: End the drive after this many frames; None for no limit.

        Returns:
            Figures of the drive, and why it ended.

        Raises:
            LanenetError: If camera, detector or actuator fail.
            MotorMayRunError: If the actuator did not confirm neutral at the end, after whatever end.
        """
        failure: BaseException | None = None
        with ending_signals(self.stop), _settled_memory():
            try:
                self._parts.sink.open()
                self._parts.source.open()
                start_s = self._clock()
                while not self._over(max_frames):
                    self.step()
                    self.report.seconds = self._clock() - start_s
            except SourceEnded:
                self.report.ended = "the recording is over"
            except BaseException as error:
                if isinstance(error, StoppedError) or (self._asked and isinstance(error, HardwareError)):
                    # Whatever ended this process often ends the guard too: no fault.
                    self.report.ended = self._asked or str(error)
                else:
                    failure = error
                    when = "before the first frame" if self._number < 0 else f"in frame {self._number}"
                    self.report.ended = f"{type(error).__name__} {when}: {error}"
            with undisturbed():
                self._parts.sink.neutral()
                left = self._parts.sink.close()
                may_run = left is not None and left.confirmed is False
                state = "ended" if left is None else left.may_run if may_run else left.text
                level = logging.INFO if failure is None and not may_run else logging.ERROR
                log.log(level, "%s: %s", state, self.report.ended)
                unclosed = self._close()
        if unclosed is not None and self._asked:
            log.error("while it was closed: %s", unclosed)
        elif unclosed is not None:
            failure = failure or unclosed
        if may_run:
            raise MotorMayRunError(f"{state}; ended: {self.report.ended}") from failure
        if failure is not None:
            raise failure
        return self.report

    def stop(self, why: str) -> None:
        """Go to neutral and end the drive after this turn; safe in a signal handler."""
        self._asked = why
        self._parts.sink.neutral()

    def step(self) -> Step:
        """Take one turn: wait for a frame and send the command for it.

        Raises:
            SourceEnded: If there will be no more frames.
            LanenetError: If camera, detector or actuator fail.
        """
        frame = self._parts.source.read(_WAIT_S)
        begin_s = now_s = self._clock()
        if frame is None and now_s < self._until_s:
            # The last command is still valid: a slow camera has no frame for every turn, which is no fault
            # and must not begin the countdown anew.
            return self._step
        fault = frame_fault = self._check.fault_of(frame, now_s)
        steering_rad, speed_cm_s, estimate = math.nan, 0.0, LaneEstimate(confidence=math.nan)
        if frame is not None:
            self._count(frame)
        if frame is not None and not fault:
            motion = self._speed_cm_s(), self._limiter.steering_rad
            if self._mode.drives:
                self._parts.controller.tell(self._parts.detector, frame.t_s, *motion)
            estimate = self._parts.detector.detect(frame.image_bgr)
            target = self._parts.controller.target(estimate, frame.t_s, *motion)
            steering_rad, speed_cm_s = target.steering_rad, target.speed_cm_s
            now_s = self._clock()
            fault = self._fault_of_answer(frame, target, now_s)
        fault = self._keeps_from_driving(frame, frame_fault, estimate.confidence, now_s) or fault
        finding = self._finding
        caution = finding.text if finding.concern is Concern.SLOW else ""
        verdict = self._judge.judge(now_s, fault, estimate.confidence, caution)
        if now_s >= self._until_s:
            # The guard has been in neutral since then.
            self._limiter.neutral(now_s)
        if frame is not None and verdict.steers and not self._asked:
            allowed = throttle_of(verdict.speed_share * speed_cm_s, self._speed) if self._mode.armed else 0.0
            command = self._limiter.limit(steering_rad, allowed, now_s)
            self._until_s = min(now_s + self._safety.watchdog_s, frame.t_s + self._safety.max_age_s)
            self._send(*command, self._until_s)
            self.report.work.add(self._clock() - begin_s)
            self.report.latency.add(self._clock() - frame.t_s)
            self.report.age_known &= frame.age_known
        elif now_s < self._until_s and verdict.state is not State.ENDED:
            # The last command is still valid: a bad frame does no harm yet.
            verdict = self._verdict
        else:
            # The wheels stay as they are: a car that still rolls stays in its bend.
            self._limiter.neutral(now_s)
            self._send(self._limiter.steering_rad, 0.0, now_s + self._safety.watchdog_s)
        return self._finish(frame, verdict, estimate)

    def _keeps_from_driving(
        self, frame: Frame | None, frame_fault: str, confidence: float, now_s: float
    ) -> str:
        """Return why the car must not drive whatever the lane is; empty if it may."""
        hold, gate = self._parts.hold, self._parts.gate
        if gate is not None and (fault := gate.fault_of(frame, frame_fault, confidence, now_s)):
            return fault
        if hold is not None and hold.fault:
            return f"not held: {hold.fault}"
        return self._finding.text if self._finding.concern is Concern.STOP else ""

    def _fault_of_answer(self, frame: Frame, target: Target, now_s: float) -> str:
        if not math.isfinite(target.steering_rad):
            return f"no lane in frame {frame.number}{f': {target.fault}' if target.fault else ''}"
        age_s = now_s - frame.t_s
        if age_s > self._safety.max_age_s:
            return f"the answer to frame {frame.number} came when it was {1e3 * age_s:.0f} ms old"
        return ""

    def _send(self, steering_rad: float, throttle: float, until_s: float) -> None:
        if self._mode.moves and not self._asked:
            self._parts.sink.send(steering_rad, throttle, until_s)
        else:
            self._parts.sink.idle()

    def _speed_cm_s(self) -> float:
        """Return the speed that the throttle stands for, [cm/s]; nothing on the car measures it."""
        above = self._limiter.throttle - self._speed.throttle_at_rest
        return max(0.0, above) * self._speed.cm_s_per_throttle

    def _count(self, frame: Frame) -> None:
        if self._number >= 0:
            self.report.skipped += max(0, frame.number - self._number - 1)
        self._number = frame.number
        self.report.frames += 1

    def _finish(self, frame: Frame | None, verdict: Verdict, estimate: LaneEstimate) -> Step:
        steering_rad, throttle = self._limiter.steering_rad, self._limiter.throttle
        recorder = self._parts.recorder
        if frame is not None and recorder is not None:
            # Only commands that were sent are recorded: else somebody else drives.
            recorded = self._mode.record_commands
            commands = {"steering_rad": steering_rad} if recorded and self._mode.moves else {}
            commands |= {"throttle": throttle} if recorded and self._mode.armed else {}
            recorder.add(frame.image_bgr, frame.t_s, **commands)
        if frame is not None and verdict.steers:
            self._look_at_camera(frame)
        self.report.states[verdict.state] += 1
        number = -1 if frame is None else frame.number
        step = Step(number, verdict.state, verdict.reason, steering_rad, throttle, estimate.confidence)
        self._verdict, self._step = verdict, step
        self._log(verdict)
        if verdict.state is State.ENDED:
            self.report.ended, self.report.by_fault = verdict.reason, True
        if self._watch is not None:
            self._watch(step)
        if self._show is not None and frame is not None:
            self._show(frame, estimate, step)
        return step

    def _look_at_camera(self, frame: Frame) -> None:
        """Compare what a moving car sees with the calibration, after the command, which does not wait."""
        check = self._parts.camera_check
        if check is None or self._limiter.throttle <= self._speed.throttle_at_rest:
            return
        before = self._finding.concern
        self._finding = check.look(
            frame.image_bgr, frame.t_s, self._limiter.steering_rad if self._mode.drives else math.nan
        )
        if self._finding.concern > before:
            log.warning("camera: %s", self._finding.text)

    def _log(self, verdict: Verdict) -> None:
        """Log each change once; reasons that differ only in their digits are the same."""
        now = (verdict.state, "".join(c for c in verdict.reason if not c.isdigit()))
        if now == self._logged:
            return
        self._logged = now
        standing = verdict.state in (State.STOPPED, State.ENDED) or verdict.reason
        log.log(
            logging.WARNING if standing and verdict.state is not State.COUNTDOWN else logging.INFO,
            "%s%s", verdict.state, f": {verdict.reason}" if verdict.reason else "",
        )  # fmt: skip

    def _over(self, max_frames: int | None) -> bool:
        if self._asked:
            self.report.ended = self._asked
        elif max_frames is not None and self.report.frames >= max_frames:
            self.report.ended = f"{counted(max_frames, 'frame')}, as asked"
        return bool(self.report.ended)

    def _close(self) -> Exception | None:
        """Close camera and recording; returns what failed."""
        failure = None
        recorder = self._parts.recorder
        for close in (self._parts.source.close, *(() if recorder is None else (recorder.close,))):
            try:
                close()
            except Exception as error:
                failure = failure or error
        if recorder is not None:
            self.report.recorded = recorder.recorded
            self.report.recording = recorder.path if recorder.recorded else None
            self.report.unrecorded = recorder.dropped
        return failure


@contextmanager
def ending_signals(stop: Callable[[str], None]) -> Iterator[None]:
    """Call ``stop`` with the signal's name instead of dying; a second Ctrl-C raises KeyboardInterrupt.

    Other signals may come twice, from whoever ends a service, and nobody has lost patience.

    An ignored hang-up, as under ``nohup``, stays ignored. Does nothing outside the main thread, where Python
    allows no handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = False

    def handle(number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        if not asked:
            asked = True
            stop(signal.Signals(number).name)
        elif number == signal.SIGINT:
            raise KeyboardInterrupt

    wanted = [n for n in ENDING if n != signal.SIGHUP or signal.getsignal(n) != signal.SIG_IGN]
    before: dict[signal.Signals, Any] = {number: signal.signal(number, handle) for number in wanted}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _settled_memory() -> Iterator[None]:
    """Exclude existing objects from garbage collection, whose runs would be pauses."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


class LatencyHistogram:
    """Counts durations in bins of 0.05 ms; its memory does not grow with the drive."""

    def __init__(self) -> None:
        """Start empty."""
        self._counts: Int[np.ndarray, "bins"] = np.zeros(_BINS, np.int64)
        self.longest_ms = 0.0

    def add(self, duration_s: float) -> None:
        """Count one duration; all above half a second share the last bin."""
        duration_ms = max(0.0, 1e3 * duration_s)
        self._counts[min(int(duration_ms / _BIN_MS), _BINS - 1)] += 1
        self.longest_ms = max(self.longest_ms, duration_ms)

    def __len__(self) -> int:
        return int(self._counts.sum())

    def above(self, duration_s: float) -> int:
        """Return how many durations were longer, to within one bin."""
        return int(self._counts[math.ceil(1e3 * duration_s / _BIN_MS) :].sum())

    def percentile_ms(self, percent: float) -> float:
        """Return the upper edge of the bin with this percentile, [ms]; NaN when nothing was counted."""
        total = len(self)
        if total == 0:
            return float("nan")
        rank = max(1, int(np.ceil(0.01 * percent * total)))
        at = int(np.searchsorted(np.cumsum(self._counts), rank))
        return min((at + 1) * _BIN_MS, self.longest_ms)


@dataclass(frozen=True)
class Step:
    """One turn of the drive loop.

    Attributes:
        frame: Number of the frame; -1 when there was none.
        state: What the car may do.
        reason: Why it is slow or stopped; empty when it drives.
        steering_rad: Steering that was sent, positive left.
        throttle: Throttle that was sent; 0 is neutral.
        confidence: Of the estimate; NaN when there was none.
    """

    frame: int
    state: State
    reason: str
    steering_rad: float
    throttle: float
    confidence: float

    @property
    def text(self) -> str:
        """The turn in one line."""
        command = f"steering {np.rad2deg(self.steering_rad):+5.1f} deg, throttle {self.throttle:.2f}"
        seen = f", confidence {self.confidence:.2f}" if np.isfinite(self.confidence) else ""
        return f"{self.state}: {command}{seen}{f' ({self.reason})' if self.reason else ''}"


@dataclass
class DriveReport:
    """Figures of a drive.

    Attributes:
        frames: Frames that were processed.
        skipped: Frames of the source that were not read because the loop was late.
        latency: From the exposure of a frame to its command; from its arrival where that is not known.
        age_known: Whether the time of exposure was known of all frames.
        work: From having the frame to its command.
        states: Turns of the loop in each state.
        seconds: Time from the first turn to the last.
        ended: Why the drive ended.
        by_fault: Whether it ended because the car had to stop.
        recording: Folder of the recording; None if it holds no frame.
        recorded: Frames in the recording.
        unrecorded: Frames left out because the card was slow or the recording had stopped.
    """

    frames: int = 0
    skipped: int = 0
    latency: LatencyHistogram = field(default_factory=LatencyHistogram)
    age_known: bool = True
    work: LatencyHistogram = field(default_factory=LatencyHistogram)
    states: Counter[State] = field(default_factory=Counter)
    seconds: float = 0.0
    ended: str = ""
    by_fault: bool = False
    recording: Path | None = None
    recorded: int = 0
    unrecorded: int = 0

    @property
    def rate_hz(self) -> float:
        """Frames per second over the whole drive."""
        return self.frames / self.seconds if self.seconds > 0.0 else 0.0

    @property
    def text(self) -> str:
        """Rate and p99 of the work, for the live line."""
        return f"{self.rate_hz:5.1f}/s  p99 {self.work.percentile_ms(99.0):.1f} ms"

    def lines(self) -> list[str]:
        """Return the summary of the drive."""
        turns = max(1, self.states.total())
        shares = ", ".join(f"{state} {100.0 * n / turns:.0f} %" for state, n in self.states.most_common())
        lines = [
            f"{counted(self.frames, 'frame')} in {self.seconds:.1f} s ({self.rate_hz:.1f} per second), "
            f"{self.skipped} of the source not read",
        ]
        if len(self.work):
            lines.append(
                f"frame to command {self.work.percentile_ms(50.0):.2f} ms (median), "
                f"{self.work.percentile_ms(99.0):.2f} ms (p99); "
                f"{'exposure' if self.age_known else 'age unknown, arrival'} to command "
                f"{self.latency.percentile_ms(50.0):.1f} ms, {self.latency.percentile_ms(99.0):.1f} ms"
            )
        lines.append(f"states: {shares}")
        if self.recorded or self.unrecorded:
            lines.append(f"recorded {counted(self.recorded, 'frame')}, left out {self.unrecorded}")
        lines.append(f"ended: {self.ended}")
        return lines
