"""Puts a car together from its settings."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

import cv2

from lanenet.control.controller import LaneController
from lanenet.data.camera_file import read_camera
from lanenet.data.drives.recorder import DriveRecorder, new_drive_folder
from lanenet.data.sources import read_mask
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera
from lanenet.onboard.actuators import make_actuator
from lanenet.onboard.actuators.pulses import PulseSettings
from lanenet.onboard.cameras import open_source
from lanenet.onboard.cameras.replay import ReplaySettings
from lanenet.onboard.drive_report import Step
from lanenet.onboard.drive_settings import DriveSettings
from lanenet.onboard.guard import CommandSink, GuardedActuator, NoActuator
from lanenet.onboard.loop import DriveLoop
from lanenet.onboard.safety import CommandLimiter
from lanenet.perception.detector_kind import DetectorInputs
from lanenet.perception.estimate import Detector
from lanenet.perception.registry import build_detector

#: Longer than any rehearsal: a dry run stops for a fault, and does not end for it.
_NEVER_S = 1e9


def build_loop(
    settings: DriveSettings,
    *,
    arm: bool = False,
    steering_only: bool = False,
    dry_run: bool = False,
    watch: Callable[[Step], None] | None = None,
) -> DriveLoop:
    """Put a car together; devices are opened when the loop runs, a recording's folder is made here.

    Args:
        settings: Of the car.
        arm: Let the motor turn, after the countdown.
        steering_only: Move the wheels and not the motor.
        dry_run: Nothing is sent to any actuator; what would be sent is that of an armed car.
        watch: Called after every turn of the loop.

    Raises:
        ConfigError: If the options contradict each other, the car has no actuator and this is no dry run, or
            an armed car would drive by a recording.
        LanenetError: If camera file, model, mask or the recording's folder cannot be used.
    """
    if arm + steering_only + dry_run > 1:
        raise ConfigError("expected one of --arm, --steering-only and --dry-run, found several")
    if settings.actuator is None and not dry_run:
        raise ConfigError("key 'actuator' is missing: expected one, or --dry-run")
    if arm:
        _refuse_blind_drive(settings)
    cv2.setNumThreads(settings.threads)
    camera = None if settings.camera is None else read_camera(settings.camera)
    safety = settings.safety
    if dry_run:
        safety = safety.model_copy(update={"countdown_s": 0.0, "end_after_s": _NEVER_S})
    return DriveLoop(
        open_source(settings.source),
        build_drive_detector(settings, camera),
        LaneController(settings.control),
        NoActuator() if dry_run else build_sink(settings),
        safety,
        CommandLimiter(settings.limits),
        settings.control.speed,
        armed=arm or dry_run,
        steering_only=steering_only,
        recorder=_recorder(settings, camera),
        # Whoever drives the car during a dry run, it is not these commands.
        record_commands=not dry_run,
        watch=watch,
    )


def build_drive_detector(settings: DriveSettings, camera: Camera | None) -> Detector:
    """Build the detector that the settings name; see :func:`lanenet.perception.registry.build_detector`."""
    chosen = settings.detector
    inputs = DetectorInputs(
        camera=camera,
        model=chosen.model,
        any_camera=chosen.any_camera,
        lane_width_cm=chosen.lane_width_cm,
        # The controller's lane width counts for the detector as well.
        drive_lane_width_cm=settings.control.steering.lane_width_cm,
        mask=None if chosen.mask is None else read_mask(chosen.mask),
        config=chosen.config,
    )
    return build_detector(chosen.kind, inputs)


def build_sink(settings: DriveSettings) -> CommandSink:
    """Return the car's actuator behind its guard, not open yet; one that does nothing where there is none."""
    if settings.actuator is None:
        return NoActuator()
    actuator, safety = settings.actuator, settings.safety
    # What was left out has to stay so: there a Donkeycar's myconfig.py may have a say.
    text = actuator.model_dump_json(exclude_unset=True)
    return GuardedActuator(text, lambda: make_actuator(actuator), safety.watchdog_s, safety.end_after_s)


def _refuse_blind_drive(settings: DriveSettings) -> None:
    """Keep a car with a motor from driving by what another drive saw."""
    source, has_motor = settings.source, isinstance(settings.actuator, PulseSettings)
    if has_motor and isinstance(source, ReplaySettings) and not source.may_drive:
        raise ConfigError(
            f"key 'source.kind': found 'replay' ({source.path}) for an armed car, which would drive blind; "
            "expected a camera, or source.may_drive=true for a car whose wheels are off the ground"
        )


def _recorder(settings: DriveSettings, camera: Camera | None) -> DriveRecorder | None:
    if settings.recording is None:
        return None
    path = new_drive_folder(settings.recording.folder, datetime.now())
    steering = settings.control.steering
    return DriveRecorder(
        path, settings.recording, camera, steering.lane_width_cm, settings.limits.max_steering_rad
    )
