"""The Raspberry Pi's camera through the program rpicam-vid, for environments without picamera2."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import tempfile
import time
from typing import IO, ClassVar, Literal

import cv2
import numpy as np
from pydantic import Field

from lanenet.config import Rule
from lanenet.errors import HardwareError
from lanenet.onboard.cameras.live import CameraSettings, Capture, stop_quietly

#: The program's name since Raspberry Pi OS Bookworm, and before.
_PROGRAMS = ("rpicam-vid", "libcamera-vid")
#: The program pads rows of raw images to a multiple of this.
_ROW_BYTES = 64
#: Time for the program to end by itself.
_STOP_S = 1.0
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
        self._jpegs, self._raw = JpegStream(), bytearray()
        # A file, not a pipe: the program can write any amount without being read.
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 (stop closes it)
        try:
            self._process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=self._stderr
            )
        except OSError as error:
            self.stop()
            raise HardwareError(f"{self.name}: {program} cannot be run ({error.strerror})") from None
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
            capture = self._newest_jpeg(data) if self._settings.codec == "mjpeg" else self._newest_raw(data)
            if capture is not None:
                return capture

    def stop(self) -> None:
        """End the program; see ``Device``."""
        process, self._process = self._process, None
        stderr, self._stderr = self._stderr, None
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

    def _newest_jpeg(self, data: bytes) -> Capture | None:
        images = self._jpegs.feed(data)
        for skipped, jpeg in enumerate(reversed(images)):
            # OpenCV returns None for a broken image: then take the one before.
            image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
            if image is not None:
                return Capture(np.asarray(image), skipped=len(images) - 1 - skipped)
        return None

    def _newest_raw(self, data: bytes) -> Capture | None:
        self._raw += data
        width, height = self._settings.width, self._settings.height
        size = width * height * 3 // 2
        count = len(self._raw) // size
        if count == 0:
            return None
        planes = np.frombuffer(bytes(self._raw[(count - 1) * size : count * size]), np.uint8)
        del self._raw[: count * size]
        image = cv2.cvtColor(planes.reshape(height * 3 // 2, width), cv2.COLOR_YUV2BGR_I420)
        return Capture(np.asarray(image), skipped=count - 1)

    def _last_line(self) -> str:
        if self._stderr is None:
            return ""
        self._stderr.seek(0)
        lines = self._stderr.read()[-2000:].decode("utf-8", errors="replace").split("\n")
        lines = [line.strip() for line in lines if line.strip()]
        return f": {lines[-1]}" if lines else ""


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
