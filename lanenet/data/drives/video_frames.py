"""Frames of a video file and the time of each, as they are shown."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.data.drives.others import raw_stream
from lanenet.errors import DriveFormatError
from lanenet.reading import MAX_PIXELS, open_regular

#: Up to this many frames ahead, decoding is taken to be faster than a seek, which decodes from the keyframe
#: before the target. Chosen: a common keyframe interval is 12 to 250 frames.
_MAX_FORWARD = 60
#: A seek aims so much before its target, [ms], since it may land behind. Chosen: some ten frames.
_LEAD_MS = 500.0
#: Times that differ by less are those of one frame, [ms]. Chosen: containers count in parts of a millisecond.
_SAME_MS = 0.5
#: A higher rate in a header is a time base, not a rate.
_MAX_FPS = 1000.0
#: Of a video; chosen: a day at 60 frames/s.
_MAX_FRAMES = 5_000_000
#: A larger number in a header is damaged.
_MAX_LISTED = 1e12
#: [B]; a day of video, too.
_MAX_VIDEO = 2**40
#: How a JPEG begins, and so a file that is nothing but JPEGs: it holds no times, FFmpeg makes them up.
_JPEG = b"\xff\xd8"
#: MPEG program and video elementary streams.
_MPEG = (b"\0\0\1\xba", b"\0\0\1\xb3")
#: How the containers of the known endings begin; MPEG transport streams have their sign at the first byte.
_CONTAINERS = (b"\x1aE\xdf\xa3", b"RIFF", *_MPEG, _JPEG, b"G")
#: What people have under the name of a video, by how it begins, and what to do; ``{file}`` is its path,
#: ``{new}`` its name without the ending.
_NO_VIDEOS = {
    b"PK\3\4": "is an archive: unzip {file}",
    b"version ": "is a pointer of Git LFS, not the file itself: git lfs pull",
    b"--": "is a stream of JPEGs as a server sends it: ffmpeg -f mpjpeg -i {file} -c copy {new}.mjpeg",
}
_ATOMS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")


class VideoImages:
    """Frames of a video file: fast in order, by seeking out of order; turned as the file says.

    Attributes:
        path: The file.
        t_ms: Time of each frame, increasing, [ms]; None if the file has none.
        count: Number of frames that can be decoded.
    """

    def __init__(self, path: Path, known: tuple[int, Float[np.ndarray, "n"] | None] | None = None) -> None:
        """Open a video.

        Args:
            path: The file.
            known: ``count`` and ``t_ms``, if they are known; found otherwise.

        Raises:
            DriveFormatError: If OpenCV cannot open it.
        """
        self.path = path
        self._start = _checked_start(path)
        self._capture = self._opened()
        #: Frame that the decoder gives next.
        self._next = 0
        self._last: tuple[int, np.ndarray] | None = None
        self.t_ms: Float[np.ndarray, "n"] | None = None
        self.count, self.t_ms = known if known is not None else self._frame_times()

    def __reduce__(self) -> tuple[type[VideoImages], tuple[Any, ...]]:
        """Pickle the path and the times only: another process opens the file again."""
        return VideoImages, (self.path, (self.count, self.t_ms))

    @property
    def listed_frames(self) -> int:
        """Number of frames according to the header; 0 if it has none."""
        count = float(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        return int(count) if 0.0 < count <= _MAX_LISTED else 0

    @property
    def fps(self) -> float:
        """Frames per second according to the header; 0 if it has none."""
        fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        return fps if 0.0 < fps <= _MAX_FPS and not self._start.startswith(_JPEG) else 0.0

    @property
    def codec(self) -> str:
        """Four letters that name the codec."""
        code = int(self._capture.get(cv2.CAP_PROP_FOURCC))
        return bytes((code >> 8 * k) & 0xFF for k in range(4)).decode("ascii", errors="replace")

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

    def _frame_times(self) -> tuple[int, Float[np.ndarray, "n"] | None]:
        """Count the frames that can be decoded, and find their times.

        Times of packets and the last frame are read first; the whole video is decoded only if they differ.
        """
        listed = self._packet_times()
        if listed is not None and self._capture.grab():
            # Frames that an edit of the file cut off at its beginning are never shown.
            listed = listed[listed > self._position_ms() - _SAME_MS]
            self.t_ms = listed
            if len(listed) > 1 and self._seek(len(listed) - 1):
                while self._next < len(listed) and self._capture.grab():
                    self._next += 1
                # The decoder may count other frames than there are packets.
                if self._next == len(listed) and abs(self._position_ms() - listed[-1]) < _SAME_MS:
                    self._rewind()
                    return len(listed), listed
        self._rewind()
        times: list[float] = []
        while len(times) < _MAX_FRAMES and self._capture.grab():
            times.append(self._position_ms())
        self._rewind()
        return len(times), _as_times(np.array(times))

    def _packet_times(self) -> Float[np.ndarray, "n"] | None:
        """Return the times of the packets, which are read without being decoded, in order, [ms]."""
        capture = cv2.VideoCapture(str(self.path.resolve()), cv2.CAP_FFMPEG)
        capture.set(cv2.CAP_PROP_FORMAT, -1)
        times: list[float] = []
        while len(times) < _MAX_FRAMES and capture.grab():
            times.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)))
        capture.release()
        # Packets come in the order in which they are decoded.
        return _as_times(np.sort(times))

    def _position_ms(self) -> float:
        """Return the time of the frame that was grabbed last."""
        return float(self._capture.get(cv2.CAP_PROP_POS_MSEC))

    def _opened(self) -> Any:
        # FFmpeg would write beside the progress, and again for each frame; errors say what matters of it.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        # The full path: a relative one such as "http:/a.mp4" would be taken for an address.
        capture = cv2.VideoCapture(str(self.path.resolve()))
        if not capture.isOpened():
            raise DriveFormatError(
                f"{self.path}: not a video that OpenCV can open (or cut off at its end); one that was cut "
                "off is mended by a whole one of the same camera: untrunc WHOLE.mp4 "
                f"{shlex.quote(str(self.path))}; others are converted: {_conversion(self.path)}"
            )
        # Some versions of OpenCV turn frames as the file says, some do not, unless they are told.
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
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

    def _seek(self, row: int) -> bool:
        """Go to a frame, or before it; tells whether that took no decoding from the start."""
        if self.t_ms is None:
            if self._capture.set(cv2.CAP_PROP_POS_FRAMES, row):
                self._next = int(self._capture.get(cv2.CAP_PROP_POS_FRAMES))
            # A seek that lands elsewhere is replaced by decoding from the start.
            reached = self._next == row
        elif row >= len(self.t_ms):
            reached = False
        else:
            # By time: OpenCV finds a frame by its number times the mean rate, which is another one where the
            # rate varies.
            self._capture.set(cv2.CAP_PROP_POS_MSEC, max(0.0, float(self.t_ms[row]) - _LEAD_MS))
            reached = bool(self._capture.grab())
            at_ms = self._position_ms()
            found = int(np.abs(self.t_ms - at_ms).argmin())
            self._next = found + 1
            reached = reached and self._next <= row and abs(float(self.t_ms[found]) - at_ms) < _SAME_MS
        if not reached:
            self._rewind()
        return reached


def _as_times(t_ms: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"] | None:
    """Return times if they can be those of frames: two or more, finite and increasing."""
    plain = len(t_ms) > 1 and bool(np.isfinite(t_ms).all()) and float(np.abs(t_ms).max()) < _MAX_LISTED
    return t_ms if plain and bool((np.diff(t_ms) > 0.0).all()) else None


def _checked_start(path: Path) -> bytes:
    """Return the first bytes of a video, and refuse what is none.

    FFmpeg also reads playlists, which name other files.

    Raises:
        DriveFormatError: Naming the file, and for a stream without a container how to put it into one.
    """
    with open_regular(path, DriveFormatError, _MAX_VIDEO) as stream:
        start = stream.read(8)
    # In QuickTime and MP4 a size goes before the name of the first atom.
    if start.startswith(_CONTAINERS) or start[4:] in _ATOMS:
        return start
    if start.startswith((b"\0\0\0\1", b"\0\0\1")):
        raise DriveFormatError(f"{path}: is {raw_stream(path)}")
    if not start:
        raise DriveFormatError(f"{path}: the file is empty; copy it anew, or record again")
    for sign, what in _NO_VIDEOS.items():
        if start.startswith(sign):
            names = {"file": shlex.quote(str(path)), "new": shlex.quote(path.stem)}
            raise DriveFormatError(f"{path}: {what.format(**names)}")
    raise DriveFormatError(
        f"{path}: not a video that OpenCV can open (it begins with {start!r}); if another program plays it: "
        f"{_conversion(path)}"
    )


def undecodable(path: Path, codec: str) -> str:
    """Say what to do with a video of which no frame can be decoded."""
    known = {"av01": "AV1", "AV01": "AV1", "hev1": "H.265", "hvc1": "H.265", "vvc1": "H.266"}
    name = known.get(codec, repr(codec))
    return f"no frame of the video can be decoded (codec {name}); convert it to H.264: {_conversion(path)}"


def _conversion(path: Path) -> str:
    return f"ffmpeg -i {shlex.quote(str(path))} -c:v libx264 {shlex.quote(f'{path.stem}_h264.mp4')}"
