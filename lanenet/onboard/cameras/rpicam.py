"""The Raspberry Pi's camera through the program rpicam-vid, for environments without picamera2."""

from __future__ import annotations

import os
import re
import select
import shutil
import subprocess
import tempfile
import time
from typing import IO, ClassVar, Literal

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Rule
from lanenet.errors import HardwareError
from lanenet.onboard.cameras.jpeg import decode_jpeg
from lanenet.onboard.cameras.live import CameraSettings, Capture, stop_quietly

#: The program's name since Raspberry Pi OS Bookworm, and before.
_PROGRAMS = ("rpicam-vid", "libcamera-vid")
#: The program pads rows of raw images to a multiple of this.
_ROW_BYTES = 64
#: Time for the program to end by itself.
_STOP_S = 1.0
#: The program writes the time of an image right after the image. Longest wait for it, chosen: as long as a
#: frame may be old.
_STAMP_S = 0.1
#: A time of exposure in the program's lines, [ns].
_STAMP = re.compile(rb"^SensorTimestamp=(\d+)$", re.MULTILINE)
#: JPEG markers: start and end of image, start of scan.
_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
#: JPEG markers without a length: TEM and RST0 to RST7.
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})


class RpicamSettings(CameraSettings):
    """Settings of a camera that rpicam-vid reads.

    Attributes:
        kind: Chooses this source.
        camera: Its number in ``rpicam-hello --list-cameras``.
        codec: ``mjpeg`` needs little bandwidth; ``yuv420`` is lossless and needs no decoding, but a width
            that is a multiple of 64.
        program: The program; None tries rpicam-vid, then libcamera-vid.
        options: More arguments for it, for example ``[--shutter, "8000"]``.
        metadata: Let the program write the time of exposure of each frame (its ``--metadata``, since
            September 2022); without, the age of a frame is unknown.
    """

    rules: ClassVar[tuple[Rule, ...]] = (
        *CameraSettings.rules,
        Rule(
            ("codec", "width", "height"),
            lambda s: s.codec != "yuv420" or not (s.width % _ROW_BYTES or s.height % 2),
            lambda _: (
                f"codec yuv420 needs a width that is a multiple of {_ROW_BYTES} and an even height; use "
                "codec mjpeg"
            ),
        ),
    )

    kind: Literal["rpicam"] = "rpicam"
    camera: int = Field(default=0, ge=0)
    codec: Literal["mjpeg", "yuv420"] = "mjpeg"
    program: str | None = None
    options: tuple[str, ...] = ()
    metadata: bool = True

    def make_device(self) -> Rpicam:
        """Build the driver."""
        return Rpicam(self)


class Rpicam:
    """A ``Device`` over a pipe from rpicam-vid."""

    def __init__(self, settings: RpicamSettings) -> None:
        self.name = f"rpicam camera {settings.camera}"
        self._settings = settings
        self._process: subprocess.Popen[bytes] | None = None
        self._stderr: IO[bytes] | None = None
        self._jpegs = JpegStream()
        self._raw = bytearray()
        #: Images that were complete since the start.
        self._seen = 0
        self._stamps: Stamps | None = None

    def start(self) -> None:
        """Start the program; see :class:`lanenet.onboard.cameras.live.Device`."""
        settings = self._settings
        program = settings.program or next((p for p in _PROGRAMS if shutil.which(p)), None)
        if program is None:
            raise HardwareError(
                f"{self.name}: neither {' nor '.join(_PROGRAMS)} is installed: sudo apt install rpicam-apps"
            )
        words = [program, "--nopreview", "--timeout", "0", "--flush", "--output", "-"]
        words += ["--camera", str(settings.camera), "--codec", settings.codec]
        words += ["--width", str(settings.width), "--height", str(settings.height)]
        words += ["--framerate", f"{settings.rate_hz:g}", *settings.options]
        self._jpegs, self._raw, self._seen = JpegStream(), bytearray(), 0
        # A file, not a pipe: the program can write any amount without being read.
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (stop closes it)
        stamps = Stamps() if settings.metadata else None
        self._stamps = stamps
        if stamps is not None:
            words += ["--metadata", f"/dev/fd/{stamps.write_end}", "--metadata-format", "txt"]
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                pass_fds=() if stamps is None else (stamps.write_end,),
            )
        except OSError as error:
            self.stop()
            raise HardwareError(f"{self.name}: {program} cannot be run ({error.strerror})") from None
        finally:
            if stamps is not None:
                os.close(stamps.write_end)
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)

    def grab(self, timeout_s: float) -> Capture | None:
        """Return the newest image in the pipe; see ``Device``."""
        assert self._process is not None and self._process.stdout is not None
        pipe = self._process.stdout.fileno()
        end_s = time.monotonic() + timeout_s
        while True:
            ready, _, _ = select.select([pipe], [], [], max(0.0, end_s - time.monotonic()))
            if not ready:
                return None
            data = self._read_all(pipe)
            if not data:
                raise HardwareError(f"{self.name}: the program ended{self._last_line()}")
            images = self._split(data)
            self._seen += len(images)
            for newer, encoded in enumerate(reversed(images)):
                # Of a broken image the one before is taken.
                if (image := self._decode(encoded)) is not None:
                    exposed_s = self._exposed_s(self._seen - 1 - newer)
                    return Capture(image, exposed_s, skipped=len(images) - 1 - newer)

    def stop(self) -> None:
        """End the program; see ``Device``."""
        process, self._process = self._process, None
        stderr, self._stderr = self._stderr, None
        stamps, self._stamps = self._stamps, None
        if stamps is not None:
            stamps.close()
        if process is not None:
            assert process.stdout is not None
            stop_quietly(process.stdout.close, process.terminate)
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                stop_quietly(process.kill, process.wait)
        if stderr is not None:
            stderr.close()

    @staticmethod
    def _read_all(pipe: int) -> bytes:
        """Read everything in the pipe; empty if the program has closed it."""
        parts = []
        while True:
            try:
                part = os.read(pipe, 1 << 20)
            except BlockingIOError:
                break
            if not part:
                break
            parts.append(part)
        return b"".join(parts)

    def _split(self, data: bytes) -> list[bytes]:
        """Return the images that are complete with these bytes, oldest first."""
        if self._settings.codec == "mjpeg":
            return self._jpegs.feed(data)
        self._raw += data
        size = self._settings.width * self._settings.height * 3 // 2
        count = len(self._raw) // size
        images = [bytes(self._raw[k * size : (k + 1) * size]) for k in range(count)]
        del self._raw[: count * size]
        return images

    def _decode(self, data: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
        if self._settings.codec == "mjpeg":
            return decode_jpeg(data)
        planes = np.frombuffer(data, np.uint8).reshape(-1, self._settings.width)
        return np.asarray(cv2.cvtColor(planes, cv2.COLOR_YUV2BGR_I420))

    def _exposed_s(self, number: int) -> float | None:
        """Return the time of exposure of an image, counted from the start; None if it is unknown."""
        if self._stamps is None:
            return None
        stamp_s = self._stamps.of(number, _STAMP_S)
        if stamp_s is None:
            # Those that follow could belong to any frame.
            self._stamps.close()
            self._stamps = None
        return stamp_s

    def _last_line(self) -> str:
        if self._stderr is None:
            return ""
        self._stderr.seek(0)
        lines = self._stderr.read()[-2000:].decode("utf-8", errors="replace").split("\n")
        lines = [line.strip() for line in lines if line.strip()]
        return f": {lines[-1]}" if lines else ""


class Stamps:
    """Times of exposure as rpicam-vid writes them into a pipe, one for each image."""

    def __init__(self) -> None:
        """Open the pipe; ``write_end`` is for the program."""
        self._read_end, self.write_end = os.pipe()
        self._data = b""
        #: Times that were not returned yet, and the number of the first one's image.
        self._times_s: list[float] = []
        self._first = 0

    def of(self, number: int, timeout_s: float) -> float | None:
        """Return the time of an image, on the clock of :func:`time.monotonic`; None if it does not come.

        Args:
            number: Of the image, not smaller than in the call before.
            timeout_s: The longest wait, [s].
        """
        end_s = time.monotonic() + timeout_s
        while number >= self._first + len(self._times_s):
            ready, _, _ = select.select([self._read_end], [], [], max(0.0, end_s - time.monotonic()))
            data = os.read(self._read_end, 1 << 16) if ready else b""
            if not data:
                return None
            lines, _, self._data = (self._data + data).rpartition(b"\n")
            self._times_s += [1e-9 * int(stamp) for stamp in _STAMP.findall(lines)]
        del self._times_s[: number - self._first]
        self._first = number
        return self._times_s[0]

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._read_end)


class JpegStream:
    """Splits a stream of bytes into complete JPEG images; bytes between them are dropped.

    Source: ITU-T T.81, annex B (markers, segments); in entropy-coded data FF is followed by 00 or RST0-RST7.
    """

    def __init__(self, longest: int = 8_000_000) -> None:
        """Start empty.

        Args:
            longest: Anything longer is noise: it is dropped, and the search for a start goes on.
        """
        self._longest = longest
        self._data = bytearray()
        #: Position of the parser, at a marker or in entropy-coded data; 0 if no start was found yet.
        self._at = 0
        self._in_scan = False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the images that are complete with these bytes, oldest first."""
        self._data += data
        images: list[bytes] = []
        while True:
            end = self._find_end()
            if end is None:
                if len(self._data) > self._longest:
                    self._drop(2)
                    continue
                return images
            if end > 0:
                images.append(bytes(self._data[:end]))
            self._drop(max(end, 0))

    def _drop(self, count: int) -> None:
        del self._data[:count]
        self._at, self._in_scan = 0, False

    def _find_end(self) -> int | None:
        """Return the end of the image at the start of the data; None if more bytes are needed.

        A broken image is dropped up to where it breaks, and 0 is returned: the search restarts there.
        """
        data = self._data
        if self._at == 0:
            start = data.find(b"\xff\xd8")
            # The last byte may be the first half of a start.
            keep = len(data) - (1 if data[-1:] == b"\xff" else 0) if start < 0 else start
            del data[:keep]
            if start < 0:
                return None
            self._at = 2
        while True:
            if self._in_scan:
                mark = data.find(b"\xff", self._at)
                if mark < 0 or mark + 1 >= len(data):
                    self._at = len(data) if mark < 0 else mark
                    return None
                code = data[mark + 1]
                if code == 0x00 or code in _ALONE:
                    self._at = mark + 2
                    continue
                self._at, self._in_scan = mark, False
            if self._at + 1 >= len(data):
                return None
            if data[self._at] != 0xFF or data[self._at + 1] == _SOI:
                # Bytes were lost; the next image may start here.
                del data[: self._at]
                self._at = 0
                return 0
            code = data[self._at + 1]
            if code == 0xFF:
                self._at += 1
            elif code == _EOI:
                return self._at + 2
            elif code in _ALONE:
                self._at += 2
            elif self._at + 3 >= len(data):
                return None
            else:
                self._at += 2 + int.from_bytes(data[self._at + 2 : self._at + 4], "big")
                self._in_scan = code == _SOS
