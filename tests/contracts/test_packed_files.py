"""Files of some kilobytes that stand for gigabytes: how much is unpacked is bounded before it is."""

from __future__ import annotations

import base64
import contextlib
import json
import resource
import sqlite3
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from synthetic_labels import make_label_set

from lanenet.data.label_set import write_labels
from lanenet.reading import memory_limit

MEBIBYTE = 2**20
#: Reads a file as what its ending says, and prints the error, the most memory that the process had, [MB], and
#: its processor time, [s].
READER = """
import sys, time
from pathlib import Path
from lanenet.data.drives.sources import open_source
from lanenet.data.label_set import read_labels
from lanenet.errors import LanenetError
path = Path(sys.argv[1])
try:
    if path.suffix == ".parquet":
        read_labels(path)
    else:
        open_source(path).image(0)
except LanenetError as error:
    print(error)
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(int(peak.split()[1]) // 1024, round(time.process_time()))
"""


def mcap(
    messages: Callable[[], Iterable[tuple[int, bytes]]],
    chunk: int,
    compression: CompressionType = CompressionType.ZSTD,
    indexes: IndexType = IndexType.ALL,
    kind: tuple[str, str] = ("sensor_msgs/msg/CompressedImage", "cdr"),
) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        with (folder / "a.mcap").open("wb") as stream:
            writer = McapWriter(stream, chunk, compression, index_types=indexes)
            writer.start("ros2")
            schema = writer.register_schema(kind[0], "", b"")
            channel = writer.register_channel("/camera", kind[1], schema)
            for t_ns, data in messages():
                writer.add_message(channel, t_ns, data, t_ns)
            writer.finish()
        return folder / "a.mcap"

    return make


def parquet(columns: Callable[[], dict[str, pa.Array]]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        table = pa.table(columns()).replace_schema_metadata({b"lanenet": json.dumps({}).encode()})
        pq.write_table(table, folder / "a.parquet", compression="zstd", write_page_checksum=True)
        return folder / "a.parquet"

    return make


def bag(columns: str, rows: int, change: str = "") -> Callable[[Path], Path]:
    """A database with as many messages of these columns, whose tables are changed then."""

    def make(folder: Path) -> Path:
        with contextlib.closing(sqlite3.connect(folder / "a.db3")) as database:
            database.execute("CREATE TABLE topics(id, name, type, serialization_format)")
            database.execute("INSERT INTO topics VALUES (1, '/camera', 'sensor_msgs/msg/Image', 'cdr')")
            database.execute(f"CREATE TABLE messages(topic_id, timestamp{columns})")
            times = [(k,) for k in range(rows)]
            database.executemany("INSERT INTO messages(topic_id, timestamp) VALUES (1, ?)", times)
            database.executescript(change)
            database.commit()
        return folder / "a.db3"

    return make


def deep_image(folder: Path) -> Path:
    """A PNG of 16 bits with alpha, all zero."""
    packer = zlib.compressobj()
    rows = b"".join(packer.compress(bytes(1 + 8 * 7900)) for _ in range(7900)) + packer.flush()
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", 7900, 7900, 16, 6, 0, 0, 0)),
        *((b"IDAT", rows), (b"IEND", b"")),
    ]
    png = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    image = {"timestamp": {"sec": 0, "nsec": 0}, "format": "png", "data": base64.b64encode(png).decode()}
    kind = ("foxglove.CompressedImage", "json")
    return mcap(lambda: [(0, json.dumps(image).encode())], MEBIBYTE, kind=kind)(folder)


def label_rows(folder: Path) -> Path:
    """A row of a label set without points and lines, again and again."""
    write_labels(folder / "one.parquet", make_label_set(1, 0))
    one = pq.read_table(folder / "one.parquet")
    nothing = pa.array([[]] * 200_000, pa.list_(pa.float32()))
    again = np.zeros(len(nothing), np.int64)
    columns = {
        name: nothing if pa.types.is_list(one[name].type) else one[name].combine_chunks().take(again)
        for name in one.column_names
        if name != "image"
    }
    columns["image"] = pa.nulls(len(nothing), one["image"].type)
    table = pa.table(columns).replace_schema_metadata(one.schema.metadata)
    pq.write_table(table, folder / "a.parquet", compression="zstd", write_page_checksum=True)
    return folder / "a.parquet"


def lists() -> dict[str, pa.Array]:
    """Lists of one value, of which Parquet writes the value and how often it comes."""
    ends = pa.array(np.arange(65, dtype=np.int32) * 1_000_000)
    return {"x": pa.ListArray.from_arrays(ends, pa.array(np.zeros(64_000_000)))}


def numbers() -> dict[str, pa.Array]:
    return {f"column_{k}": pa.nulls(3_000_000, pa.float64()) for k in range(16)}


def scans(folder: Path) -> Path:
    """A progressive JPEG whose last scan comes again and again."""
    data = cv2.imencode(".jpg", np.zeros((2000, 2000, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[
        1
    ].tobytes()
    scan = data[data.rfind(b"\xff\xda") : -2]
    (folder / "a.jpg").write_bytes(data[:-2] + 1000 * scan + data[-2:])
    return folder / "a.jpg"


MEGABYTE = bytes(MEBIBYTE)
FILES = {
    "a chunk": (mcap(lambda: [(0, MEGABYTE)] * 1000, 2**31), "MB stand for"),
    "chunks": (mcap(lambda: ((k, 40 * MEGABYTE) for k in range(40)), MEBIBYTE), "MB stand for"),
    "chunks of LZ4": (
        mcap(lambda: [(k, 60 * MEGABYTE) for k in range(2)], MEBIBYTE, CompressionType.LZ4),
        "MB stand for",
    ),
    "chunks of one time": (mcap(lambda: [(0, MEGABYTE)] * 400, 4 * MEBIBYTE), "not in the order of time"),
    "chunks without an index": (
        mcap(lambda: [(0, MEGABYTE)] * 1000, 4 * MEBIBYTE, CompressionType.ZSTD, IndexType.NONE),
        "not in the order of time",
    ),
    "messages without content": (
        mcap(lambda: [(k // 1000, b"") for k in range(400_000)], MEBIBYTE, indexes=IndexType.CHUNK),
        "not a readable bag",
    ),
    "lists of one value": (parquet(lists), "MB stand for more than"),
    "nothing": (parquet(numbers), "MB stand for more than"),
    "a computed column": (bag(", data AS (zeroblob(900000000))", 50), "with nothing computed"),
    "a default": (
        bag("", 20_000, f"ALTER TABLE messages ADD COLUMN data DEFAULT '{400_000 * 'x'}'"),
        "bytes stand for messages of",
    ),
    "lists of JSON": (
        mcap(
            lambda: [(0, b'{"data":[' + 10_000_000 * b"[]," + b"0]}")],
            MEBIBYTE,
            kind=("foxglove.CompressedImage", "json"),
        ),
        "MB of JSON with about",
    ),
    "an image of 16 bits": (deep_image, ""),
    "rows of a label set": (label_rows, "MB stand for 200000 rows"),
    "scans": (scans, "a JPEG of 1010 scans, expected at most 64"),
}


#: One for each reader; the others are slow.
FAST = ("a chunk", "a computed column", "lists of JSON", "rows of a label set", "scans")


@pytest.mark.parametrize(
    "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in FILES]
)
def test_a_small_file_takes_little_memory(tmp_path: Path, name: str) -> None:
    make, words = FILES[name]
    path = make(tmp_path)
    assert path.stat().st_size < 3 * MEBIBYTE
    done = subprocess.run([sys.executable, "-c", READER, path], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    *said, figures = done.stdout.splitlines()
    assert len(said) == bool(words) and words in "".join(said)
    peak_mb, time_s = map(int, figures.split())
    assert peak_mb <= 500 and time_s <= 10


def test_the_limit_ends_with_the_reading() -> None:
    before = resource.getrlimit(resource.RLIMIT_AS)
    with pytest.raises(MemoryError), memory_limit(64 * MEBIBYTE):
        bytes(1024 * MEBIBYTE)
    assert resource.getrlimit(resource.RLIMIT_AS) == before
    assert len(bytes(1024 * MEBIBYTE)) == 1024 * MEBIBYTE
