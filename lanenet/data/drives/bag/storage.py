"""Storage of ROS 2 bags: which topics there are, and the bytes of their messages in order."""

from __future__ import annotations

import heapq
import re
import shlex
import shutil
import sqlite3
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path, PurePosixPath
from urllib.parse import quote

import numpy as np
from jaxtyping import Int

from lanenet.data.drives.bag.mcap_file import open_mcap
from lanenet.data.drives.bag.topic import MAX_MESSAGE, MAX_STORAGE, Messages, Topic, times_going_on
from lanenet.errors import DriveFormatError, LanenetError
from lanenet.reading import (
    MAX_JSON,
    FolderFiles,
    first_line,
    is_regular,
    natural_key,
    open_regular,
    read_bytes,
)

METADATA_FILE = "metadata.yaml"
#: A storage file in the folder of a bag, or a recording by itself.
STORAGE_ENDINGS = (".mcap", ".db3")
#: A database that was not closed is copied, with its log, up to this size, [B]; chosen: it goes to the folder
#: of temporary files, which often lies in memory.
_MAX_COPIED = 2**31


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
        #: What is wrong with the bag, a sentence each; some are found when a topic is read.
        self.problems: list[str] = []
        with reading(path), ExitStack() as stack:
            files, self.problems = _storage_files(path)
            opened = [_opened(file, stack, self.problems) for file in files]
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


def is_bag(path: Path) -> bool:
    """Tell whether a path is a bag: a storage file, or a folder with the files of one bag, by their names.

    Several files without metadata are one bag if they are numbered as rosbag2 numbers them; else each is a
    recording by itself.
    """
    if path.suffix.lower() in STORAGE_ENDINGS and is_regular(path):
        return True
    files = [file for ending in STORAGE_ENDINGS for file in path.glob(f"*{ending}*")]
    if is_regular(path / METADATA_FILE):
        return bool(files)
    plain = [file for file in files if file.suffix in STORAGE_ENDINGS]
    # A folder in which a bag lies beside folders is no bag itself.
    if not plain or len({re.sub(r"_[0-9]+$", "", file.stem) for file in plain}) != 1:
        return False
    return not any(entry.is_dir() for entry in path.iterdir())


def _storage_files(path: Path) -> tuple[list[Path], list[str]]:
    """Return the files of a bag, and what is wrong with its metadata.

    Metadata are written when the recording ends: after a power cut they are missing, empty or old. Of them
    only the compression counts, which the files do not tell, and which files there should be.
    """
    if not path.is_dir():
        return [path], []
    inside = FolderFiles(path)
    metadata = inside.file(METADATA_FILE, path, DriveFormatError)
    text = ""
    if is_regular(metadata):
        text = read_bytes(metadata, DriveFormatError, MAX_JSON).decode("utf-8", errors="replace")
    # By lines, not as YAML: a torn file has its lines, and 180 topics have any number of values.
    mode = re.search(r"^\s*compression_mode:[ \t'\"]*(\w*)", text, re.MULTILINE)
    block = re.search(r"^\s*relative_file_paths:[ \t]*\n((?:\s*- .*(?:\n|$))*)", text, re.MULTILINE)
    listed = re.findall(r"- [\"']?([^\"'\n]+)", block[1] if block else "")
    names = [PurePosixPath(name.strip().replace("\\", "/")).name for name in listed]
    there = sorted((file.name for file in path.glob("*") if is_regular(file)), key=natural_key)
    packed = mode[1].lower() if mode else ""
    if packed == "file":
        # They may have been unpacked since.
        names = [re.sub(r"\.(zstd|zst|lz4)$", "", name) for name in names]
    if packed not in ("", "none") and (packed != "file" or not {*names} <= {*there}):
        _refuse_packed(path, packed)
    files = [name for name in there if name.lower().endswith(STORAGE_ENDINGS) and not name.startswith(".")]
    if not files and any(name.endswith((".zstd", ".zst", ".lz4")) for name in there):
        _refuse_packed(path, "file")
    # Those of another storage or another bag in the folder are not the recording's.
    if listed_files := [name for name in files if name in names]:
        of_bag = {re.sub(r"_[0-9]+$", "", Path(name).stem) for name in listed_files}
        files = [n for n in files if n in names or re.sub(r"_[0-9]+$", "", Path(n).stem) in of_bag]
    problems = []
    if not names:
        problems.append(f"{metadata}: names no file (was the recording cut off?); the files there are read")
    if absent := [name for name in names if name not in there]:
        problems.append(f"{metadata}: files listed but not there: {', '.join(absent)}")
    if names and (unlisted := [name for name in files if name not in names]):
        problems.append(f"{metadata}: does not list {', '.join(unlisted)}, read all the same")
    if not files:
        raise DriveFormatError(
            f"{path}: no file that ends in {' or '.join(STORAGE_ENDINGS)}; {'; '.join(problems)}"
        )
    return [inside.file(name, metadata, DriveFormatError) for name in files], problems


def _refuse_packed(path: Path, mode: str) -> None:
    unpacked = shlex.quote(f"{path.name}_unpacked")
    raise DriveFormatError(
        f"{path}: compressed by rosbag2 (mode {mode}), expected none or MCAP's own compression; unpack it: "
        f"rosbags-convert --src {shlex.quote(str(path))} --dst {unpacked}"
    )


def _opened(path: Path, stack: ExitStack, problems: list[str]) -> tuple[list[Topic], Messages]:
    """Open a storage file as what it is, whatever its ending."""
    with open_regular(path, DriveFormatError, MAX_STORAGE) as stream:
        start = stream.read(7)
    if start == b"#ROSBAG":
        bag = shlex.quote(f"{path.stem}.bag")
        raise DriveFormatError(
            f"{path}: is a bag of ROS 1, which has to be converted first: cp {shlex.quote(str(path))} {bag}; "
            f"rosbags-convert --src {bag} --dst {shlex.quote(path.stem)}"
        )
    if start.startswith(b"\x89MCAP") or (path.suffix.lower() == ".mcap" and start != b"SQLite "):
        return open_mcap(path, stack, problems)
    return _opened_sqlite(path, stack, problems)


def _opened_sqlite(path: Path, stack: ExitStack, problems: list[str]) -> tuple[list[Topic], Messages]:
    # Nothing is written beside the file, not even a lock.
    whole = _whole_database(path, stack)
    address = f"file:{quote(str(whole.resolve()))}?mode=ro{'&immutable=1' if whole == path else ''}"
    database = stack.enter_context(closing(sqlite3.connect(address, uri=True, check_same_thread=False)))
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE)
    # Not views, which may be queries without an end, nor tables with columns that are computed.
    tables = database.execute(
        "SELECT name FROM sqlite_master AS m WHERE sql LIKE 'CREATE TABLE%' "
        "AND NOT EXISTS (SELECT * FROM pragma_table_xinfo(m.name) WHERE hidden)"
    ).fetchall()
    if not {("topics",), ("messages",)} <= {*tables}:
        raise DriveFormatError(
            f"{path}: expected the tables 'topics' and 'messages' of a ROS 2 bag, with nothing computed"
        )
    # Rows that lack a column stand for its default.
    claimed = database.execute("SELECT sum(length(data)) FROM messages").fetchone()[0] or 0
    stored = sum(file.stat().st_size for file in (whole, _log_of(whole)) if is_regular(file))
    if claimed > stored:
        raise DriveFormatError(f"{path}: {stored} bytes stand for messages of {claimed}")
    counts = dict(database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
    listed = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
    known = {str(name): number for number, name, _, _ in listed}
    topics = [Topic(str(name), str(type_), counts.get(n, 0), str(form)) for n, name, type_, form in listed]

    mended = cache(partial(_set_back, path, database, problems))

    def messages(topic: str, from_ns: int | None) -> Iterator[tuple[int, bytes]]:
        number, since = known.get(topic), -(2**63) if from_ns is None else from_ns
        if (in_order := mended(number)) is not None:
            rows, times_ns = in_order
            for k in range(int(np.searchsorted(times_ns, since)), len(rows)):
                data = database.execute("SELECT data FROM messages WHERE rowid = ?", (int(rows[k]),))
                yield int(times_ns[k]), data.fetchone()[0]
            return
        found = database.execute(
            "SELECT timestamp, data FROM messages WHERE topic_id = ? AND timestamp >= ? ORDER BY timestamp",
            (number, since),
        )
        # Not `yield from`, which would close the cursor, perhaps after the database.
        for row in found:  # noqa: UP028
            yield row

    return topics, messages


def _set_back(
    path: Path, database: sqlite3.Connection, problems: list[str], topic: int | None
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]] | None:
    """Return a topic's rows as they were written, with times that go on, [ns], if the clock was set back."""
    query = "SELECT rowid, timestamp FROM messages WHERE topic_id = ? ORDER BY rowid"
    rows, times_ns = np.array(database.execute(query, (topic,)).fetchall(), np.int64).reshape(-1, 2).T
    going_on = times_going_on(path, times_ns, problems)
    return None if going_on is None else (rows, going_on)


def _log_of(path: Path) -> Path:
    """Return where SQLite keeps the newest messages of a bag that was not closed."""
    return path.with_name(f"{path.name}-wal")


def _whole_database(path: Path, stack: ExitStack) -> Path:
    """Return a database that has its newest rows: a copy of one that was not closed, with its log.

    Raises:
        DriveFormatError: If it is too large to be copied; says how to close it.
    """
    log = _log_of(path)
    if not is_regular(log) or log.stat().st_size == 0:
        return path
    if path.stat().st_size + log.stat().st_size > _MAX_COPIED:
        close = f"import sqlite3; sqlite3.connect('{path.name}').execute('PRAGMA wal_checkpoint(TRUNCATE)')"
        raise DriveFormatError(
            f"{path}: was not closed, its newest messages lie in {log.name}; close it in its folder: "
            f"python -c {shlex.quote(close)}"
        )
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lanenet-bag-")))
    for file in (path, log):
        shutil.copyfile(file, folder / file.name)
    return folder / path.name
