"""Figures of a drive: rate, latencies and states, in constant memory."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Int

from lanenet.onboard.safety import State

#: Fine beside a frame's work of a few milliseconds; the bins reach to 500 ms, five times the largest age.
_BIN_MS = 0.05
_BINS = 10_000


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
        latency: From the exposure of a frame to its command.
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
            f"{self.frames} frames in {self.seconds:.1f} s ({self.rate_hz:.1f} per second), "
            f"{self.skipped} of the source not read",
        ]
        if len(self.work):
            lines.append(
                f"frame to command {self.work.percentile_ms(50.0):.2f} ms (median), "
                f"{self.work.percentile_ms(99.0):.2f} ms (p99); exposure to command "
                f"{self.latency.percentile_ms(50.0):.1f} ms, {self.latency.percentile_ms(99.0):.1f} ms"
            )
        lines.append(f"states: {shares}")
        if self.recorded or self.unrecorded:
            lines.append(f"recorded {self.recorded} frames, left out {self.unrecorded}")
        lines.append(f"ended: {self.ended}")
        return lines
