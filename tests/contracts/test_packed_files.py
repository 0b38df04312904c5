"""Files of some kilobytes that stand for gigabytes: how much is unpacked is bounded before it is."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

from lanenet.reading import memory_limit

MEBIBYTE = 2**20
#: Reads a file as what its ending says, and prints the error and the most memory that the process had, [MB].
READER = """
import sys
from pathlib import Path
from lanenet.data.drives.sources import open_source
from lanenet.data.tables import ParquetTable
from lanenet.errors import LanenetError
path = Path(sys.argv[1])
try:
    if path.suffix == ".parquet":
        ParquetTable(path)
    else:
        open_source(path).image(0)
except LanenetError as error:
    print(error)
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(int(peak.split()[1]) // 1024)
"""


def mcap(
    messages: Iterable[tuple[int, bytes]],
    chunk: int,
    compression: CompressionType = CompressionType.ZSTD,
    indexes: IndexType = IndexType.ALL,
) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        with (folder / "a.mcap").open("wb") as stream:
            writer = McapWriter(stream, chunk, compression, index_types=indexes)
            writer.start("ros2")
            schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"")
            channel = writer.register_channel("/camera", "cdr", schema)
            for t_ns, data in messages:
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
    "a chunk": (mcap([(0, MEGABYTE)] * 1000, 2**31), "MB stand for"),
    "chunks": (mcap([(k, 40 * MEGABYTE) for k in range(40)], MEBIBYTE), "MB stand for"),
    "chunks of LZ4": (
        mcap([(k, 60 * MEGABYTE) for k in range(2)], MEBIBYTE, CompressionType.LZ4),
        "MB stand for",
    ),
    "chunks of one time": (mcap([(0, MEGABYTE)] * 400, 4 * MEBIBYTE), "not in the order of time"),
    "chunks without an index": (
        mcap([(0, MEGABYTE)] * 1000, 4 * MEBIBYTE, CompressionType.ZSTD, IndexType.NONE),
        "not in the order of time",
    ),
    "messages without content": (
        mcap([(k // 1000, b"") for k in range(400_000)], MEBIBYTE, indexes=IndexType.CHUNK),
        "not a readable bag",
    ),
    "lists of one value": (parquet(lists), "MB stand for more than"),
    "nothing": (parquet(numbers), "MB stand for more than"),
    "scans": (scans, "a JPEG of 1010 scans, expected at most 64"),
}


#: One for each reader; the others are slow.
FAST = ("a chunk", "lists of one value", "scans")


@pytest.mark.parametrize(
    "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in FILES]
)
def test_a_small_file_takes_little_memory(tmp_path: Path, name: str) -> None:
    make, words = FILES[name]
    path = make(tmp_path)
    assert path.stat().st_size < 2 * MEBIBYTE
    done = subprocess.run([sys.executable, "-c", READER, path], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    *said, peak_mb = done.stdout.splitlines()
    assert len(said) == 1 and words in said[0]
    assert int(peak_mb) <= 500


def test_the_limit_ends_with_the_reading() -> None:
    before = resource.getrlimit(resource.RLIMIT_AS)
    with pytest.raises(MemoryError), memory_limit(64 * MEBIBYTE):
        bytes(1024 * MEBIBYTE)
    assert resource.getrlimit(resource.RLIMIT_AS) == before
    assert len(bytes(1024 * MEBIBYTE)) == 1024 * MEBIBYTE
