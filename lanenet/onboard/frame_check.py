"""Frames that must not be used: missing, late, from another clock, or of a camera that hangs."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import UInt8

from lanenet.onboard.devices import Frame
from lanenet.onboard.safety import SafetySettings

#: A frame time further ahead than this comes from another clock; chosen: more than rounding, less than two
#: frames.
_MAX_AHEAD_S = 0.05
#: Frames are compared in every 16th pixel first; of a 320 x 240 image these are 300 pixels with noise.
_SAMPLE = 16


class FrameCheck:
    """Finds frames that must not be used: missing, late, from another clock, or repeated."""

    def __init__(self, settings: SafetySettings) -> None:
        """Take the limits; no frame has been seen."""
        self._settings = settings
        self._before: UInt8[np.ndarray, "h w 3"] | None = None

    def fault_of(self, frame: Frame | None, now_s: float) -> str:
        """Return what is wrong with a frame; empty if nothing is."""
        if frame is None:
            return "no frame from the camera"
        before, self._before = self._before, frame.image_bgr
        age_s = now_s - frame.t_s
        if not math.isfinite(age_s) or age_s < -_MAX_AHEAD_S:
            return f"frame {frame.number} is timed {-age_s:.2f} s ahead of the clock"
        if age_s > self._settings.max_age_s:
            return f"frame {frame.number} is {1e3 * age_s:.0f} ms old"
        if (
            not self._settings.allow_repeated_frames
            and before is not None
            and same_image(before, frame.image_bgr)
        ):
            return f"frame {frame.number} repeats the one before: the camera hangs"
        return ""


def same_image(before: UInt8[np.ndarray, "h w 3"], now: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Tell whether two images are equal, pixel for pixel."""
    if before.shape != now.shape:
        return False
    # Sensor noise makes frames differ in a few pixels; only frames that may be equal are compared in full.
    if not np.array_equal(before[::_SAMPLE, ::_SAMPLE], now[::_SAMPLE, ::_SAMPLE]):
        return False
    return bool(np.array_equal(before, now))
