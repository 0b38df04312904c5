"""A recorded drive in place of a camera: a tub, a drive folder or a video."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from lanenet.config import Settings
from lanenet.data.drives import Drive, open_drive
from lanenet.errors import DriveFormatError, HardwareError
from lanenet.onboard.devices import Frame, SourceEnded

#: Of a drive with a single frame: Donkeycar's 20 frames/s.
_DEFAULT_STEP_S = 0.05
_log = logging.getLogger(__name__)


class ReplaySettings(Settings):
    """Settings of a replayed drive.

    Attributes:
        kind: Chooses this source.
        path: A drive folder, a Donkeycar tub or a video.
        pace: ``real`` gives each frame at its time and drops those that the reader is too slow for, like a
            camera; ``fast`` gives every frame as soon as it is requested.
        rate_hz: Frames per second in place of the recorded times.
        loop: Start again at the end.
        may_drive: Let an armed car with a motor follow the recording, blind: for a car on a stand.
    """

    kind: Literal["replay"] = "replay"
    path: Path
    pace: Literal["real", "fast"] = "real"
    rate_hz: float | None = Field(default=None, gt=0.0, le=1000.0)
    loop: bool = False
    may_drive: bool = False

    def make_source(self) -> ReplaySource:
        """Build the source; the drive is not read before ``open``."""
        return ReplaySource(self)


class ReplaySource:
    """Frames of a drive, one after the other; a ``FrameSource``.

    An unreadable frame is left out, with a line in the log. ``t_s`` is the time at which a frame was due, or
    was requested with the pace ``fast``.
    """

    def __init__(self, settings: ReplaySettings) -> None:
        self._settings = settings
        self._drive: Drive | None = None
        self._due_s: Float[np.ndarray, "n"] = np.zeros(0)
        self._lap_s = 0.0
        self._start_s = 0.0
        #: Number of the next frame, counted through all repetitions.
        self._next = 0
        self._unreadable = 0

    def open(self) -> None:
        """Open the drive; its time starts now.

        Raises:
            HardwareError: If there is no drive that can be read.
        """
        try:
            self._drive = open_drive(self._settings.path)
        except DriveFormatError as error:
            raise HardwareError(f"replay: {error}") from None
        self._due_s, self._lap_s = _schedule(self._drive, self._settings.rate_hz)
        self._start_s = time.monotonic()
        self._next = self._unreadable = 0

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame when it is due; see ``FrameSource``.

        Raises:
            SourceEnded: If all frames were shown.
            HardwareError: If it is not open, or no frame can be read.
        """
        drive = self._drive
        if drive is None:
            raise HardwareError(f"{self._settings.path}: not open")
        end_s = time.monotonic() + timeout_s
        while True:
            if self._settings.pace == "real":
                self._skip_late(time.monotonic())
            lap, row = divmod(self._next, len(drive))
            if lap and not self._settings.loop:
                raise SourceEnded(f"{self._settings.path}: all {len(drive)} frames were shown")
            now_s = time.monotonic()
            due_s = now_s
            if self._settings.pace == "real":
                due_s = self._start_s + lap * self._lap_s + float(self._due_s[row])
                if due_s > end_s:
                    time.sleep(max(0.0, end_s - now_s))
                    return None
                time.sleep(max(0.0, due_s - now_s))
            number = self._next
            self._next += 1
            try:
                return Frame(drive.image(row), due_s, number, lap=lap)
            except DriveFormatError as error:
                self._note(error, len(drive))

    def close(self) -> None:
        """Release the drive."""
        self._drive = None

    def _skip_late(self, now_s: float) -> None:
        """Skip to the newest frame that is due."""
        lap, in_lap_s = divmod(now_s - self._start_s, self._lap_s)
        n = len(self._due_s)
        newest = int(lap) * n + int(np.searchsorted(self._due_s, in_lap_s, side="right")) - 1
        # Without a loop even a late reader gets the last frame.
        self._next = max(self._next, newest if self._settings.loop else min(newest, n - 1))

    def _note(self, error: DriveFormatError, n_frames: int) -> None:
        self._unreadable += 1
        _log.warning("replay: %s", error)
        if self._unreadable >= n_frames:
            raise HardwareError(f"replay: none of the frames can be read ({error})")


def _schedule(drive: Drive, rate_hz: float | None) -> tuple[Float[np.ndarray, "n"], float]:
    """Return the time of each frame after the start, [s], and the duration of one repetition, [s].

    Breaks in the recording are cut out.
    """
    n = len(drive)
    if rate_hz is not None:
        return np.arange(n) / rate_hz, n / rate_hz
    steps = np.diff(drive.t_s)
    median_s = float(np.median(steps)) if steps.size else _DEFAULT_STEP_S
    steps = np.where(drive.breaks[1:], median_s, steps)
    due_s = np.concatenate([[0.0], np.cumsum(steps)])
    return due_s, float(due_s[-1]) + median_s
