"""A drive as a video, with an optional CSV of the same name beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.data.drives.recording import DRIVE_FILE, Commands, DriveFormat, RecordedFrames, read_times
from lanenet.data.tables import is_answers
from lanenet.errors import DriveFormatError
from lanenet.reading import MAX_PIXELS, is_regular, open_regular

VIDEO_ENDINGS: tuple[str, ...] = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mjpeg")

#: Up to this many frames ahead, decoding is taken to be faster than a seek, which decodes from the keyframe
#: before the target. Chosen: a common keyframe interval is 12 to 250 frames.
_MAX_FORWARD = 60
#: Where the header has no rate: that of a Donkeycar.
_DEFAULT_FPS = 20.0
#: A higher rate in a header is a time base, not a rate.
_MAX_FPS = 1000.0

#: Of a video; chosen: a day at 60 frames/s.
_MAX_FRAMES = 5_000_000
#: A larger number in a header is damaged.
_MAX_LISTED = 1e12
#: [B]; a day of video, too.
_MAX_VIDEO = 2**40
#: How the containers of the known endings begin; MPEG transport streams have their sign at the first byte.
_CONTAINERS = (
    *(b"\x1aE\xdf\xa3", b"RIFF", b"\0\0\1\xba", b"\0\0\1\xb3", b"\xff\xd8", b"G"),
    *(b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot"),
)


def _check_container(path: Path) -> None:
    """Refuse what is no video by its first bytes: FFmpeg also reads playlists, which name other files.

    Raises:
        DriveFormatError: Naming the file.
    """
    with open_regular(path, DriveFormatError, _MAX_VIDEO) as stream:
        start = stream.read(8)
    # In QuickTime and MP4 a size goes before the name of the first atom.
    if not start.startswith(_CONTAINERS[:6]) and start[4:] not in _CONTAINERS[6:]:
        raise DriveFormatError(f"{path}: not a video that OpenCV can open (it begins with {start!r})")


class VideoImages:
    """Frames of a video file: fast in order, by seeking out of order."""

    def __init__(self, path: Path) -> None:
        """Open a video.

        Raises:
            DriveFormatError: If OpenCV cannot open it.
        """
        self.path = path
        self._capture = self._opened()
        #: Frame that the decoder gives next.
        self._next = 0
        self._last: tuple[int, np.ndarray] | None = None

    def __reduce__(self) -> tuple[type[VideoImages], tuple[Path]]:
        """Pickle the path only: another process opens the file again."""
        return VideoImages, (self.path,)

    @property
    def listed_frames(self) -> int:
        """Number of frames according to the header; 0 if it has none."""
        count = float(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        return int(count) if 0.0 < count <= _MAX_LISTED else 0

    @property
    def fps(self) -> float:
        """Frames per second according to the header; 0 if it has none."""
        fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        return fps if 0.0 < fps <= _MAX_FPS else 0.0

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Read one frame; see :class:`lanenet.data.drives.recording.ImageSource`."""
        if self._last is not None and self._last[0] == row:
            return self._last[1].copy()
        if not self._next <= row <= self._next + _MAX_FORWARD:
            self._seek(row)
        while self._next < row and self._capture.grab():
            self._next += 1
        ok, image = self._capture.read() if self._next == row else (False, None)
        if not ok or image is None:
            # The decoder's position after a failure is undefined.
            self._rewind()
            raise DriveFormatError(
                f"{self.path}: video frame {row} cannot be decoded (is the video cut off?)"
            )
        self._next = row + 1
        self._last = (row, image)
        return np.asarray(image.copy())

    def count(self) -> int:
        """Count the frames that can be decoded.

        Tries the last frame of the header first; decodes the whole video only if that fails.
        """
        listed = self.listed_frames
        if (
            0 < listed <= _MAX_FRAMES
            and self._capture.set(cv2.CAP_PROP_POS_FRAMES, listed - 1)
            and self._capture.grab()
        ):
            self._rewind()
            return listed
        self._rewind()
        n = 0
        while n < _MAX_FRAMES and self._capture.grab():
            n += 1
        self._rewind()
        return n

    def _opened(self) -> Any:
        _check_container(self.path)
        # The full path: a relative one such as "http:/a.mp4" would be taken for an address.
        capture = cv2.VideoCapture(str(self.path.resolve()))
        if not capture.isOpened():
            raise DriveFormatError(f"{self.path}: not a video that OpenCV can open (or cut off at its end)")
        size = [capture.get(key) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if not size[0] * size[1] <= MAX_PIXELS:
            raise DriveFormatError(
                f"{self.path}: frames of {size[0]:g}x{size[1]:g} px, expected at most "
                f"{MAX_PIXELS // 10**6} megapixels"
            )
        return capture

    def _rewind(self) -> None:
        self._capture.release()
        self._capture = self._opened()
        self._next = 0

    def _seek(self, row: int) -> None:
        if self._capture.set(cv2.CAP_PROP_POS_FRAMES, row):
            self._next = int(self._capture.get(cv2.CAP_PROP_POS_FRAMES))
        # A seek that lands elsewhere is replaced by decoding from the start.
        if self._next != row:
            self._rewind()


def read_video(path: Path) -> RecordedFrames:
    """Read a video; ``<name>.csv`` beside it may give times and commands of its frames, counted from 0.

    A detector's answers of that name are not the recording's, and are passed over.

    Raises:
        DriveFormatError: If the video or its CSV cannot be read, or it has no frame.
    """
    images = VideoImages(path)
    problems: list[str] = []
    n = images.count()
    if n == 0:
        raise DriveFormatError(f"{path}: no frame of the video can be decoded")
    if n < images.listed_frames:
        problems.append(f"{path}: the video is cut off: {n} of {images.listed_frames} frames can be decoded")
    table = path.with_suffix(".csv")
    if table.is_file() and not is_answers(table):
        columns, commands = read_times(table)
        frames, t_s, trusted = columns["frame"], columns["t_s"], True
        inside = np.flatnonzero(frames < n)
        if len(inside) == 0:
            raise DriveFormatError(f"{table}: no row belongs to one of the video's {n} frames")
        if len(inside) < len(frames):
            problems.append(
                f"{table}: {len(frames) - len(inside)} rows lie beyond the video's {n} frames (first: frame "
                f"{frames[len(inside)]})"
            )
            frames, t_s, commands = frames[inside], t_s[inside], commands.subset(inside)
    else:
        fps, trusted = images.fps, images.fps > 0.0
        if not trusted:
            problems.append(f"{path}: the video has no frame rate; taking {_DEFAULT_FPS:.0f} frames/s")
        frames = np.arange(n)
        t_s = frames / (fps or _DEFAULT_FPS)
        commands = Commands()
    return RecordedFrames(frames, t_s, commands, images, tuple(problems), rows=frames, times_trusted=trusted)


FORMAT = DriveFormat(
    kind="video",
    described=f"a video ({', '.join(VIDEO_ENDINGS)})",
    recognises=lambda path: is_regular(path) and path.suffix.lower() in VIDEO_ENDINGS,
    read=read_video,
    files=("{stem}.csv", f"{{stem}}.{DRIVE_FILE}"),
)
