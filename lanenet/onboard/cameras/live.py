"""A running camera as a source: a thread keeps the newest frame, and restarts a camera that is lost."""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Rule, Settings
from lanenet.errors import HardwareError, LanenetError
from lanenet.onboard.devices import Frame, FrameSource

_log = logging.getLogger(__name__)

#: The longest wait of one call of a device, so that ``close`` is not held up.
_GRAB_S = 0.1
#: First and longest pause between two attempts to restart a lost camera; each pause is as long as the camera
#: has been lost. Chosen: a plug that slipped is back at once, a driver that crashed is not flooded.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.2, 5.0
#: Closing waits no longer than this for a driver that hangs.
_JOIN_S = 3.0
#: A first time of exposure further ahead, or older, is from another clock; chosen: more than rounding, and
#: more than any driver has buffers for.
_MAX_AHEAD_S, _MAX_OLD_S = 0.05, 60.0


def _longer_than_a_frame(key: str) -> Rule:
    """Return the rule by which a camera is not lost between two of its frames."""
    return Rule(
        (key, "rate_hz"),
        lambda s: getattr(s, key) * s.rate_hz > 1.0,
        lambda s: f"expected more than {1.0 / s.rate_hz:.3g} s, the time between two frames",
    )


class CameraSettings(Settings):
    """Settings of all cameras.

    Attributes:
        width: Image width as in the camera file, [px].
        height: Image height, [px].
        rate_hz: Frames per second.
        rotate_180: Turn the image, for a camera mounted upside down; the camera file is that of the turned
            image.
        start_s: The longest wait for the first frame.
        silence_s: A camera that sends no frame for this long counts as lost.
        give_up_s: For how long a lost camera is restarted.
        delay_s: Time from the exposure of a frame to its arrival, as ``lanenet doctor --camera-delay``
            measures it, in place of the driver's times. None: the driver's times; without them the age of a
            frame is unknown.
    """

    rules: ClassVar[tuple[Rule, ...]] = (_longer_than_a_frame("start_s"), _longer_than_a_frame("silence_s"))

    width: int = Field(default=320, ge=16, le=4096)
    height: int = Field(default=240, ge=16, le=4096)
    rate_hz: float = Field(default=30.0, gt=0.0, le=240.0)
    rotate_180: bool = False
    start_s: float = Field(default=5.0, gt=0.0)
    silence_s: float = Field(default=1.0, gt=0.0)
    give_up_s: float = Field(default=60.0, ge=0.0)
    delay_s: float | None = Field(default=None, ge=0.0, le=10.0)

    def make_device(self) -> Device:
        """Build the camera's driver; the camera is not touched before ``start``."""
        raise NotImplementedError

    def make_source(self) -> FrameSource:
        """Build the source; the camera is not touched before ``open``."""
        return LiveSource(self.make_device(), self)


@dataclass(frozen=True, eq=False)
class Capture:
    """One image from a device.

    Attributes:
        image_bgr: The image; the device does not change it any more.
        t_s: Time of exposure; a device that gives it declares that it is on the clock of
            :func:`time.monotonic`. None if it has no such clock: the age of the image is unknown.
        skipped: Older images that the device dropped since the last one.
    """

    image_bgr: UInt8[np.ndarray, "h w 3"] = field(repr=False)
    t_s: float | None = None
    skipped: int = 0


@runtime_checkable
class Device(Protocol):
    """A camera driver, used by one thread at a time.

    Attributes:
        name: For messages.
    """

    name: str

    def start(self) -> None:
        """Start the camera; raises HardwareError or MissingExtraError."""
        ...

    def grab(self, timeout_s: float) -> Capture | None:
        """Return the next image, None if there is none in time; raises HardwareError if it is lost."""
        ...

    def stop(self) -> None:
        """Stop the camera; harmless if it does not run, never raises."""
        ...


class LiveSource:
    """The newest frame of a device; a ``FrameSource``."""

    def __init__(self, device: Device, settings: CameraSettings) -> None:
        self._device = device
        self._settings = settings
        self._fresh = threading.Condition()
        self._newest: Frame | None = None
        self._returned = -1
        self._count = 0
        #: Whether the device's times are on the clock of time.monotonic; None until it gives one.
        self._has_clock: bool | None = None
        self._warned = False
        self._failure: HardwareError | None = None
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Start the camera and wait for its first frame; see :class:`lanenet.onboard.devices.FrameSource`.

        Raises:
            HardwareError: If the camera is not there, sends nothing or what cannot be used, or if its driver
                raises anything else.
            MissingExtraError: If its driver is not installed.
        """
        if self._thread is not None:
            return
        self._closing.clear()
        self._failure = None
        try:
            self._device.start()
            end_s = time.monotonic() + self._settings.start_s
            while self._newest is None:
                if time.monotonic() > end_s:
                    raise HardwareError(
                        f"{self._device.name}: no frame within {self._settings.start_s:g} s; is its cable "
                        "seated, and does another program use it?"
                    )
                self._take(self._device.grab(_GRAB_S))
        except BaseException as error:
            self._device.stop()
            if isinstance(error, LanenetError) or not isinstance(error, Exception):
                raise
            raise HardwareError(
                f"{self._device.name}: its driver fails at the first frame ({type(error).__name__}: "
                f"{error}); is its cable seated, does another program use it, is the driver up to date?"
            ) from error
        self._thread = threading.Thread(target=self._run, name=f"camera {self._device.name}", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the newest frame that was not returned before; see ``FrameSource``.

        Raises:
            HardwareError: If the camera was lost and did not come back in time, or it is not open.
        """
        if self._thread is None:
            raise HardwareError(f"{self._device.name}: not open")
        with self._fresh:
            self._fresh.wait_for(self._has_news, timeout_s)
            if self._failure is not None:
                raise self._failure
            frame = self._newest
            if frame is None or frame.number == self._returned:
                return None
            self._returned = frame.number
            return frame

    def close(self) -> None:
        """Stop the camera and its thread."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._closing.set()
        thread.join(_JOIN_S)
        if thread.is_alive():
            _log.warning("%s: its driver hangs; its thread is abandoned", self._device.name)
        self._newest = None

    def _has_news(self) -> bool:
        news = self._newest is not None and self._newest.number != self._returned
        return news or self._failure is not None

    def _run(self) -> None:
        """Grab until closed; meanwhile no other thread uses the device."""
        heard_s = time.monotonic()
        lost_s = math.nan
        while not self._closing.is_set():
            try:
                if self._take(self._device.grab(_GRAB_S)):
                    heard_s, lost_s = time.monotonic(), math.nan
                elif time.monotonic() - heard_s > self._settings.silence_s:
                    raise HardwareError(f"{self._device.name}: no frame for {self._settings.silence_s:g} s")
            except Exception as error:
                # A driver may raise anything when its device is pulled out. A camera that restarts but does
                # not send the expected images is still lost.
                lost_s = time.monotonic() if math.isnan(lost_s) else lost_s
                if not self._find_again(error, lost_s):
                    break
                heard_s = time.monotonic()
        self._device.stop()

    def _find_again(self, error: Exception, lost_s: float) -> bool:
        """Restart the device until it works; False if it is closed or given up."""
        _log.error("camera lost: %s; looking for it", error)
        while not self._closing.is_set():
            self._device.stop()
            gone_s = time.monotonic() - lost_s
            left_s = self._settings.give_up_s - gone_s
            if left_s <= 0.0:
                self._fail(
                    HardwareError(f"{self._device.name}: lost for {self._settings.give_up_s:g} s ({error})")
                )
                return False
            self._closing.wait(min(max(gone_s, _FIRST_PAUSE_S), _LONGEST_PAUSE_S, left_s))
            try:
                self._device.start()
            except Exception as again:
                _log.warning("camera not found yet: %s", again)
                continue
            _log.warning("%s: starts again after %.1f s", self._device.name, time.monotonic() - lost_s)
            return True
        return False

    def _fail(self, failure: HardwareError) -> None:
        with self._fresh:
            self._failure = failure
            self._fresh.notify_all()

    def _take(self, capture: Capture | None) -> bool:
        if capture is None:
            return False
        arrived_s = time.monotonic()
        image = capture.image_bgr
        expected = (self._settings.height, self._settings.width, 3)
        if image.shape != expected:
            raise HardwareError(
                f"{self._device.name}: sends images of {'x'.join(map(str, image.shape[1::-1]))} px, expected "
                f"{expected[1]}x{expected[0]} as in the settings"
            )
        if self._settings.rotate_180:
            image = np.asarray(cv2.flip(image, -1))
        exposed_s = self._exposed_s(capture.t_s, arrived_s)
        with self._fresh:
            self._count += 1 + capture.skipped
            t_s = arrived_s if exposed_s is None else exposed_s
            self._newest = Frame(image, t_s, self._count - 1, age_known=exposed_s is not None)
            self._fresh.notify_all()
        return True

    def _exposed_s(self, stamp_s: float | None, arrived_s: float) -> float | None:
        """Return the time of exposure; None if it is unknown."""
        if self._settings.delay_s is not None:
            return arrived_s - self._settings.delay_s
        why = "its driver gives no time of exposure"
        if self._has_clock is None and stamp_s is not None:
            # Only the first time is judged: whatever is old later, is.
            self._has_clock = -_MAX_AHEAD_S <= arrived_s - stamp_s <= _MAX_OLD_S
            why = f"its driver has another clock, {arrived_s - stamp_s:.2f} s behind time.monotonic"
        exposed_s = stamp_s if self._has_clock else None
        if exposed_s is None and not self._warned:
            self._warned = True
            _log.warning(
                "%s: the age of its frames is unknown: %s. Only their arrival is watched; measure their "
                "delay with lanenet doctor --config CAR.yaml --camera-delay",
                self._device.name, why,
            )  # fmt: skip
        return exposed_s


def stop_quietly(*actions: Callable[[], object]) -> None:
    """Call each action and ignore its errors: a device that is gone cannot be stopped properly."""
    for action in actions:
        with contextlib.suppress(Exception):
            action()
