"""Storage of ROS 2 bags: which topics there are, and the bytes of their messages in order."""

from __future__ import annotations

import heapq
import os
import shlex
import sqlite3
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import BinaryIO
from urllib.parse import quote

from lanenet.config import read_yaml
from lanenet.data.files import require
from lanenet.errors import DriveFormatError, LanenetError, counted
from lanenet.reading import FolderFiles, first_line, open_regular

METADATA_FILE = "metadata.yaml"
#: A storage file in the folder of a bag, or a recording by itself.
STORAGE_ENDINGS = (".mcap", ".db3")
#: [B]; chosen: an hour of raw images of a megapixel at 30 frames/s has 0.3 TB.
_MAX_STORAGE = 2**41
_MCAP_SIGN = b"\x89MCAP0\r\n"


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: Such as ``/camera/image_raw``.
        type: Such as ``sensor_msgs/msg/Image``.
        count: Messages, according to the bag's index.
        encoding: Of its messages, ``cdr`` or ``json`` for those that can be read.
    """

    name: str
    type: str
    count: int
    encoding: str

    def __str__(self) -> str:
        encoding = "" if self.encoding in ("cdr", "json") else f" in {self.encoding}"
        return f"{self.name} ({self.type}{encoding}, {counted(self.count, 'message')})"


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever the libraries raise for a damaged bag into one error.

    Raises:
        DriveFormatError: Naming the bag.
    """
    try:
        yield
    except LanenetError:
        raise
    except Exception as error:  # of rosbags, mcap, SQLite and two decompressors, each with its own
        raise DriveFormatError(f"{path}: not a readable bag ({first_line(error)})") from error


class Bag:
    """An open bag; closed with its last reference."""

    def __init__(self, path: Path) -> None:
        """Open a bag's folder, or a single storage file.

        Raises:
            DriveFormatError: If it cannot be read.
            MissingExtraError: If rosbags or mcap is not installed.
        """
        self.path = path
        with reading(path), ExitStack() as stack:
            opened = [
                (_opened_mcap if file.suffix.lower() == ".mcap" else _opened_sqlite)(file, stack)
                for file in _storage_files(path)
            ]
            weakref.finalize(self, stack.pop_all().close)
        self._messages = [messages for _, messages in opened]
        found: dict[str, Topic] = {}
        for topic in (topic for topics, _ in opened for topic in topics):
            same = found.setdefault(topic.name, replace(topic, count=0))
            found[topic.name] = replace(same, count=same.count + topic.count)
        self.topics = list(found.values())

    def messages(self, topic: Topic, from_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yield time of recording, [ns], and bytes of a topic's messages, in order, those from a time on.

        Raises:
            DriveFormatError: If the bag is damaged there.
        """
        with reading(self.path):
            streams = [messages(topic.name, from_ns) for messages in self._messages]
            yield from heapq.merge(*streams, key=lambda message: message[0])


_Messages = Callable[[str, int | None], Iterator[tuple[int, bytes]]]


def _storage_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    # Their names are enough, and the index of each: what else the metadata say may be out of date.
    inside = FolderFiles(path)
    metadata = read_yaml(inside.file(METADATA_FILE, path, DriveFormatError), DriveFormatError)
    with reading(path / METADATA_FILE):
        known = metadata["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in known["relative_file_paths"]]
        compression = known.get("compression_mode")
    if compression:
        raise DriveFormatError(
            f"{path}: compressed by rosbag2 (mode {compression}), expected none or MCAP's own compression; "
            f"unpack it: "
            f"rosbags-convert --src {shlex.quote(str(path))} --dst {shlex.quote(f'{path.name}_unpacked')}"
        )
    files = [inside.file(name, path / METADATA_FILE, DriveFormatError) for name in names]
    for file in files:
        if file.suffix.lower() not in STORAGE_ENDINGS:
            raise DriveFormatError(f"{file}: expected a file that ends in {' or '.join(STORAGE_ENDINGS)}")
    return files


def _opened_sqlite(path: Path, stack: ExitStack) -> tuple[list[Topic], _Messages]:
    with open_regular(path, DriveFormatError, _MAX_STORAGE):
        pass
    # Nothing is written beside the file, not even a lock.
    address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
    database = stack.enter_context(closing(sqlite3.connect(address, uri=True, check_same_thread=False)))
    # Not views, which may be queries without an end.
    tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    if not {("topics",), ("messages",)} <= {*tables}:
        raise DriveFormatError(f"{path}: expected the tables 'topics' and 'messages' of a ROS 2 bag")
    counts = dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
    listed = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
    known = {str(name): number for number, name, _, _ in listed}
    topics = [Topic(str(name), str(type_), counts.get(n, 0), str(form)) for n, name, type_, form in listed]

    def messages(topic: str, from_ns: int | None) -> Iterator[tuple[int, bytes]]:
        rows = database.execute(
            "SELECT timestamp, data FROM messages WHERE topic_id = ? AND timestamp >= ? ORDER BY timestamp",
            (known.get(topic), -(2**63) if from_ns is None else from_ns),
        )
        # Not `yield from`, which would close the cursor, perhaps after the database.
        for row in rows:  # noqa: UP028
            yield row

    return topics, messages


class _BoundedReads:
    """A file of which never more than its size is asked: Python allocates what a damaged length says."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self._size = size
        self.seek, self.tell = stream.seek, stream.tell

    def read(self, length: int = -1) -> bytes:
        """Read up to a number of bytes, or all."""
        return self._stream.read(min(length, self._size))


def _opened_mcap(path: Path, stack: ExitStack) -> tuple[list[Topic], _Messages]:
    # Not by rosbags: it refuses files without ROS's profile, as Foxglove and others write them.
    library = require("mcap.reader", "bags")
    stream = stack.enter_context(open_regular(path, DriveFormatError, _MAX_STORAGE))
    start = stream.read(len(_MCAP_SIGN))
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - len(_MCAP_SIGN)))
    whole = stream.read() == _MCAP_SIGN
    stream.seek(0)
    if start != _MCAP_SIGN:
        raise DriveFormatError(f"{path}: not an MCAP file (it begins with {start!r})")
    # No record is longer than the file, whatever its length says.
    reader = library.SeekingReader(_BoundedReads(stream, size), record_size_limit=size)
    summary = reader.get_summary() if whole else None
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

    def messages(topic: str, from_ns: int | None) -> Iterator[tuple[int, bytes]]:
        for _, _, message in reader.iter_messages([topic], starting_at=from_ns):
            yield message.log_time, message.data

    return topics, messages
