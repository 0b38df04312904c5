"""Rows of a tub's catalogs: what a row says, and which rows are frames, in which order."""

from __future__ import annotations

import bisect
import itertools
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from lanenet.data.drives.recording import MAX_TIME_S
from lanenet.errors import DriveFormatError
from lanenet.reading import MEBIBYTE, read_bytes

#: Of a catalog. Chosen: Donkeycar starts a new one every 1000 rows, which take 0.3 MB, or more with a lidar.
_MAX_CATALOG = 64 * MEBIBYTE
#: Characters of a row. Chosen: 50 000 numbers; lists in JSON take twenty times their text in memory.
_MAX_ROW = 2**20
#: Rows are counted in 64 bits; chosen: exact as a float, too.
_MAX_INDEX = 2**53
#: A joystick at its stop: Donkeycar divides its 16 bits, -32768 to 32767, by 32767. Taken as 1.
_LARGEST_COMMAND = 32768.0 / 32767.0 + 1e-9
#: Drive modes in which the pilot steers.
_STEERED = ("local", "local_angle")
_MAX_FLOAT = sys.float_info.max


@dataclass(frozen=True)
class Record:
    """A usable row of a catalog.

    Attributes:
        index: Its number.
        session: Session of the recording.
        time_ms: Time; NaN if the row has none.
        image: Name of the image as it stands there, with ``/`` between folders.
        angle: Donkeycar's angle; NaN if the row has none.
        throttle: Donkeycar's throttle; NaN if the row has none.
    """

    index: int
    session: str
    time_ms: float
    image: str
    angle: float
    throttle: float


@dataclass(frozen=True)
class Ordered:
    """The frames of a tub in order.

    Attributes:
        records: The rows.
        frames: Their numbers, strictly increasing.
        recounted: Whether the rows' own numbers begin anew, so that ``frames`` differs from them.
        problems: What was wrong, a sentence each.
    """

    records: list[Record]
    frames: Int[np.ndarray, "n"]
    recounted: bool
    problems: tuple[str, ...]


def read_catalog(path: Path, image_key: str) -> tuple[list[Record], list[int]]:
    """Return the records of a catalog and the numbers of the rows that are none.

    A power cut leaves zero bytes and half a row behind; they count as bad rows.

    Raises:
        DriveFormatError: If the file cannot be read.
    """
    records: list[Record] = []
    bad_rows: list[int] = []
    for number, data in _rows(path):
        record = None if data is None else _record(data, image_key)
        if record is not None:
            records.append(record)
        else:
            bad_rows.append(number)
    return records, bad_rows


def first_row(path: Path) -> dict[str, Any]:
    """Return the first row of a catalog that is JSON; an empty one if there is none."""
    return next((data for _, data in _rows(path) if data is not None), {})


def _rows(path: Path) -> Iterator[tuple[int, dict[str, Any] | None]]:
    """Yield number and content of each row that is not blank; None for one that is not a JSON object."""
    text = read_bytes(path, DriveFormatError, _MAX_CATALOG).decode("utf-8-sig", errors="replace")
    for number, line in enumerate(text.split("\n"), start=1):
        if line and not line.isspace():
            yield number, _parsed(line) if len(line) <= _MAX_ROW else None


def _parsed(line: str) -> dict[str, Any] | None:
    if not line.lstrip().startswith("{"):
        return None
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) else None


def _record(data: dict[str, Any], image_key: str) -> Record | None:
    index, image = data.get("_index"), data.get(image_key)
    if not isinstance(index, int) or isinstance(index, bool) or not isinstance(image, str):
        return None
    if not image or "\0" in image or not 0 <= index <= _MAX_INDEX:
        return None
    # In the pilot's drive modes the pilot's commands moved the car, not the user's.
    # Of the template cv_control 'steering' and 'throttle' are what moved the car, whoever commanded it.
    mode = data.get("user/mode")
    return Record(
        index=index,
        session=str(data.get("_session_id")),
        time_ms=_number(data.get("_timestamp_ms"), 1000.0 * MAX_TIME_S),
        image=image.replace("\\", "/"),
        angle=_command(data, "pilot/angle" if mode in _STEERED else "", "user/angle", "steering"),
        throttle=_command(data, "pilot/throttle" if mode == "local" else "", "user/throttle", "throttle"),
    )


def _command(data: dict[str, Any], *keys: str) -> float:
    """Return the number of the first key that has one; NaN if none has."""
    value = next(filter(math.isfinite, (_number(data.get(key)) for key in keys)), math.nan)
    return math.copysign(1.0, value) if 1.0 < abs(value) <= _LARGEST_COMMAND else value


def _number(value: Any, most: float = math.inf) -> float:
    # Whole numbers of any length are JSON.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= most:
        return math.nan
    return float(value) if abs(value) <= _MAX_FLOAT else math.nan


def ordered(records: list[Record]) -> Ordered:
    """Put the rows of a tub in order, without those whose image was overwritten or whose index is damaged.

    An image belongs to the last row that names it, in the place of the first: where a count began again too
    early, as after a power cut, later images took the names of earlier ones. The index is the order as long
    as rows contradict it one by one. Two in a row that do so are of another count, as in tubs of tools that
    count each catalog anew: then the place in the catalogs is the order.

    Args:
        records: The rows as they stand in the catalogs.
    """
    # A key of a dict stays where it first was.
    distinct = list({record.image: record for record in records}.values())
    indexes = [record.index for record in distinct]
    kept = _increasing(indexes)
    lost = sorted(set(range(len(distinct))) - set(kept))
    recounted = any(b == a + 1 for a, b in itertools.pairwise(lost))
    problems = []
    if recounted:
        steps = np.diff(np.array(indexes, dtype=np.int64))
        frames = indexes[0] + np.concatenate([[0], np.cumsum(np.where(steps > 0, steps, 1))])
        problems.append(
            f"'_index' begins anew, first after frame {frames[np.flatnonzero(steps <= 0)[0]]}: frames are "
            "numbered on in the order of the catalogs"
        )
    else:
        distinct = [distinct[k] for k in kept]
        frames = np.array([record.index for record in distinct], dtype=np.int64)
    if left_out := len(records) - len(distinct):
        problems.append(f"{left_out} rows repeat an index or an image, or go back")
    return Ordered(distinct, frames, recounted, tuple(problems))


def _increasing(values: list[int]) -> list[int]:
    """Return the places of the longest increasing subsequence: a wrong value costs itself, not the rest.

    Source:
        Fredman 1975, by patience sorting.
    """
    tails: list[int] = []
    ends: list[int] = []
    before = [-1] * len(values)
    for k, value in enumerate(values):
        at = bisect.bisect_left(tails, value)
        tails[at : at + 1], ends[at : at + 1] = [value], [k]
        before[k] = ends[at - 1] if at else -1
    chain = []
    k = ends[-1] if ends else -1
    while k >= 0:
        chain.append(k)
        k = before[k]
    return chain[::-1]
