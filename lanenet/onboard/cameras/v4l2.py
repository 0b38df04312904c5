"""USB cameras and other /dev/video* devices of Linux, through OpenCV."""

from __future__ import annotations

import time
from typing import Any, Literal

import cv2
import numpy as np

from lanenet.errors import HardwareError
from lanenet.onboard.cameras.jpeg import decode_jpeg
from lanenet.onboard.cameras.live import CameraSettings, Capture, stop_quietly


class V4L2Settings(CameraSettings):
    """Settings of a USB camera.

    Attributes:
        kind: Chooses this source.
        device: Device file; names under ``/dev/v4l/by-id`` do not change between boots.
        fourcc: Requested format: MJPG needs little USB bandwidth, YUYV no decoding.
    """

    kind: Literal["v4l2"] = "v4l2"
    device: str = "/dev/video0"
    fourcc: Literal["MJPG", "YUYV"] = "MJPG"

    def make_device(self) -> V4L2Camera:
        """Build the driver."""
        return V4L2Camera(self)


class V4L2Camera:
    """A ``Device`` over ``cv2.VideoCapture``."""

    def __init__(self, settings: V4L2Settings) -> None:
        self.name = settings.device
        self._settings = settings
        self._capture: Any = None

    def start(self) -> None:
        """Open the device and request size and rate; see :class:`lanenet.onboard.cameras.live.Device`."""
        settings = self._settings
        capture = cv2.VideoCapture(settings.device, cv2.CAP_V4L2)
        self._capture = capture
        if not capture.isOpened():
            self.stop()
            raise HardwareError(
                f"{self.name}: cannot be opened; is the camera plugged in (ls /dev/v4l/by-id), and are you "
                "in its group (sudo usermod -aG video $USER)?"
            )
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.height)
        capture.set(cv2.CAP_PROP_FPS, settings.rate_hz)
        # Queued frames would only be late.
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if settings.fourcc == "MJPG":
            # As they came: OpenCV would show images that lost bytes, too.
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)

    def grab(self, timeout_s: float) -> Capture | None:
        """Return the next frame, None if it lost bytes; OpenCV decides how long to wait. See ``Device``."""
        ok, image = self._capture.read()
        if not ok or image is None:
            raise HardwareError(f"{self.name}: sends no frame; was it unplugged?")
        # The driver's time of the buffer, which Linux takes from the monotonic clock. Some drivers give none,
        # and some the time of day, which is far ahead.
        stamp_s = 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        image = np.asarray(image)
        if image.ndim == 1 or 1 in image.shape[:2]:
            image = decode_jpeg(image.tobytes())
        elif image.shape[2:] != (3,):
            # Another format than was requested: OpenCV knows how to convert it.
            self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 1)
            return None
        if image is None:
            return None
        return Capture(image, stamp_s if 0.0 < stamp_s <= time.monotonic() else None)

    def stop(self) -> None:
        """Release the device; see ``Device``."""
        capture, self._capture = self._capture, None
        if capture is not None:
            stop_quietly(capture.release)
