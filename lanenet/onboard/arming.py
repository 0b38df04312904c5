"""What must be true before the motor of an armed car may turn, and the file by which it is held."""

from __future__ import annotations

import logging
import math
import stat
import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lanenet.data.drives.recorder import DriveRecorder
from lanenet.onboard.devices import Frame
from lanenet.perception.camera_check import GROSS_RAD, CameraCheck

log = logging.getLogger(__name__)

#: Frames in a row that have to be as they should. Chosen: a third of a second of a common camera.
_FRAMES = 10
#: A camera that is silent for longer is no slow one. Chosen: three frames of 10 a second.
_PAUSE_S = 0.3
#: A car that may not start says why after this time, and when that changes, at most this often.
_PATIENCE_S = 3.0


@dataclass(frozen=True)
class ArmCheck:
    """One line of what is checked before the countdown.

    Attributes:
        name: What was checked.
        passed: Whether it is as it should be; the car starts only when all are.
        text: What was found.
    """

    name: str
    passed: bool
    text: str

    def __str__(self) -> str:
        """Return the line."""
        return f"{'pass' if self.passed else 'FAIL'}  {self.name}: {self.text}"


class HoldFile:
    """A dead man's switch: the car drives only while a file exists, and is touched often enough if asked."""

    def __init__(
        self, path: Path, fresh_s: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Take the file, which need not exist yet.

        Args:
            path: On a local disk, since it is looked for with every frame.
            fresh_s: It must be touched at least this often; None if it only has to exist.
            clock: Time, [s]; the file's own time only has to change.
        """
        self.path, self._fresh_s, self._clock = path, fresh_s, clock
        self._touched_ns, self._touched_s = -1, -math.inf

    @property
    def fault(self) -> str:
        """Why the car is not held; empty if it is."""
        try:
            found = self.path.stat()
        except OSError:
            self._touched_ns = -1
            return f"{self.path} is not there"
        if not stat.S_ISREG(found.st_mode):
            # A folder or a device is always there, and a folder's time changes with what is in it.
            return f"{self.path} is not a plain file"
        touched_ns = found.st_mtime_ns
        now_s = self._clock()
        if touched_ns != self._touched_ns:
            # A file that was there before the drive may have been forgotten.
            first = self._touched_ns == -1 and self._fresh_s is not None
            self._touched_ns, self._touched_s = touched_ns, -math.inf if first else now_s
        if self._fresh_s is not None and now_s - self._touched_s > self._fresh_s:
            return f"{self.path} was not touched for {self._fresh_s:g} s"
        return ""


class ArmGate:
    """Keeps an armed car in neutral until every check has passed once; then the countdown begins."""

    def __init__(
        self,
        fits: ArmCheck,
        least_confidence: float,
        recorder: DriveRecorder | None = None,
        camera_check: CameraCheck | None = None,
        hold: HoldFile | None = None,
    ) -> None:
        """Take what is known before the first frame.

        Args:
            fits: Whether camera and model fit each other.
            least_confidence: Of the lane.
            recorder: Of the drive; None if recording was declined.
            camera_check: Compares each view with the calibration; None for no comparison.
            hold: The operator's file; None without one.
        """
        self.checks: list[ArmCheck] = [fits]
        self._fits, self._least, self._hold = fits, least_confidence, hold
        self._recorder, self._camera_check = recorder, camera_check
        self._passed = False
        self._frames = 0
        self._views_rad: deque[float] = deque(maxlen=_FRAMES)
        self._frame_s, self._fault = -math.inf, "not armed: frames: none yet"
        # Since when nothing was said, and what was said then.
        self._since_s, self._said = math.nan, ""

    def fault_of(self, frame: Frame | None, frame_fault: str, confidence: float, now_s: float) -> str:
        """Return why the car may not start yet; empty once it may, for the whole drive.

        To be called only after the actuator has taken neutral, which every turn before this one sent.

        Args:
            frame: The frame of this turn.
            frame_fault: What is wrong with it; empty if nothing is.
            confidence: Of the lane in it.
            now_s: Time.
        """
        if self._passed:
            return ""
        if frame is None and now_s - self._frame_s < _PAUSE_S:
            # A slow camera: not every turn has a frame.
            return self._fault
        self._frames = 0 if frame is None or frame_fault else self._frames + 1
        if frame is not None and not frame_fault:
            self._frame_s = now_s
            if self._camera_check is not None:
                self._views_rad.append(self._camera_check.view(frame.image_bgr)[0])
        self.checks = self._look(frame_fault, confidence)
        failed = [check for check in self.checks if not check.passed]
        self._passed = not failed
        self._since_s = now_s if math.isnan(self._since_s) else self._since_s
        names = ", ".join(check.name for check in failed)
        if self._passed or (now_s - self._since_s >= _PATIENCE_S and names != self._said):
            self._since_s, self._said = now_s, names
            for check in self.checks:
                log.log(logging.INFO if check.passed else logging.WARNING, "arm: %s", check)
        self._fault = f"not armed: {failed[0].name}: {failed[0].text}" if failed else ""
        return self._fault

    def _look(self, frame_fault: str, confidence: float) -> list[ArmCheck]:
        enough = self._frames >= _FRAMES
        counted = f"{min(self._frames, _FRAMES)} of {_FRAMES} frames in a row"
        checks = [
            self._fits,
            ArmCheck("frames", enough, f"{counted}{f': {frame_fault}' if frame_fault else ''}"),
            ArmCheck("actuator", enough, "answers, in neutral" if enough else "waits for the frames"),
            self._lane(confidence),
            self._recording(),
            self._calibration(),
        ]
        if self._hold is not None:
            fault = self._hold.fault
            checks.append(ArmCheck("hold", not fault, fault or f"{self._hold.path} is held"))
        return checks

    def _lane(self, confidence: float) -> ArmCheck:
        if math.isnan(confidence):
            return ArmCheck("lane", False, "no frame was looked at")
        return ArmCheck(
            "lane", confidence >= self._least, f"confidence {confidence:.2f}, least {self._least:g}"
        )

    def _recording(self) -> ArmCheck:
        if self._recorder is None:
            return ArmCheck("recording", True, "declined: the car's file has no section 'recording'")
        if problem := self._recorder.problem:
            return ArmCheck("recording", False, problem)
        if not self._recorder.recorded:
            # A card that is slow, or hangs, has reported nothing.
            return ArmCheck("recording", False, f"no frame is in {self._recorder.path} yet")
        return ArmCheck("recording", True, f"to {self._recorder.path}")

    def _calibration(self) -> ArmCheck:
        if self._camera_check is None:
            return ArmCheck("calibration", True, "not compared: switched off, or no camera file")
        known = [view_rad for view_rad in self._views_rad if math.isfinite(view_rad)]
        if not known:
            return ArmCheck("calibration", True, "not compared: no lines on both sides")
        off_rad = abs(statistics.median(known))
        text = f"the lines show a pitch {math.degrees(off_rad):.1f} degrees off"
        return ArmCheck("calibration", off_rad < GROSS_RAD, text)
