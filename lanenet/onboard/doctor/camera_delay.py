"""Delay of a camera, measured by a person who covers and uncovers its lens."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from lanenet.errors import HardwareError
from lanenet.onboard.devices import FrameSource

#: Times that the lens is covered or uncovered; of eight, one that went wrong does not move the median.
PRESSES = 8
#: Pause after a press, [s]; within the first part of it the image has to change.
_PAUSE_S, _LATEST_S = 6.0, 5.5
#: Longest wait for a frame, after which the thread looks whether it is done.
_READ_S = 0.1
#: A hand may be faster than the other one's key, [s].
_EARLIEST_S = -0.5
#: Frames whose mean brightness is compared before and after a change, and its least height, [gray levels].
#: Chosen: more than a lamp flickers, less than a hand darkens a lit room.
_SIDE, _LEAST_STEP = 3, 15.0
#: Fewer changes than this say nothing about how much they scatter.
_LEAST_CHANGES = 4


@dataclass(frozen=True)
class CameraDelay:
    """Delay of a camera, from the light to the arrival of a frame.

    Attributes:
        delay_s: Median time from a press of the key to the change in the images.
        sd_s: Standard deviation of one press, from the median absolute deviation: of hands and frames.
        changes: Presses after which a change was found.
        claimed_s: Median of what the frames' own times say; NaN if their age is unknown.
    """

    delay_s: float
    sd_s: float
    changes: int
    claimed_s: float = math.nan

    @property
    def lines(self) -> list[str]:
        """The result, a sentence each."""
        # The median of normal values scatters 1.2533 times as much as their mean.
        interval_s = 1.96 * 1.2533 * self.sd_s / math.sqrt(self.changes)
        claim = (
            "is unknown" if math.isnan(self.claimed_s) else f"by their own times is {self.claimed_s:.2f} s"
        )
        return [
            f"delay: {self.delay_s:.2f} s from the light to here, +- {interval_s:.2f} s (95 %; "
            f"{self.changes} changes of {PRESSES}, one scatters by {self.sd_s:.2f} s); the age of the frames "
            f"{claim}",
            "the error that your hands make every time is not in the interval",
            f"where the two differ by more, write into the car's file: source: {{delay_s: "
            f"{max(0.0, self.delay_s):.2f}}}",
        ]


def delay_of(
    presses_s: Sequence[float],
    darkens: Sequence[bool],
    times_s: Float[np.ndarray, "n"],
    brightness: Float[np.ndarray, "n"],
) -> CameraDelay:
    """Return the delay between presses of a key and the changes of brightness after them.

    A change is the steepest rise or fall within 0.5 s before and 5.5 s after its press: what an automatic
    exposure does afterwards is slower. Its time is the middle between the frames before and after it.

    Args:
        presses_s: When a person covered or uncovered the lens and pressed the key.
        darkens: Whether it was covered.
        times_s: When the frames arrived, ascending.
        brightness: Their mean gray level, 0 to 255.

    Raises:
        HardwareError: If too few changes are found.
    """
    steps = np.full(len(times_s), np.nan)
    for k in range(_SIDE, len(times_s) - _SIDE + 1):
        steps[k] = brightness[k : k + _SIDE].mean() - brightness[k - _SIDE : k].mean()
    delays_s = []
    for press_s, dark in zip(presses_s, darkens, strict=True):
        after_s = times_s - press_s
        near: Bool[np.ndarray, "n"] = (after_s >= _EARLIEST_S) & (after_s <= _LATEST_S) & np.isfinite(steps)
        heights = np.where(near, -steps if dark else steps, -np.inf)
        at = int(np.argmax(heights)) if heights.size else 0
        if heights.size and heights[at] >= _LEAST_STEP:
            delays_s.append(0.5 * (after_s[at - 1] + after_s[at]))
    if len(delays_s) < _LEAST_CHANGES:
        raise HardwareError(
            f"the image became darker or brighter after {len(delays_s)} of {len(presses_s)} presses, "
            f"expected {_LEAST_CHANGES} at least: cover the whole lens, in a lit room"
        )
    median_s = float(np.median(delays_s))
    sd_s = 1.4826 * float(np.median(np.abs(np.array(delays_s) - median_s)))
    return CameraDelay(median_s, sd_s, len(delays_s))


def measure_delay(source: FrameSource, ask: Callable[[str], object]) -> CameraDelay:
    """Let a person cover and uncover the lens, and return the delay of the camera.

    Args:
        source: Not open yet; it is closed again.
        ask: Shows a line, and returns when the person has pressed Enter.

    Raises:
        LanenetError: If the camera fails, or too few changes are found.
    """
    seen: list[tuple[float, float, float]] = []
    failures: list[Exception] = []
    done = threading.Event()

    def watch() -> None:
        try:
            while not done.is_set():
                frame = source.read(_READ_S)
                if frame is not None:
                    now_s = time.monotonic()
                    claimed_s = now_s - frame.t_s if frame.age_known else math.nan
                    seen.append((now_s, float(frame.image_bgr.mean()), claimed_s))
        except Exception as error:
            failures.append(error)

    source.open()
    thread = threading.Thread(target=watch, name="camera delay", daemon=True)
    thread.start()
    presses_s: list[float] = []
    try:
        for k in range(PRESSES):
            hand = "uncover" if k % 2 else "cover"
            ask(f"{k + 1} of {PRESSES}: {hand} the lens, and press Enter in the same moment")
            presses_s.append(time.monotonic())
            done.wait(_PAUSE_S)
    finally:
        done.set()
        thread.join()
        source.close()
    if failures:
        raise failures[0]
    times_s, brightness, claimed_s = np.array(seen, float).reshape(-1, 3).T
    delay = delay_of(presses_s, [k % 2 == 0 for k in range(PRESSES)], times_s, brightness)
    return replace(delay, claimed_s=float(np.median(claimed_s)))
