"""Which lane the car is in, told by what the two lines of its lane look like."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from lanenet.perception.rolling_median import RollingMedian

#: Side of the road on which cars drive; None where nobody said.
Keep = Literal["right", "left"]

#: Frames whose looks are remembered, and how many make a line known. Chosen: 5 s and half a second at 20
#: frames/s.
_LENGTH, _ENOUGH = 100, 10
#: By how much more one line is yellow, or has gaps, than the other, where that is plain: on seventy simulated
#: drives yellow lines had a mean of 0.4 to 1 and most white ones one within 0.2, dashes 0.1 to 0.3 and most
#: solid lines 0 to 0.1; on `donkey_circuit` yellow dashes have 0.33 and 0.07, the white line 0.04 and 0.02.
_YELLOWER, _MORE_GAPS = 0.4, 0.15
#: Log odds that a plain frame adds, and what a frame keeps of the sum: in the end 6, 400 to 1. Chosen:
#: neighbouring frames show the same metre of road, so that each says little, and a second says enough.
_PLAIN, _KEPT = 0.3, 0.95


def _last() -> RollingMedian:
    return RollingMedian(_LENGTH)


@dataclass
class _Line:
    """What the last frames show of one line."""

    yellow: RollingMedian = field(default_factory=_last)
    gaps: deque[float] = field(default_factory=lambda: deque(maxlen=_LENGTH))

    @property
    def known(self) -> bool:
        """Enough frames showed it."""
        return len(self.gaps) >= _ENOUGH


class LineLooks:
    """What the lane's two lines look like, remembered from frame to frame, and which lane that makes it.

    Where cars keep right, the line between the lanes is to the left of the own lane: it is the yellower one,
    or the one with more gaps. A lane between two lines of one kind tells nothing.

    Attributes:
        keep: The side on which cars drive.
    """

    def __init__(self, keep: Keep | None = None) -> None:
        self.keep = keep
        self._lines = [_Line(), _Line()]
        self._log_odds = 0.0

    @property
    def own_lane(self) -> float:
        """Probability that the lane is the one to drive in; NaN without a side on which cars drive."""
        return math.nan if self.keep is None else 1.0 / (1.0 + math.exp(-self._log_odds))

    def remember(self, side: int, look: Sequence[float]) -> None:
        """Add what a frame shows of a line.

        Args:
            side: 0 for the left line, 1 for the right one.
            look: See :class:`lanenet.perception.network.refinement.RefinedLines`.
        """
        line, (yellow, _, gaps) = self._lines[side], look
        line.yellow.append(yellow)
        line.gaps.append(gaps)

    def judge(self) -> None:
        """Weigh what both lines look like, once per frame."""
        left, right = self._lines
        self._log_odds *= _KEPT
        if self.keep is None or not left.known or not right.known:
            return
        like_own = self._between_lanes(left, right)
        sign = 1.0 if self.keep == "right" else -1.0
        self._log_odds += sign * _PLAIN * max(-1.0, min(1.0, like_own))

    @staticmethod
    def _between_lanes(line: _Line, other: _Line) -> float:
        """By how much a line is yellower than the other one and has more gaps; 1 where that is plain."""
        gaps = statistics.fmean(line.gaps) - statistics.fmean(other.gaps)
        return (line.yellow.median - other.yellow.median) / _YELLOWER + gaps / _MORE_GAPS

    def cross(self, side: int) -> None:
        """Go to the lane beyond the left line, 0, or the right one, 1: it is now on the other side."""
        self._lines[1 - side] = self._lines[side]
        self._lines[side] = _Line()
        self._log_odds = -self._log_odds

    def reset(self) -> None:
        """Forget all frames."""
        self._lines, self._log_odds = [_Line(), _Line()], 0.0
