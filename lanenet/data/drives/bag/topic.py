"""A topic of a bag, and what reads its messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from lanenet.errors import counted
from lanenet.reading import MEBIBYTE

#: Of a storage file, [B]; chosen: an hour of raw images of a megapixel at 30 frames/s has 0.3 TB.
MAX_STORAGE = 2**41
#: Of a message, unpacked, [B]. Chosen: an image of 16 megapixels without loss has 48 MB.
MAX_MESSAGE = 48 * MEBIBYTE
#: Encodings of messages: that of ROS 2, and Foxglove's.
READABLE = ("cdr", "json")
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
