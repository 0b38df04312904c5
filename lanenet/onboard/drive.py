"""Puts a car together from its settings: what is on the car, how it drives, and when it stops."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar

import cv2
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from lanenet.config import Rule, Settings, apply_overrides, check_settings, read_yaml
from lanenet.control.controller import ControlSettings, LaneController
from lanenet.data.camera_file import read_camera
from lanenet.data.drives.recorder import DriveRecorder, RecordingSettings, new_drive_folder
from lanenet.data.drives.sources import read_mask
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import LaneWidthCm
from lanenet.onboard.actuators import ActuatorSettings, first_writes, make_actuator
from lanenet.onboard.actuators.pulses import PulseSettings
from lanenet.onboard.arming import ArmCheck, ArmGate, HoldFile
from lanenet.onboard.cameras import SourceSettings, open_source
from lanenet.onboard.cameras.live import CameraSettings
from lanenet.onboard.cameras.replay import ReplaySettings
from lanenet.onboard.car_file import with_full_paths
from lanenet.onboard.devices import Frame
from lanenet.onboard.guard import CommandSink, GuardedActuator, NoActuator
from lanenet.onboard.loop import CarParts, DriveLoop, DriveMode, Step
from lanenet.onboard.rules import CAR_RULES, DETECTOR_RULES
from lanenet.onboard.safety import LimitSettings, SafetySettings
from lanenet.perception.camera_check import CameraCheck
from lanenet.perception.estimate import Detector, DetectorInputs, LaneEstimate
from lanenet.perception.registry import KINDS, build_detector

#: In a dry run a fault stops the car but does not end the drive: this is longer than any dry run.
_NEVER_S = 1e9


def _known_detector(name: str) -> str:
    if name not in KINDS:
        raise PydanticCustomError("detector", f"expected one of {', '.join(KINDS)}")
    return name


class DriveDetectorSettings(Settings):
    """The detector of a car.

    Attributes:
        kind: As in ``lanenet detect --detector``.
        model: ONNX file or checkpoint folder of the network.
        config: Settings file of the other detectors.
        mask: PNG that is black except on the car itself, which is ignored.
        any_camera: Use a network with another camera than it was trained with.
        lane_width_cm: Between the middles of the two lines, for the network and the lane filter.
    """

    rules: ClassVar[tuple[Rule, ...]] = DETECTOR_RULES

    kind: Annotated[str, AfterValidator(_known_detector)] = "network"
    model: Path | None = None
    config: Path | None = None
    mask: Path | None = None
    any_camera: bool = False
    lane_width_cm: LaneWidthCm | None = None


class DriveSettings(Settings):
    """Everything that ``lanenet drive`` needs.

    Attributes:
        source: Camera, or a recording in its place.
        camera: Camera file; without one only detectors that work in pixels can be used.
        detector: Finds the lane.
        control: Steering and speed; the wheelbase defaults to the camera file's.
        limits: Limits of every command.
        safety: When the car slows down, stops and gives up.
        actuator: Servo and motor; None for a dry run.
        recording: Record the drive; None for no recording.
        threads: Threads of OpenCV; the network uses one.
    """

    rules: ClassVar[tuple[Rule, ...]] = CAR_RULES

    source: SourceSettings
    camera: Path | None = None
    detector: DriveDetectorSettings = DriveDetectorSettings()
    control: ControlSettings
    limits: LimitSettings = Field(default_factory=LimitSettings)
    safety: SafetySettings = Field(default_factory=SafetySettings)
    actuator: ActuatorSettings | None = None
    recording: RecordingSettings | None = None
    threads: int = Field(default=1, ge=1)


def load_drive_settings(path: Path, overrides: list[str] | None = None) -> DriveSettings:
    """Read a car's settings, whose paths count from the file; the wheelbase defaults to the camera file's.

    Raises:
        ConfigError: Naming the file, the key, what was found and what was expected.
        CalibrationError: If the camera file is needed and cannot be used.
    """
    # A path in an override counts from the working folder, as every other one on a command line.
    data = apply_overrides(with_full_paths(read_yaml(path), path), overrides or [])
    return check_settings(DriveSettings, with_wheelbase(data), str(path))


def with_wheelbase(data: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a car's file with the wheelbase of its camera file, unless it has its own.

    Args:
        data: Content of the file, with full paths.

    Raises:
        CalibrationError: If the camera file is needed and cannot be used.
    """
    control, camera = data.get("control", {}), data.get("camera")
    steering = control.get("steering", {}) if isinstance(control, dict) else None
    # Wrong types are left to check_settings, which names them.
    if not isinstance(steering, dict) or not isinstance(camera, str) or "wheelbase_cm" in steering:
        return data
    wheelbase_cm = read_camera(Path(camera)).wheelbase_cm
    return {**data, "control": {**control, "steering": {**steering, "wheelbase_cm": wheelbase_cm}}}


def build_loop(
    settings: DriveSettings,
    *,
    arm: bool = False,
    steering_only: bool = False,
    dry_run: bool = False,
    hold: HoldFile | None = None,
    watch: Callable[[Step], None] | None = None,
    show: Callable[[Frame, LaneEstimate, Step], None] | None = None,
) -> DriveLoop:
    """Put a car together; a recording's folder is made here, devices are opened when the loop runs.

    Args:
        settings: The car's settings.
        arm: Let the motor turn, after the countdown.
        steering_only: Move the wheels and not the motor.
        dry_run: Send nothing; the loop behaves as that of an armed car.
        hold: File that the operator of an armed car holds.
        watch: Called after every turn of the loop.
        show: Called with each frame, what was seen in it and its turn, after the command.

    Raises:
        ConfigError: If the options contradict each other, the car has no actuator and this is no dry run, or
            an armed car would drive by a recording.
        LanenetError: If camera file, model, mask or the recording's folder cannot be used.
    """
    if arm + steering_only + dry_run > 1:
        raise ConfigError("expected one of --arm, --steering-only and --dry-run, found several")
    if settings.actuator is None and not dry_run:
        raise ConfigError("key 'actuator' is missing: expected one, or --dry-run")
    if hold is not None and not arm:
        raise ConfigError(f"--hold {hold.path}: expected --arm as well: only an armed car is held")
    if arm:
        _refuse_blind_drive(settings)
    cv2.setNumThreads(settings.threads)
    camera = None if settings.camera is None else read_camera(settings.camera)
    _refuse_another_size(settings, camera)
    safety = settings.safety
    if dry_run:
        safety = safety.model_copy(update={"countdown_s": 0.0, "end_after_s": _NEVER_S})
    detector = build_drive_detector(settings, camera)
    camera_check = None
    if safety.camera_check and camera is not None:
        camera_check = build_camera_check(settings, camera)
    recorder = _recorder(settings, camera)
    fits = _fits(settings, detector)
    parts = CarParts(
        open_source(settings.source),
        detector,
        LaneController(settings.control),
        NoActuator() if dry_run else build_sink(settings),
        recorder,
        camera_check,
        ArmGate(fits, safety.slow_below, recorder, camera_check, hold) if arm else None,
        hold,
    )
    mode = DriveMode(arm or dry_run, steering_only, record_commands=not dry_run)
    return DriveLoop(parts, safety, settings.limits, settings.control.speed, mode, watch, show=show)


def build_drive_detector(settings: DriveSettings, camera: Camera | None) -> Detector:
    """Build the detector that the settings name; see :func:`lanenet.perception.registry.build_detector`."""
    chosen = settings.detector
    inputs = DetectorInputs(
        camera=camera,
        model=chosen.model,
        any_camera=chosen.any_camera,
        lane_width_cm=chosen.lane_width_cm,
        # The controller's lane width is the detector's, too.
        drive_lane_width_cm=settings.control.steering.lane_width_cm,
        mask=None if chosen.mask is None else read_mask(chosen.mask),
        config=chosen.config,
    )
    return build_detector(chosen.kind, inputs)


def _fits(settings: DriveSettings, detector: Detector) -> ArmCheck:
    """Say how camera and detector fit; one that does not fit at all is not built."""
    chosen, problems = settings.detector, "; ".join(getattr(detector, "problems", ()))
    text = f"{chosen.kind if chosen.model is None else chosen.model} fits this camera"
    if chosen.any_camera:
        text = f"{chosen.model}: any camera was allowed (detector.any_camera)"
    return ArmCheck("model", True, f"{text}; {problems}" if problems else text)


def build_camera_check(settings: DriveSettings, camera: Camera) -> CameraCheck:
    """Return the comparison of images and camera file."""
    mask = settings.detector.mask
    return CameraCheck(camera, None if mask is None else read_mask(mask))


def build_sink(settings: DriveSettings) -> CommandSink:
    """Return the car's actuator behind its guard, not open yet; one that does nothing if there is none."""
    if settings.actuator is None:
        return NoActuator()
    actuator, safety = settings.actuator, settings.safety
    # Unset values stay unset, since a Donkeycar's myconfig.py may set them.
    text = actuator.model_dump_json(exclude_unset=True)
    return GuardedActuator(
        text,
        lambda: make_actuator(actuator),
        safety.watchdog_s,
        safety.end_after_s,
        first_json=json.dumps(first_writes(actuator)),
    )


def _refuse_blind_drive(settings: DriveSettings) -> None:
    """Keep a car with a motor from driving by a recording."""
    source, has_motor = settings.source, isinstance(settings.actuator, PulseSettings)
    if has_motor and isinstance(source, ReplaySettings) and not source.may_drive:
        raise ConfigError(
            f"key 'source.kind': found 'replay' ({source.path}) for an armed car, which would drive blind; "
            "expected a camera, or source.may_drive=true for a car whose wheels are off the ground"
        )


def _refuse_another_size(settings: DriveSettings, camera: Camera | None) -> None:
    """Keep a camera from sending images of another size than its camera file is for."""
    source = settings.source
    if camera is None or not isinstance(source, CameraSettings):
        return
    if (source.width, source.height) != (camera.width, camera.height):
        raise ConfigError(
            f"found source.width={source.width}, source.height={source.height} and a camera file "
            f"({settings.camera}) of {camera.width}x{camera.height} px: expected one size, or the file "
            "of another camera"
        )


def _recorder(settings: DriveSettings, camera: Camera | None) -> DriveRecorder | None:
    if settings.recording is None:
        return None
    path = new_drive_folder(settings.recording.folder, datetime.now())
    steering = settings.control.steering
    return DriveRecorder(
        path, settings.recording, camera, steering.lane_width_cm, settings.limits.max_steering_rad
    )
