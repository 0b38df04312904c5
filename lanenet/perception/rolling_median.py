"""Median of the last values, for loops that ask for it every frame."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque


class RollingMedian:
    """The last values in their order and by size, so that none of them is sorted again for a median."""

    def __init__(self, length: int) -> None:
        """Start without a value.

        Args:
            length: How many values are kept.
        """
        self._values: deque[float] = deque(maxlen=length)
        self._by_size: list[float] = []

    def __len__(self) -> int:
        return len(self._values)

    def append(self, value: float) -> None:
        """Add a value, which is not NaN; the oldest one is dropped where there are too many."""
        if len(self._values) == self._values.maxlen:
            del self._by_size[bisect_left(self._by_size, self._values[0])]
        self._values.append(value)
        insort(self._by_size, value)

    def clear(self) -> None:
        """Drop all values."""
        self._values.clear()
        self._by_size.clear()

    @property
    def median(self) -> float:
        """The middle value, or the mean of the two in the middle, as ``statistics.median``.

        Raises:
            IndexError: If there is no value.
        """
        middle = len(self._by_size) // 2
        if len(self._by_size) % 2:
            return self._by_size[middle]
        return (self._by_size[middle - 1] + self._by_size[middle]) / 2
