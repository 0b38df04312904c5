"""USB cameras, and whatever else Linux shows as /dev/video*, through OpenCV."""

from __future__ import annotations

import time
from typing import Any, Literal

import cv2
import numpy as np

from lanenet.errors import HardwareError
from lanenet.onboard.cameras.live import CameraSettings, Capture, stop_quietly


class V4L2Settings(CameraSettings):
    """Settings of a USB camera.

    Attributes:
        kind: Chooses this source.
        device: Device file. The names under ``/dev/v4l/by-id`` stay the same.
        fourcc: Format that is asked for: MJPG needs little of the USB, YUYV costs no decoding.
    """

    kind: Literal["v4l2"] = "v4l2"
    device: str = "/dev/video0"
    fourcc: Literal["MJPG", "YUYV"] = "MJPG"


class V4L2Camera:
    """A ``Device`` over ``cv2.VideoCapture``."""

    def __init__(self, settings: V4L2Settings) -> None:
        self.name = settings.device
        self._settings = settings
        self._capture: Any = None

    def start(self) -> None:
        """Open the device and ask for size and rate; see :class:`lanenet.onboard.cameras.live.Device`."""
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
        # Old frames in a queue would only be late.
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def grab(self, timeout_s: float) -> Capture | None:
        """Return the next frame. OpenCV itself decides how long it waits; see ``Device``."""
        ok, image = self._capture.read()
        if not ok or image is None:
            raise HardwareError(f"{self.name}: sends no frame; was it unplugged?")
        # OpenCV tells the driver's time of the buffer, which Linux takes from the monotonic clock.
        stamp_ms = float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        return Capture(
            np.asarray(image), 1e-3 * stamp_ms if 0.0 < stamp_ms <= 1e3 * time.monotonic() else None
        )

    def stop(self) -> None:
        """Release the device; see ``Device``."""
        capture, self._capture = self._capture, None
        if capture is not None:
            stop_quietly(capture.release)
