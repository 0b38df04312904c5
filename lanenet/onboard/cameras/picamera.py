"""The Raspberry Pi's camera through picamera2, which comes with Raspberry Pi OS.

picamera2 names its formats from the last byte to the first: what it calls "RGB888" is blue, green, red in
memory, OpenCV's order, and "BGR888" is red first (Picamera2 manual, appendix A, "Pixel and image formats").
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.errors import HardwareError, MissingExtraError
from lanenet.onboard.cameras.live import CameraSettings, Capture, stop_quietly

#: Positions of blue, green and red in a pixel of each of picamera2's formats.
_BGR_OF: dict[str, tuple[int, int, int]] = {
    "RGB888": (0, 1, 2),
    "BGR888": (2, 1, 0),
    "XRGB8888": (0, 1, 2),
    "XBGR8888": (2, 1, 0),
}


class PiCameraSettings(CameraSettings):
    """Settings of a camera at the Raspberry Pi's camera connector.

    Attributes:
        kind: Chooses this source.
        camera: Its number in ``rpicam-hello --list-cameras``.
        pixel_format: In picamera2's names; "RGB888" needs no conversion.
    """

    kind: Literal["picamera2"] = "picamera2"
    camera: int = Field(default=0, ge=0)
    pixel_format: Literal["RGB888", "BGR888", "XRGB8888", "XBGR8888"] = "RGB888"

    def make_device(self) -> PiCamera:
        """Build the driver."""
        return PiCamera(self)


class PiCamera:
    """A ``Device`` over picamera2."""

    def __init__(self, settings: PiCameraSettings) -> None:
        self.name = f"picamera2 camera {settings.camera}"
        self._settings = settings
        self._camera: Any = None
        self._job: Any = None
        self._order: tuple[int, int, int] = _BGR_OF[settings.pixel_format]

    def start(self) -> None:
        """Configure a video stream and start it; see :class:`lanenet.onboard.cameras.live.Device`."""
        picamera2 = _require_picamera2()
        settings = self._settings
        try:
            self._camera = picamera2.Picamera2(settings.camera)
            wanted = self._camera.create_video_configuration(
                main={"format": settings.pixel_format, "size": (settings.width, settings.height)},
                controls={"FrameRate": settings.rate_hz},
                buffer_count=4,
            )
            self._camera.configure(wanted)
            # The driver may choose another format than the requested one.
            found = str(self._camera.camera_configuration()["main"]["format"])
            if found not in _BGR_OF:
                raise HardwareError(
                    f"{self.name}: sends format {found!r}, expected one of {', '.join(_BGR_OF)}"
                )
            self._order = _BGR_OF[found]
            self._camera.start()
        except HardwareError:
            self.stop()
            raise
        except Exception as error:  # IndexError without a camera, RuntimeError when it is in use
            self.stop()
            raise HardwareError(
                f"{self.name}: cannot be started ({error}); check its cable and rpicam-hello --list-cameras, "
                "and whether another program uses it"
            ) from None

    def grab(self, timeout_s: float) -> Capture | None:
        """Wait for the next frame; see ``Device``."""
        if self._job is None:
            self._job = self._camera.capture_request(wait=False)
        try:
            request = self._job.get_result(timeout=timeout_s)
        except TimeoutError:
            # Keep the job: new ones would pile up in the driver.
            return None
        except TypeError as error:
            # Until 0.3.16 a job could not be waited for with a limit.
            raise HardwareError(
                f"{self.name}: picamera2 is too old, expected 0.3.17 or later ({error}): sudo apt update, "
                "then sudo apt upgrade"
            ) from None
        self._job = None
        try:
            image = to_bgr(request.make_array("main"), self._order)
            stamp_ns = request.get_metadata().get("SensorTimestamp")
        finally:
            request.release()
        # Nanoseconds since boot, on the clock of time.monotonic.
        return Capture(image, None if stamp_ns is None else 1e-9 * float(stamp_ns))

    def stop(self) -> None:
        """Stop and release the camera; see ``Device``."""
        camera, self._camera, self._job = self._camera, None, None
        if camera is not None:
            stop_quietly(camera.stop, camera.close)


def to_bgr(pixels: UInt8[np.ndarray, "h w c"], order: tuple[int, int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Copy an image into OpenCV's order.

    Args:
        pixels: As picamera2 returns it.
        order: Positions of blue, green and red in a pixel.
    """
    if pixels.shape[2] == 3 and order == (0, 1, 2):
        return np.ascontiguousarray(pixels)
    return np.ascontiguousarray(pixels[:, :, list(order)])


def _require_picamera2() -> ModuleType:
    """Import picamera2, which comes with the system and not with an extra."""
    try:
        return importlib.import_module("picamera2")
    except ImportError as error:
        raise MissingExtraError(
            f"the package picamera2 is needed for kind: picamera2 and cannot be imported ({error}); install "
            "it with: sudo apt install python3-picamera2, and make the environment with python3 -m "
            "venv --system-site-packages; or use kind: rpicam"
        ) from None
    except ValueError as error:
        # Raspberry Pi OS Bookworm's modules are compiled for NumPy 1 (raspberrypi/picamera2#1088).
        raise MissingExtraError(
            f"picamera2 cannot be imported ({error}): this NumPy does not fit Raspberry Pi OS's own modules; "
            "install an older one with: pip install 'numpy<2'"
        ) from None
