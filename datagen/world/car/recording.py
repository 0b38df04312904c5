"""What people record of a drive: Donkeycar writes frames only while the throttle is pressed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from jaxtyping import Bool

Gaps = Literal["none", "pulses", "pauses"]
Levels = Literal["all", "bang"]

# Of twelve public tubs, seven have gaps. In the worst of them, half of the steps between neighbouring rows
# leave out 3 to 5 frames, one in ten 6 to 10, one in forty 11 to 40; runs have a median of 2 to 10 frames.
#: Median and spread (log-normal), shortest and longest run of frames.
_RUNS = {"pulses": (7.0, 0.6, 3, 25), "pauses": (90.0, 0.7, 30, 400)}
#: Shortest and longest gaps, and how often: pulses and pauses.
_GAPS = {
    "pulses": (((3, 5), 0.75), ((6, 10), 0.17), ((11, 40), 0.08)),
    "pauses": (((3, 5), 0.4), ((6, 10), 0.3), ((11, 40), 0.3)),
}
#: With pauses, the car is put elsewhere twice a drive: a gap of so many frames, in shares of the drive.
_ELSEWHERE = (1.0 / 3.0, 2.0 / 3.0)
_ELSEWHERE_GAP = (0.06, 0.12)


def recorded_frames(gaps: Gaps, frames: int, rng: np.random.Generator) -> Bool[np.ndarray, "n"]:
    """Draw which frames of a drive are recorded.

    Args:
        gaps: ``pulses`` of the throttle, a few frames each, or longer runs between ``pauses``.
        frames: Of the drive.
        rng: Source of randomness.
    """
    kept = np.zeros(frames, dtype=bool)
    for first, last in _runs(gaps, frames, rng):
        kept[first:last] = True
    return kept


def _runs(gaps: Gaps, frames: int, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """First frame of each run, and the one after its last."""
    if gaps == "none":
        yield 0, frames
        return
    median, spread, shortest, longest = _RUNS[gaps]
    spans, shares = [span for span, _ in _GAPS[gaps]], [share for _, share in _GAPS[gaps]]
    elsewhere = [share * frames for share in _ELSEWHERE] if gaps == "pauses" else []
    at = 0
    while at < frames:
        run = int(np.clip(rng.lognormal(np.log(median), spread), shortest, longest))
        yield at, min(at + run, frames)
        low, high = spans[int(rng.choice(len(spans), p=shares))]
        gap = int(rng.integers(low, high + 1))
        if any(at < place <= at + run + gap for place in elsewhere):
            gap = int(frames * rng.uniform(*_ELSEWHERE_GAP))
        at += run + gap


class BangBang:
    """Turns angles into those of a keyboard, -1, 0 or 1, so that their running sum stays."""

    def __init__(self) -> None:
        """Start with a sum of 0."""
        self._wanted = self._given = 0.0

    def angle(self, angle: float) -> float:
        """Return the recorded angle for that of the next frame."""
        self._wanted += angle
        level = float(np.clip(np.rint(self._wanted - self._given), -1.0, 1.0))
        self._given += level
        return level
