"""MCAP files: their topics, and their messages in the order of time, with a bound on what is unpacked.

The records are parsed by the library ``mcap``, the chunks are unpacked and walked through here: the library
unpacks whatever a chunk claims, keeps every chunk that overlaps another in time, and makes an object of every
message of every topic. Source: MCAP specification, version 0.
"""

from __future__ import annotations

import heapq
import io
import os
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Int

from lanenet.data.drives.bag.topic import MAX_MESSAGE, MAX_STORAGE, Messages, Topic, times_going_on
from lanenet.data.files import require
from lanenet.errors import DriveFormatError
from lanenet.reading import MEBIBYTE, open_regular

_SIGN = b"\x89MCAP0\r\n"
#: Of a chunk, unpacked: writers begin a new one after a megabyte, or after one message that is larger.
_MAX_CHUNK = MAX_MESSAGE
#: Of zstd; the most that its command unpacks without being asked, 128 MB.
_MAX_WINDOW = 2**27
#: Of all chunks: so much, and so many times the file's size. Chosen: images of a simulator, without loss and
#: of flat colours, unpack to 100 times their size; a gigabyte takes a second.
_MAX_UNPACKED, _MAX_RATIO = 1024 * MEBIBYTE, 200
#: Messages that wait, since a later chunk may hold earlier ones. Chosen: writers' chunks overlap by a few.
_MAX_WAITING = 96 * MEBIBYTE
#: A message takes at least so many bytes of the file. Chosen: its entry in the index of its chunk has 16, and
#: recorders that leave that out pack the stamps of a steady message to three.
_LEAST_PACKED = 2
#: Messages that any file may hold.
_ANY_MESSAGES = 100_000
_TOO_MANY = "has more messages than its size or its index can hold"
#: Opcode of the index of a channel's messages in a chunk, and what stands before its times and places, [B].
_INDEX, _INDEX_HEAD = 7, 6
#: Opcode of a message; opcode and length of a record; channel, sequence, log and publish time of a message.
_MESSAGE, _RECORD, _HEAD = 5, struct.Struct("<BQ"), struct.Struct("<HIQQ")


class _BoundedReads:
    """A file of which never more than its size is asked: Python allocates what a damaged length says."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self._size = size
        self.seek, self.tell = stream.seek, stream.tell

    def read(self, length: int = -1) -> bytes:
        """Read up to a number of bytes, or all."""
        return self._stream.read(min(length, self._size))


def open_mcap(path: Path, stack: ExitStack, problems: list[str]) -> tuple[list[Topic], Messages]:
    """Open an MCAP file; returns its topics, and what reads their messages and adds to the problems.

    Raises:
        DriveFormatError: If it is no MCAP file, has no index, or stands for more than it may.
        MissingExtraError: If mcap is not installed.
    """
    # Not by rosbags: it refuses files without ROS's profile, as Foxglove and others write them.
    library = require("mcap.reader", "bags")
    stream = stack.enter_context(open_regular(path, DriveFormatError, MAX_STORAGE))
    start = stream.read(len(_SIGN))
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - len(_SIGN)))
    whole = stream.read() == _SIGN
    stream.seek(0)
    if start != _SIGN:
        raise DriveFormatError(f"{path}: not an MCAP file (it begins with {start!r})")
    bounded = _BoundedReads(stream, size)
    # No record is longer than the file, whatever its length says.
    summary = library.SeekingReader(bounded, record_size_limit=size).get_summary() if whole else None
    if summary is None or summary.statistics is None:
        raise DriveFormatError(
            f"{path}: has no index at its end (was the recording cut off?); mend it with Foxglove's tool: "
            "mcap recover"
        )
    counts = summary.statistics.channel_message_counts
    topics = [
        Topic(
            channel.topic,
            schema.name if (schema := summary.schemas.get(channel.schema_id)) is not None else "no schema",
            counts.get(channel.id, 0),
            channel.message_encoding,
        )
        for channel in summary.channels.values()
    ]
    return topics, _McapMessages(path, bounded, size, summary, problems)


@dataclass(frozen=True)
class _McapMessages:
    path: Path
    stream: Any
    size: int
    summary: Any
    problems: list[str]
    #: Of topics that were read: messages of each chunk, and their times as written; None: in order of time.
    known: dict[str, tuple[list[tuple[Any, int]], Int[np.ndarray, "n"]] | None] = field(default_factory=dict)

    @property
    def _most(self) -> int:
        """What the chunks may unpack to together, [B]."""
        return _MAX_UNPACKED + _MAX_RATIO * self.size

    @property
    def _most_messages(self) -> int:
        return _ANY_MESSAGES + self.size // _LEAST_PACKED

    def __call__(self, topic: str, from_ns: int | None) -> Iterator[tuple[int, bytes]]:
        """Yield time of recording, [ns], and bytes of a topic's messages, in the order of time.

        If the clock was set back, in the order in which they were written, with times that go on.
        """
        channels = {channel.id for channel in self.summary.channels.values() if channel.topic == topic}
        since = 0 if from_ns is None else from_ns
        if topic not in self.known:
            self.known[topic] = self._set_back(channels)
        if (written := self.known[topic]) is not None:
            yield from self._as_written(*written, channels, since)
            return
        left = self._most_messages
        waiting: list[tuple[int, int, bytes]] = []
        held = order = 0
        for first_ns, records in self._chunks(channels, since):
            while waiting and waiting[0][0] < first_ns:
                t_ns, _, data = heapq.heappop(waiting)
                held -= len(data)
                yield t_ns, data
            for number, t_ns, content in _messages_in(records):
                left -= 1
                if left < 0:
                    self._refuse(_TOO_MANY)
                if number in channels and t_ns >= since:
                    heapq.heappush(waiting, (t_ns, order, bytes(content)))
                    order, held = order + 1, held + len(content)
                if held > _MAX_WAITING:
                    self._refuse("its chunks are not in the order of time; sort it: mcap sort")
        while waiting:
            t_ns, _, data = heapq.heappop(waiting)
            yield t_ns, data

    def _set_back(self, channels: set[int]) -> tuple[list[tuple[Any, int]], Int[np.ndarray, "n"]] | None:
        """Return how many of the messages each chunk has, and their times, if the clock was set back.

        The indexes of the chunks say so, which recorders may leave out.
        """
        chunks: list[tuple[Any, int]] = []
        times_ns, left = [np.zeros(0, np.int64)], self._most_messages
        for chunk in sorted(self.summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
            places = [np.zeros((0, 2), np.int64)]
            for channel in channels.intersection(chunk.message_index_offsets):
                self.stream.seek(chunk.message_index_offsets[channel])
                head = self.stream.read(_RECORD.size + _INDEX_HEAD).ljust(_RECORD.size + _INDEX_HEAD, b"\0")
                opcode, length = _RECORD.unpack_from(head)
                count, rest = divmod(length - _INDEX_HEAD, 16)
                # Damaged: the messages themselves may be whole.
                if opcode != _INDEX or rest or not 0 <= count <= left:
                    return None
                data = self.stream.read(16 * count)
                if len(data) < 16 * count:
                    return None
                places.append(np.frombuffer(data, "<i8").reshape(-1, 2))
                left -= count
            found = np.concatenate(places)
            chunks.append((chunk, len(found)))
            times_ns.append(found[np.argsort(found[:, 1], kind="stable"), 0])
        going_on = times_going_on(self.path, np.concatenate(times_ns), self.problems)
        return None if going_on is None else (chunks, going_on)

    def _as_written(
        self, chunks: list[tuple[Any, int]], times_ns: Int[np.ndarray, "n"], channels: set[int], since_ns: int
    ) -> Iterator[tuple[int, bytes]]:
        """Yield the messages that :meth:`_set_back` counted, with these times, those since a time."""
        self._check_size()
        first, end = int(np.searchsorted(times_ns, since_ns)), 0
        for chunk, count in chunks:
            k, end = end, end + count
            if end <= first:
                continue
            for number, _, content in _messages_in(self._chunk(chunk)):
                if number in channels:
                    if k >= end:
                        self._refuse(_TOO_MANY)
                    if k >= first:
                        yield int(times_ns[k]), bytes(content)
                    k += 1

    def _check_size(self) -> None:
        """Refuse chunks that claim too much together: a file may name one chunk any number of times."""
        if (claimed := sum(index.uncompressed_size for index in self.summary.chunk_indexes)) > self._most:
            self._refuse_size(claimed, self._most)

    def _chunk(self, index: Any) -> bytes:
        """Return the unpacked records of a chunk."""
        stream_of = require("mcap.data_stream", "bags").ReadDataStream
        self.stream.seek(index.chunk_start_offset + _RECORD.size)
        chunk = require("mcap.records", "bags").Chunk.read(stream_of(self.stream))
        return self._unpacked(chunk, index.uncompressed_size)

    def _chunks(self, channels: set[int], since_ns: int) -> Iterator[tuple[int, bytes]]:
        """Yield the first time and the unpacked records of each chunk with such channels since a time."""
        indexes = sorted(self.summary.chunk_indexes, key=lambda index: index.message_start_time)
        if not indexes:
            yield from self._records_in_order(self._most)
            return
        self._check_size()
        for index in indexes:
            # Recorders may leave out which channels a chunk has.
            has = not index.message_index_offsets or not channels.isdisjoint(index.message_index_offsets)
            if has and index.message_end_time >= since_ns:
                yield index.message_start_time, self._chunk(index)

    def _records_in_order(self, most: int) -> Iterator[tuple[int, bytes]]:
        """Yield the records of a file without an index of chunks; all could be the first in time."""
        reader = require("mcap.stream_reader", "bags")
        self.stream.seek(0)
        for record in reader.StreamReader(self.stream, emit_chunks=True, record_size_limit=self.size).records:
            data = b""
            if type(record).__name__ == "Chunk":
                data = self._unpacked(record, record.uncompressed_size)
            elif type(record).__name__ == "Message":
                head = _HEAD.pack(record.channel_id, record.sequence, record.log_time, record.publish_time)
                data = _RECORD.pack(_MESSAGE, len(head) + len(record.data)) + head + record.data
            if (most := most - len(data)) < 0:
                self._refuse_size(self._most - most, self._most)
            if data:
                yield 0, data

    def _unpacked(self, chunk: Any, size: int) -> bytes:
        """Unpack a chunk to the size that the index names, and no further."""
        if size > _MAX_CHUNK:
            self._refuse_size(size, _MAX_CHUNK)
        if not chunk.compression:
            data = chunk.data
        elif chunk.compression == "zstd":
            unpacker = require("zstandard", "bags").ZstdDecompressor(max_window_size=_MAX_WINDOW)
            data = unpacker.stream_reader(io.BytesIO(chunk.data)).read(size + 1)
        elif chunk.compression == "lz4":
            data = require("lz4.frame", "bags").LZ4FrameDecompressor().decompress(chunk.data, size + 1)
        else:
            self._refuse(f"has chunks packed by {chunk.compression!r}, expected zstd or lz4")
        if len(data) != size:
            self._refuse(f"a chunk of {size} bytes unpacks to {'more' if len(data) > size else len(data)}")
        return data

    def _refuse_size(self, found: int, most: int) -> None:
        self._refuse(
            f"{self.size / MEBIBYTE:.1f} MB stand for {found / MEBIBYTE:.0f} MB, expected at most "
            f"{most / MEBIBYTE:.0f} MB"
        )

    def _refuse(self, why: str) -> None:
        raise DriveFormatError(f"{self.path}: {why}")


def _messages_in(records: bytes) -> Iterator[tuple[int, int, memoryview]]:
    """Yield channel, time of recording, [ns], and content of each message among the records of a chunk."""
    view, at = memoryview(records), 0
    while at < len(records):
        opcode, length = _RECORD.unpack_from(records, at)
        at += _RECORD.size
        if length > len(records) - at:
            raise ValueError(f"a record of {length} bytes ends behind its chunk")
        if opcode == _MESSAGE:
            channel, _, t_ns, _ = _HEAD.unpack_from(records, at)
            yield channel, t_ns, view[at + _HEAD.size : at + length]
        at += length
