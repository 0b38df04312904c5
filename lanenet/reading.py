"""The front door for files: every reader opens, bounds and parses what it gets by the functions here.

A file may come from anywhere, damaged or made to do harm. It has to be a regular file, not a device or a
pipe; it is read up to a limit; a name that stands in a file may not lead out of that file's folder; and
whatever a parser raises becomes one error that names the file.
"""

from __future__ import annotations

import json
import os
import re
import resource
import stat
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, BinaryIO

from lanenet.errors import LanenetError
from lanenet.image_header import as_stored, image_size, is_cut_off, orientation, scan_count

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import UInt8

MEBIBYTE = 2**20
#: Chosen: lists in JSON take about twenty times their text in memory, so 32 MB stay below a gigabyte. The
#: largest files, the lane lines of an hour's drive, have 2 MB.
MAX_JSON = 32 * MEBIBYTE
#: What a parser may ask for beside what it unpacks, [B]; chosen: pages and stacks. And one limit at a time.
_SLACK, _LIMITING = 64 * MEBIBYTE, threading.Lock()
#: A photo, or an image of a drive. Chosen: above the 30 MB of a phone's best JPEG.
MAX_IMAGE = 64 * MEBIBYTE
#: Of an image. Chosen: above the 50 megapixels of a phone; 192 MB decoded.
MAX_PIXELS = 64 * 10**6

#: Of a progressive JPEG, each of which takes as long as the whole image. Chosen: encoders write up to 14.
_MAX_SCANS = 64
#: What each orientation of Exif takes: exchange rows and columns, then top and bottom, then left and right.
_TURNS = {
    **{1: (False, False, False), 2: (False, False, True), 3: (False, True, True), 4: (False, True, False)},
    **{5: (True, False, False), 6: (True, False, True), 7: (True, True, True), 8: (True, True, False)},
}

#: What parsers of Python, NumPy and PyYAML raise for bytes that they were not made for.
_PARSER_ERRORS = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
    struct.error,
    zlib.error,
)
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@contextmanager
def parsing(where: object, error: type[LanenetError]) -> Iterator[None]:
    """Turn what a parser raises into an error that names the file.

    Args:
        where: File, and key or line if they are known.
        error: The error to raise; errors of lanenet pass as they are.

    Raises:
        LanenetError: Of the type ``error``.
    """
    try:
        yield
    except KeyError as problem:
        raise error(f"{where}: key {problem} is missing") from problem
    except RecursionError as problem:
        raise error(f"{where}: nested too deeply") from problem
    except MemoryError as problem:
        raise error(f"{where}: too large for the memory") from problem
    except _PARSER_ERRORS as problem:
        raise error(f"{where}: {first_line(problem)}") from problem


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, or its type."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def is_regular(path: Path) -> bool:
    """Tell whether there is a regular file; False for a name that no file can have."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Tell whether there is a folder; False for a name that none can have."""
    try:
        return stat.S_ISDIR(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def natural_key(name: object) -> list[tuple[int, int, str]]:
    """Return the sort key of a name by which 2 comes before 10, as people count."""
    parts = re.split(r"([0-9]+)", str(name))
    return [(0, int(part), "") if k % 2 else (1, 0, part) for k, part in enumerate(parts)]


@contextmanager
def memory_limit(most: int) -> Iterator[None]:
    """Bound what a parser may ask for beyond what the process has: many allocate what a file claims.

    Where the kernel does not say how much that is, as on macOS, there is no bound.

    Args:
        most: Further memory, [B].
    """
    statm = Path("/proc/self/statm")
    with _LIMITING:
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        try:
            pages = int(statm.read_text().split()[0])
        except OSError:
            yield
            return
        limit = pages * resource.getpagesize() + most + _SLACK
        known = [value for value in (soft, hard) if value != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([limit, *known]), hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextmanager
def open_regular(path: Path, error: type[LanenetError], most: int) -> Iterator[BinaryIO]:
    """Open a file for reading, if it is one.

    Args:
        path: The file; a link is followed.
        error: The error to raise.
        most: Largest size, [B].

    Raises:
        LanenetError: Of the type ``error``, if it is missing, no regular file, unreadable or larger.
    """
    try:
        # Before it is opened: opening a device may already do something, and a pipe waits for its writer.
        _check_regular(path, path.stat(), error, most)
        stream = open(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb")  # noqa: PTH123, SIM115
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except (OSError, ValueError) as problem:
        raise error(f"{path}: cannot be read ({first_line(problem)})") from None
    with stream:
        _check_regular(path, os.fstat(stream.fileno()), error, most)
        try:
            yield stream
        except OSError as problem:
            raise error(f"{path}: cannot be read ({first_line(problem)})") from None


def read_bytes(path: Path, error: type[LanenetError], most: int) -> bytes:
    """Read a whole file; arguments and errors as for :func:`open_regular`."""
    with open_regular(path, error, most) as stream:
        # At most what the file has now, since a buffer is as large as what is asked for. Files of the kernel
        # have no size.
        size = max(os.fstat(stream.fileno()).st_size, MEBIBYTE)
        data = stream.read(min(size, most) + 1)
    _check_size(path, len(data), error, most)
    return data


def read_text(path: Path, error: type[LanenetError], most: int) -> str:
    """Read a whole text file, UTF-8; arguments and errors as for :func:`open_regular`."""
    data = read_bytes(path, error, most)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: cannot be read as text ({problem})") from None


def read_json(path: Path, error: type[LanenetError], most: int = MAX_JSON) -> Any:
    """Read a JSON file; arguments and errors as for :func:`open_regular`."""
    text = read_text(path, error, most)
    with parsing(f"{path}: not valid JSON", error):
        return json.loads(text)


class FolderFiles:
    """The files of a folder, by names that stand in one of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._real = os.path.realpath(folder)
        self._parents: dict[str, bool] = {}

    def file(self, name: str, where: object, error: type[LanenetError]) -> Path:
        """Return the path of a file, which need not exist.

        Args:
            name: Relative to the folder; may name a folder below it.
            where: File, and key or line, in which the name stands.
            error: The error to raise.

        Raises:
            LanenetError: Of the type ``error``, if the name is absolute or leads out of the folder, also by a
                link.
        """
        pure = PurePath(name)
        plain = name and "\0" not in name and not pure.is_absolute() and ".." not in pure.parts
        if not plain or not self._holds(name):
            raise error(
                f"{where}: found {name[:200]!r}, expected a file in {self.folder}; copy it there if it is "
                "elsewhere"
            )
        return self.folder / name

    def _holds(self, name: str) -> bool:
        """Tell whether links on the path to a file lead nowhere else."""
        parent = os.path.dirname(name)  # noqa: PTH120
        if parent not in self._parents:
            self._parents[parent] = self._is_below(os.path.join(self.folder, parent))  # noqa: PTH118
        if not self._parents[parent]:
            return False
        path = os.path.join(self.folder, name)  # noqa: PTH118
        return not os.path.islink(path) or self._is_below(path)  # noqa: PTH114

    def _is_below(self, path: str) -> bool:
        real = os.path.realpath(path)
        return real == self._real or real.startswith(self._real.rstrip(os.sep) + os.sep)


def read_image(
    path: Path, error: type[LanenetError], flags: int | None = None, turn: int | None = None
) -> UInt8[np.ndarray, "h w *c"]:
    """Read an image file of a usual format, as it is shown: turned as its Exif data say.

    Args:
        path: JPEG, PNG, BMP, WebP, TIFF or Netpbm, by its content.
        error: The error to raise.
        flags: OpenCV's; None is colour, BGR.
        turn: How to turn it, as Exif's orientation; None takes the image's own.

    Raises:
        LanenetError: Of the type ``error``, if the file is missing, is no image, is too large, or ends too
            early: OpenCV fills the rest of a truncated JPEG with gray without an error.
    """
    return decode_image(read_bytes(path, error, MAX_IMAGE), path, error, flags, turn)


def decode_image(
    data: bytes,
    where: object,
    error: type[LanenetError],
    flags: int | None = None,
    turn: int | None = None,
) -> UInt8[np.ndarray, "h w *c"]:
    """Decode the bytes of an image file; arguments and errors as for :func:`read_image`."""
    # Not at the top: settings are read where OpenCV would only cost time.
    import cv2
    import numpy as np

    if not data:
        raise error(f"{where}: the image file is empty")
    size = image_size(data)
    if (scans := scan_count(data)) > _MAX_SCANS:
        raise error(f"{where}: a JPEG of {scans} scans, expected at most {_MAX_SCANS}")
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise error(
            f"{where}: image of {size[0]}x{size[1]} px, expected at most {MAX_PIXELS // 10**6} megapixels"
        )
    image = None
    if size is not None and not is_cut_off(data):
        flags = (cv2.IMREAD_COLOR if flags is None else flags) | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            # IMREAD_UNCHANGED is -1, which holds all flags.
            image = cv2.imdecode(np.frombuffer(as_stored(data), np.uint8), flags)
        except cv2.error:
            image = None
    if image is None:
        raise error(f"{where}: not a readable image (corrupt or cut off, {len(data)} bytes)")
    transposed, up_down, left_right = _TURNS[orientation(data) if turn is None else turn]
    image = image.swapaxes(0, 1) if transposed else image
    return np.ascontiguousarray(image[:: -1 if up_down else 1, :: -1 if left_right else 1])


def _check_regular(path: Path, status: os.stat_result, error: type[LanenetError], most: int) -> None:
    if not stat.S_ISREG(status.st_mode):
        found = _KINDS.get(stat.S_IFMT(status.st_mode), "something else")
        raise error(f"{path}: is {found}, expected a file")
    _check_size(path, status.st_size, error, most)


def _check_size(path: Path, size: int, error: type[LanenetError], most: int) -> None:
    if size > most:
        raise error(
            f"{path}: has {size / MEBIBYTE:.0f} MB, expected at most {most / MEBIBYTE:.0f} MB of such a file"
        )
