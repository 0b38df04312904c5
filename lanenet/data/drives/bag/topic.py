"""A topic of a bag, and what reads its messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from lanenet.data.drives.recording import goes_back_often, without_jumps
from lanenet.errors import counted
from lanenet.reading import MEBIBYTE

#: Of a storage file, [B]; chosen: an hour of raw images of a megapixel at 30 frames/s has 0.3 TB.
MAX_STORAGE = 2**41
#: Of a message, unpacked, [B]. Chosen: an image of 16 megapixels without loss has 48 MB.
MAX_MESSAGE = 48 * MEBIBYTE
#: Encodings of messages: that of ROS 2, and Foxglove's.
READABLE = ("cdr", "json")
#: Typical steps that a message of a topic may be behind the one that was written before it. Chosen: threads
#: swap neighbours.
OUT_OF_ORDER = 2.0
#: Yields time of recording, [ns], and bytes of a topic's messages, in order, those from a time on.
Messages = Callable[[str, int | None], Iterator[tuple[int, bytes]]]


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: Such as ``/camera/image_raw``.
        type: Such as ``sensor_msgs/msg/Image``.
        count: Messages, according to the bag's index.
        encoding: Of its messages; those in :data:`READABLE` can be read.
    """

    name: str
    type: str
    count: int
    encoding: str

    def __str__(self) -> str:
        encoding = "" if self.encoding in READABLE else f" in {self.encoding}"
        return f"{self.name} ({self.type}{encoding}, {counted(self.count, 'message')})"


def times_going_on(
    path: Path, times_ns: Int[np.ndarray, "n"], problems: list[str]
) -> Int[np.ndarray, "n"] | None:
    """Mend the times of a topic's messages, [ns], as they were written, if the clock was set back.

    None if it was not: messages that are a little out of order belong where their times are, and so do all
    where that happens often.
    """
    steps = np.diff(times_ns)
    if not (steps < 0).any() or -steps.min() <= OUT_OF_ORDER * np.median(np.abs(steps)):
        return None
    numbers, t_s = np.arange(len(times_ns)), (times_ns - times_ns[0]) * 1e-9
    if goes_back_often(numbers, t_s):
        return None
    t_s, found = without_jumps(path, numbers, t_s)
    problems += found
    return times_ns[0] + np.round(t_s * 1e9).astype(np.int64)
