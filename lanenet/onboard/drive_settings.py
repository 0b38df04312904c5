"""Settings of ``lanenet drive``: what is on the car, how it drives, and when it stops."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from lanenet.config import Settings, apply_overrides, check_settings, read_yaml
from lanenet.control.controller import ControlSettings
from lanenet.data.camera_file import read_camera
from lanenet.data.drives.recorder import RecordingSettings
from lanenet.onboard.actuators import ActuatorSettings
from lanenet.onboard.cameras import SourceSettings
from lanenet.onboard.safety import LimitSettings, SafetySettings
from lanenet.perception.registry import KINDS


def _known_detector(name: str) -> str:
    if name not in KINDS:
        raise PydanticCustomError("detector", f"expected one of {', '.join(KINDS)}")
    return name


class DriveDetectorSettings(Settings):
    """What finds the lane.

    Attributes:
        kind: As in ``lanenet detect --detector``.
        model: ONNX file or checkpoint folder of the network.
        config: Settings file of the other detectors.
        mask: PNG that shows the car itself; what lies there is left out.
        any_camera: Use a network with another camera than it was trained with.
        lane_width_cm: Between the middles of the two lines, for the lane filter.
    """

    kind: Annotated[str, AfterValidator(_known_detector)] = "network"
    model: Path | None = None
    config: Path | None = None
    mask: Path | None = None
    any_camera: bool = False
    lane_width_cm: float | None = Field(default=None, gt=0.0)


class DriveSettings(Settings):
    """Everything that ``lanenet drive`` needs.

    Attributes:
        source: Camera, or a recording that plays one.
        camera: Camera file; without it only detectors that know no centimetres can be used.
        detector: What finds the lane.
        control: Steering and speed; its wheelbase is the camera file's where it is left out.
        limits: What no command exceeds.
        safety: When the car slows down, stops and gives up.
        actuator: Servo and motor; None for a dry run.
        recording: Record the drive; None does not.
        threads: Threads of OpenCV; the network takes one.
    """

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
    """Read a car's settings; the wheelbase is the camera file's where they leave it out.

    Raises:
        ConfigError: Naming the file, the key, what was found and what was expected.
        CalibrationError: If the camera file is needed and cannot be used.
    """
    data = apply_overrides(read_yaml(path), overrides or [])
    return check_settings(DriveSettings, _with_wheelbase(data), str(path))


def _with_wheelbase(data: dict[str, Any]) -> dict[str, Any]:
    control, camera = data.get("control", {}), data.get("camera")
    steering = control.get("steering", {}) if isinstance(control, dict) else None
    # What is of another type is left for the check, which can name it.
    if not isinstance(steering, dict) or not isinstance(camera, str) or "wheelbase_cm" in steering:
        return data
    wheelbase_cm = read_camera(Path(camera)).wheelbase_cm
    return {**data, "control": {**control, "steering": {**steering, "wheelbase_cm": wheelbase_cm}}}
