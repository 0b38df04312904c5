"""Parts for a Donkeycar: a pilot, a controller for its ``cv_control`` template, and image transformers.

Donkeycar's images are red, green, blue; its angle runs from -1 (left) to 1 (right); its throttle from -1 to
1. Donkeycar itself is not imported: a part is any object with ``run``.

A pilot in ``manage.py``, in place of a trained model::

    from lanenet.onboard.donkey import LanePilot
    V.add(LanePilot.from_file("lanenet.yaml"), inputs=["cam/image_array"],
          outputs=["pilot/angle", "pilot/throttle"], run_condition="run_pilot")

The ``cv_control`` template needs lines in ``myconfig.py`` only (``docs/raspberry_pi.md``)::

    CV_CONTROLLER_MODULE = "lanenet.onboard.donkey"
    CV_CONTROLLER_CLASS = "CvLaneController"
    CV_CONTROLLER_INPUTS = ["cam/image_array", "user/mode", "steering", "throttle"]
    CV_CONTROLLER_OUTPUTS = ["pilot/steering", "pilot/throttle", "ui/image_array"]
    CV_CONTROLLER_CONDITION = None
    LANENET_CONFIG = "/home/pi/mycar/lanenet.yaml"

A transformer for training and driving, here the bird's-eye view::

    POST_TRANSFORMATIONS = ["CUSTOM_BIRDSEYE"]
    CUSTOM_BIRDSEYE_MODULE = lanenet.onboard.donkey.__file__   # after: import lanenet.onboard.donkey
    CUSTOM_BIRDSEYE_CLASS = "BirdseyeTransformer"
    LANENET_CAMERA = "/home/pi/mycar/camera.yaml"
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Num, UInt8
from pydantic import Field

from lanenet.config import Rule, Settings, check_settings, read_yaml
from lanenet.control.controller import ControlSettings, LaneController, speed_of_cm_s, throttle_of
from lanenet.data.camera_file import read_camera
from lanenet.data.drives.sources import read_mask
from lanenet.errors import ConfigError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.onboard.car_file import with_full_paths
from lanenet.onboard.drive import DriveDetectorSettings, with_wheelbase
from lanenet.onboard.frame_check import RepeatCheck
from lanenet.onboard.rules import PILOT_RULES
from lanenet.onboard.safety import CommandLimiter, LimitSettings
from lanenet.perception.camera_check import CameraCheck, Concern, Finding
from lanenet.perception.draw import draw_estimate
from lanenet.perception.edges.views import View, birdseye_view, undistorting_view
from lanenet.perception.estimate import Detector, DetectorInputs, LaneEstimate
from lanenet.perception.registry import build_detector

log = logging.getLogger(__name__)

#: Share of the speed that is left when the camera seems to have moved; chosen, as for ``lanenet drive``.
_SLOW_SHARE = 0.5
#: Donkeycar calls its pilot in every turn of its loop (20 Hz by default), most templates not while a person
#: drives: after a longer silence a person drove.
_PAUSE_S = 0.5
#: Donkeycar's drive modes in which the throttle is not the pilot's.
_PERSON_HAS_THROTTLE = ("user", "local_angle")


class DonkeySettings(Settings):
    """Settings of the pilot; paths are relative to the settings file.

    Attributes:
        camera: Camera file; ``hough`` and ``painter`` need none.
        detector: Finds the lane.
        control: Steering and speed.
        limits: Limits of every command; Donkeycar's angle of 1 is ``max_steering_rad``.
        min_confidence: A frame with less confidence counts as one without a lane.
        hold_s: Without a lane, or without a new image, the car keeps its last command for this long, then
            stops. Must be longer than the time between two images.
        allow_repeated_frames: Treat an image that repeats an earlier one as a new one. Donkeycar repeats the
            last image of a camera that hangs; a simulator without noise gives equal images while the car
            stands.
        camera_check: Compare what the driving car sees with the camera file; slow down to half the speed, and
            stop, when the camera seems to have moved. It starts anew when a person has driven.
    """

    rules: ClassVar[tuple[Rule, ...]] = PILOT_RULES

    camera: Path | None = None
    detector: DriveDetectorSettings = DriveDetectorSettings()
    control: ControlSettings
    limits: LimitSettings = Field(default_factory=LimitSettings)
    min_confidence: float = Field(default=0.3, gt=0.0, le=1.0)
    hold_s: float = Field(default=0.2, ge=0.0)
    allow_repeated_frames: bool = False
    camera_check: bool = True


class LanePilot:
    """Image in, angle and throttle out: a Donkeycar pilot.

    Attributes:
        estimate: The lane of the last image.
        camera: The camera; None if the detector needs none.
    """

    def __init__(
        self, settings: DonkeySettings, folder: Path = Path(), clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Build detector and controller.

        Args:
            settings: The pilot's settings.
            folder: Start of the settings' relative paths.
            clock: Time, [s].

        Raises:
            LanenetError: If the model does not fit the camera, or something required is missing.
        """

        def found(path: Path | None) -> Path | None:
            return None if path is None else folder / path.expanduser()

        camera, mask_path = found(settings.camera), found(settings.detector.mask)
        self.camera = None if camera is None else read_camera(camera)
        mask = None if mask_path is None else read_mask(mask_path)
        self.estimate = LaneEstimate()
        self._settings = settings
        inputs = DetectorInputs(
            camera=self.camera,
            model=found(settings.detector.model),
            any_camera=settings.detector.any_camera,
            lane_width_cm=settings.detector.lane_width_cm,
            mask=mask,
            config=found(settings.detector.config),
        )
        self._detector: Detector = build_detector(settings.detector.kind, inputs)
        self._controller = LaneController(settings.control)
        self._check: CameraCheck | None = None
        if self.camera is not None and settings.camera_check:
            self._check = CameraCheck(self.camera, mask)
        self._finding = Finding()
        self._limiter = CommandLimiter(settings.limits)
        self._clock = clock
        self._repeats = RepeatCheck()
        self._run_s = self._seen_s = -math.inf
        self._target = (0.0, 0.0)
        self._speed_cm_s = 0.0

    @staticmethod
    def from_file(path: str | Path) -> LanePilot:
        """Build the pilot that a YAML file describes; the wheelbase defaults to the camera file's.

        Raises:
            LanenetError: If the file or what it names cannot be used.
        """
        path = Path(path).expanduser()
        data = with_wheelbase(with_full_paths(read_yaml(path), path))
        return LanePilot(check_settings(DonkeySettings, data, str(path)), path.parent)

    def take_over(self) -> None:
        """Begin anew where a person drove: the throttle rises from 0, and no earlier lane is continued."""
        self._begin(self._clock())

    def _begin(self, now_s: float) -> None:
        self._limiter.neutral(now_s)
        self._detector.reset()
        self._controller.reset()
        self._target, self._seen_s = (self._target[0], 0.0), -math.inf
        self._finding = Finding()
        if self._check is not None:
            self._check.reset()

    def moved_by(self, angle: float, throttle: float) -> None:
        """Take the command that moved the car since the last image, where it was not the pilot's own.

        Args:
            angle: Donkeycar's, -1 (left) to 1 (right).
            throttle: Donkeycar's, -1 to 1.
        """
        self._limiter.start_from(-angle * self._settings.limits.max_steering_rad, throttle)
        self._speed_cm_s = speed_of_cm_s(throttle, self._settings.control.speed)

    def run(self, image_rgb: Num[np.ndarray, "h w *c"] | None) -> tuple[float, float]:
        """Return the command for an image.

        Args:
            image_rgb: Donkeycar's image, colour or gray (``IMAGE_DEPTH = 1``); None before the first.

        Returns:
            Angle, -1 (left) to 1 (right), and throttle; a throttle of 0 when the lane is lost.
        """
        now_s = self._clock()
        if now_s - self._run_s > _PAUSE_S:
            self._begin(now_s)
        self._run_s = now_s
        if image_rgb is None:
            self.estimate = LaneEstimate()
        else:
            # A copy, since some of Donkeycar's cameras reuse one array.
            bgr = _bgr_of(image_rgb)
            if self._settings.allow_repeated_frames or not self._repeats.fault_of(bgr):
                motion = self._speed_cm_s, self._limiter.steering_rad
                self._controller.tell(self._detector, now_s, *motion)
                self.estimate = self._detector.detect(bgr)
                self._look_at_camera(bgr, now_s)
                self._follow(now_s)
        if now_s - self._seen_s > self._settings.hold_s:
            self._target = (self._target[0], 0.0)
        steering_rad, self._speed_cm_s = self._target
        throttle = throttle_of(self._speed_cm_s, self._settings.control.speed)
        steering_rad, throttle = self._limiter.limit(steering_rad, throttle, now_s)
        # Donkeycar's sign: -1 is left.
        return -steering_rad / self._settings.limits.max_steering_rad, throttle

    def _follow(self, now_s: float) -> None:
        target = self._controller.target(self.estimate, now_s, self._speed_cm_s, self._limiter.steering_rad)
        if self.estimate.confidence >= self._settings.min_confidence and math.isfinite(target.steering_rad):
            if self._finding.concern is Concern.STOP:
                return
            share = _SLOW_SHARE if self._finding.concern is Concern.SLOW else 1.0
            self._seen_s = now_s
            self._target = (target.steering_rad, share * target.speed_cm_s)

    def _look_at_camera(self, bgr: UInt8[np.ndarray, "h w 3"], now_s: float) -> None:
        """Compare a moving car's view of its lane with the calibration."""
        moves = self._limiter.throttle > self._settings.control.speed.throttle_at_rest
        if self._check is None or not moves or self.estimate.confidence < self._settings.min_confidence:
            return
        before = self._finding.concern
        self._finding = self._check.look(bgr, now_s, self._limiter.steering_rad)
        if self._finding.concern > before:
            log.warning("camera: %s", self._finding.text)

    def run_threaded(self, image_rgb: Num[np.ndarray, "h w *c"] | None) -> tuple[float, float]:
        """Same as :meth:`run`: the pilot is faster than the camera and needs no thread."""
        return self.run(image_rgb)

    def shutdown(self) -> None:
        """Forget the lane; called by Donkeycar at the end."""
        self._detector.reset()
        self._controller.reset()


def _bgr_of(image: Num[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w 3"]:
    """Copy Donkeycar's image in OpenCV's order."""
    if image.ndim == 2 or image.shape[2:] == (1,):
        # Donkeycar's gray images are floats, some with a third axis of length 1.
        gray = np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)
        return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR))
    # Donkeycar gives views that OpenCV does not accept.
    return np.ascontiguousarray(image[..., ::-1])


class CvLaneController:
    """The pilot as a controller for the ``cv_control`` template, which passes a PID controller and ``cfg``.

    The PID controller is not used: steering follows from the geometry of the lane. Called in every drive
    mode, the part shows the lane before the car follows it, and learns from mode and commands what moved the
    car.
    """

    def __init__(self, pid: Any, cfg: Any) -> None:
        """Build the pilot that ``cfg.LANENET_CONFIG`` names.

        Raises:
            LanenetError: If the file is missing or cannot be used.
        """
        path = getattr(cfg, "LANENET_CONFIG", None)
        if path is None:
            raise ConfigError("myconfig.py: LANENET_CONFIG is missing, expected the path of a pilot's YAML")
        self.pilot = LanePilot.from_file(path)
        self._overlay = bool(getattr(cfg, "OVERLAY_IMAGE", False))
        self._mode_before: str | None = "user"

    def run(
        self,
        cam_img: Num[np.ndarray, "h w *c"] | None,
        mode: str | None = "local",
        angle_before: float | None = None,
        throttle_before: float | None = None,
    ) -> tuple[float, float, Num[np.ndarray, "h w *d"] | None]:
        """Return angle, throttle, and the image with the detected lane drawn into it.

        Args:
            cam_img: Donkeycar's image.
            mode: ``user``, ``local_angle`` (the pilot steers, a person has the throttle), or another one, in
                which the pilot drives.
            angle_before: Angle that moved the car since the last image; None before the first command.
            throttle_before: Throttle that did.
        """
        if self._mode_before in _PERSON_HAS_THROTTLE:
            self.pilot.moved_by(angle_before or 0.0, throttle_before or 0.0)
        if self._mode_before == "user" and mode != "user":
            self.pilot.take_over()
        self._mode_before = mode
        angle, throttle = self.pilot.run(cam_img)
        if cam_img is None or not self._overlay:
            return angle, throttle, cam_img
        drawn = draw_estimate(_bgr_of(cam_img), self.pilot.estimate, self.pilot.camera)
        return angle, throttle, np.ascontiguousarray(drawn[:, :, ::-1])

    def shutdown(self) -> None:
        """End the pilot."""
        self.pilot.shutdown()


class _Transformer:
    """One of Donkeycar's image transformations: a fixed view of each image."""

    def __init__(self, view: View) -> None:
        self._view = view

    def run(self, image: UInt8[np.ndarray, "h w *c"] | None) -> UInt8[np.ndarray, "rows columns *c"] | None:
        """Return the view of an image."""
        return None if image is None else self._view.of(np.ascontiguousarray(image))

    def shutdown(self) -> None:
        """Do nothing."""


class BirdseyeTransformer(_Transformer):
    """The bird's-eye view, for Donkeycar's image transformations.

    ``cfg.LANENET_CAMERA`` is the camera file; ``cfg.LANENET_WINDOW`` may be a dictionary with some of
    ``left_cm, near_cm, cell_cm, rows, columns``.
    """

    def __init__(self, cfg: Any) -> None:
        """Read the camera.

        Raises:
            LanenetError: If the camera file or the window cannot be used.
        """
        window = check_settings(_WindowSettings, dict(getattr(cfg, "LANENET_WINDOW", {})), "LANENET_WINDOW")
        super().__init__(birdseye_view(_camera_of(cfg), BirdseyeWindow(**window.model_dump())))


class UndistortTransformer(_Transformer):
    """The undistorted image, for Donkeycar's image transformations.

    ``cfg.LANENET_CAMERA`` is the camera file.
    """

    def __init__(self, cfg: Any) -> None:
        """Read the camera.

        Raises:
            LanenetError: If the camera file cannot be used.
        """
        super().__init__(undistorting_view(_camera_of(cfg)))


class _WindowSettings(Settings):
    """The default window of :class:`BirdseyeWindow`, with checks."""

    left_cm: float = BirdseyeWindow.left_cm
    near_cm: float = BirdseyeWindow.near_cm
    cell_cm: float = Field(default=BirdseyeWindow.cell_cm, gt=0.0)
    rows: int = Field(default=BirdseyeWindow.rows, ge=1, le=2000)
    columns: int = Field(default=BirdseyeWindow.columns, ge=1, le=2000)


def _camera_of(cfg: Any) -> Camera:
    path = getattr(cfg, "LANENET_CAMERA", None)
    if path is None:
        raise ConfigError("myconfig.py: LANENET_CAMERA is missing, expected the path of a camera file")
    return read_camera(Path(path).expanduser())
