"""Checks of a whole car: camera, model, actuator, and the computer's own state."""

from __future__ import annotations

import re
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lanenet.data.camera_file import read_camera
from lanenet.errors import LanenetError, counted
from lanenet.geometry.camera import Camera
from lanenet.onboard.actuators import make_actuator
from lanenet.onboard.actuators.myconfig import with_myconfig
from lanenet.onboard.actuators.pca9685 import PCA9685Settings
from lanenet.onboard.actuators.pulses import PulseSettings, neutral_pulses
from lanenet.onboard.actuators.recorder import RecorderSettings
from lanenet.onboard.cameras import open_source
from lanenet.onboard.devices import Frame, FrameSource, SourceEnded
from lanenet.onboard.doctor.installation import Check, State, check_camera_file
from lanenet.onboard.drive import DriveSettings, build_camera_check, build_drive_detector
from lanenet.perception.camera_check import GROSS_RAD, CameraCheck
from lanenet.perception.estimate import Detector

#: The camera is watched for this long: at 20 frames/s, 40 frames.
_WATCH_S = 2.0
#: Frames that are compared with the camera file; chosen: over the two seconds, four a second.
_COMPARED = 8
#: Below this share of the requested rate something is wrong; chosen: more than jitter takes.
_LEAST_RATE_SHARE = 0.8
#: A Raspberry Pi lowers its clock from 80 degrees Celsius on; warn 10 degrees earlier.
_HOT_C, _WARM_C = 80.0, 70.0
#: The delay from exposure above which a note is shown: two frames of a 30 Hz camera.
_LATE_MS = 60.0
#: Mean brightness outside this range: a covered lens, or an overexposed image.
_DARK, _BRIGHT = 20.0, 235.0
_THERMAL_ZONE = Path("/sys/class/thermal/thermal_zone0/temp")
#: Bits of ``vcgencmd get_throttled``; 16 bits higher: it has happened since boot.
_THROTTLE_BITS = {
    0: "the supply's voltage is too low",
    1: "the processor's clock is capped",
    2: "the processor is throttled",
    3: "the processor is near its limit of temperature",
}


def check_car(settings: DriveSettings) -> list[Check]:
    """Check the devices of a car's file; opens the camera and the actuator for a moment.

    The actuator goes to neutral, which may straighten the wheels; the motor does not turn.

    Args:
        settings: The car's settings.

    Returns:
        All checks in the order of the report; problems are checks, not errors.
    """
    checks = [] if settings.camera is None else check_camera_file(settings.camera)
    camera = None
    if settings.camera is not None and checks[0].state != "problem":
        camera = read_camera(settings.camera)
    rate_hz = getattr(settings.source, "rate_hz", None)
    seen, frames = check_source(open_source(settings.source), rate_hz, camera)
    checks += seen
    found, detector = _detector(settings, camera)
    checks.append(found)
    if camera is not None and detector is not None and _fit(frames, camera):
        comparison = build_camera_check(settings, camera)
        checks.append(check_calibration(comparison, detector, frames, settings.safety.slow_below))
    checks.append(_actuator(settings))
    return [*checks, check_temperature(), check_throttling()]


def check_source(
    source: FrameSource, rate_hz: float | None, camera: Camera | None
) -> tuple[list[Check], list[Frame]]:
    """Watch a camera for two seconds.

    Args:
        source: Not open yet; it is closed again.
        rate_hz: Requested frames per second; None if none were requested.
        camera: Camera whose size the images must have; None for no check.

    Returns:
        The checks, and the frames.
    """
    try:
        source.open()
        frames, arrived_s = _watch(source)
    except LanenetError as error:
        return [Check("camera", "problem", str(error))], []
    finally:
        source.close()
    if len(frames) < 2:
        text = f"{counted(len(frames), 'frame')} in {_WATCH_S:g} s, expected a stream"
        return [Check("camera", "problem", text)], frames
    height, width = frames[-1].image_bgr.shape[:2]
    checks = [_rate(frames, rate_hz)]
    if camera is not None and (camera.width, camera.height) != (width, height):
        text = f"images of {width}x{height} px, but the camera file is for {camera.width}x{camera.height}"
        checks.append(Check("image size", "problem", f"{text}: set width and height, or calibrate again"))
    else:
        checks.append(Check("image size", "ok", f"{width}x{height} px"))
    checks.append(_delay(frames, arrived_s))
    brightness = float(np.mean([f.image_bgr.mean() for f in frames[-5:]]))
    if not _DARK <= brightness <= _BRIGHT:
        text = f"mean brightness {brightness:.0f} of 255: is the lens covered, the room dark?"
        checks.append(Check("image", "note", text))
    return checks, frames


def check_calibration(
    comparison: CameraCheck, detector: Detector, frames: Sequence[Frame], least_confidence: float
) -> Check:
    """Compare the lines in some frames with the camera file.

    Args:
        comparison: Of the camera file.
        detector: Says in which frames there is a lane; others show nothing.
        frames: Of the camera, of its size.
        least_confidence: Of the lane.
    """
    name = "calibration"
    images = [frame.image_bgr for frame in frames[:: max(1, len(frames) // _COMPARED)]]
    seen = [image for image in images if detector.detect(image).confidence >= least_confidence]
    off_rad = [pitch for pitch in (comparison.view(image)[0] for image in seen) if np.isfinite(pitch)]
    if not off_rad:
        looked = counted(len(images), "frame")
        text = f"not compared: no lane with two lines in {looked}; stand the car in its lane"
        return Check(name, "note", text)
    median_rad = float(np.median(off_rad))
    text = f"the lines look as if the pitch were {np.rad2deg(abs(median_rad)):.1f} degrees off"
    if abs(median_rad) >= GROSS_RAD:
        return Check(name, "problem", f"{text}: has the camera moved since, is it upside down?")
    return Check(name, "ok", f"{text}, in {counted(len(off_rad), 'view')}; one place may show some degrees")


def check_temperature(sensor: Path = _THERMAL_ZONE) -> Check:
    """Read the processor's temperature."""
    try:
        degrees_c = 1e-3 * float(sensor.read_text())
    except (OSError, ValueError):
        return Check("temperature", "note", f"{sensor}: cannot be read")
    text = f"{degrees_c:.0f} degrees Celsius"
    if degrees_c >= _HOT_C:
        return Check("temperature", "problem", f"{text}: the processor slows down; give it a cooler")
    if degrees_c >= _WARM_C:
        return Check("temperature", "note", f"{text}: it slows down from 80 on")
    return Check("temperature", "ok", text)


def check_throttling(ask: Callable[[], str] | None = None) -> Check:
    """Check a Raspberry Pi's record of undervoltage and throttling.

    Args:
        ask: Returns the output of ``vcgencmd get_throttled``; None runs it.
    """
    if ask is None:
        if shutil.which("vcgencmd") is None:
            return Check("throttling", "note", "vcgencmd is not here: not a Raspberry Pi?")
        ask = _vcgencmd
    said = ask()
    match = re.search(r"throttled=0x([0-9a-fA-F]+)", said)
    if match is None:
        return Check("throttling", "note", f"vcgencmd get_throttled says {said.strip()!r}")
    bits = int(match[1], 16)
    now = [text for bit, text in _THROTTLE_BITS.items() if bits >> bit & 1]
    before = [text for bit, text in _THROTTLE_BITS.items() if bits >> (bit + 16) & 1]
    if now:
        hint = "; use a supply of 5 V and at least 3 A, apart from the motor's" if bits & 1 else ""
        return Check("throttling", "problem", f"{' and '.join(now)}{hint}")
    if before:
        return Check("throttling", "note", f"since boot it happened that {' and '.join(before)}")
    return Check("throttling", "ok", "no undervoltage and no throttling since boot")


def _watch(source: FrameSource) -> tuple[list[Frame], list[float]]:
    frames, arrived_s = [], []
    end_s = time.monotonic() + _WATCH_S
    while (left_s := end_s - time.monotonic()) > 0.0:
        try:
            frame = source.read(min(left_s, 0.2))
        except SourceEnded:
            break
        if frame is not None:
            frames.append(frame)
            arrived_s.append(time.monotonic())
    return frames, arrived_s


def _rate(frames: list[Frame], wanted_hz: float | None) -> Check:
    steps_s = np.diff([f.t_s for f in frames])
    found_hz = (frames[-1].number - frames[0].number) / max(frames[-1].t_s - frames[0].t_s, 1e-9)
    text = f"{found_hz:.1f} frames per second, longest pause {1e3 * steps_s.max():.0f} ms"
    if wanted_hz is not None and found_hz < _LEAST_RATE_SHARE * wanted_hz:
        text += (
            f": {wanted_hz:g} were requested; a dark room lengthens the exposure, a large image costs time"
        )
        return Check("camera", "problem", text)
    return Check("camera", "ok", text)


def _delay(frames: list[Frame], arrived_s: list[float]) -> Check:
    if not all(frame.age_known for frame in frames):
        text = "age of the frames unknown: measure it with lanenet doctor --config CAR.yaml --camera-delay"
        return Check("delay", "note", text)
    late_ms = 1e3 * float(np.median([a - f.t_s for f, a in zip(frames, arrived_s, strict=True)]))
    state: State = "note" if late_ms > _LATE_MS else "ok"
    return Check("delay", state, f"{late_ms:.0f} ms from exposure, by the driver or source.delay_s, to here")


def _fit(frames: Sequence[Frame], camera: Camera) -> bool:
    return bool(frames) and frames[-1].image_bgr.shape[:2] == (camera.height, camera.width)


def _detector(settings: DriveSettings, camera: Camera | None) -> tuple[Check, Detector | None]:
    name = f"detector {settings.detector.kind}"
    try:
        detector = build_drive_detector(settings, camera)
    except LanenetError as error:
        return Check(name, "problem", str(error)), None
    if problems := getattr(detector, "problems", ()):
        return Check(name, "note", "; ".join(problems)), detector
    model = settings.detector.model
    return Check(name, "ok", f"{model} fits this camera" if model is not None else "ready"), detector


def _actuator(settings: DriveSettings) -> Check:
    if settings.actuator is None:
        return Check("actuator", "note", "none in this file: only dry runs")
    name = f"actuator {settings.actuator.kind}"
    try:
        actuator = make_actuator(settings.actuator)
    except LanenetError as error:
        return Check(name, "problem", str(error))
    try:
        actuator.open()
    except LanenetError as error:
        return Check(name, "problem", str(error))
    finally:
        left = actuator.neutral()
        actuator.close()
    if left is None or left.confirmed is False:
        return Check(name, "problem", "no answer" if left is None else left.may_run)
    pulses = "" if isinstance(settings.actuator, RecorderSettings) else f": {_neutral_of(settings.actuator)}"
    return Check(name, "ok", f"answers: {left.text}{pulses}")


def _neutral_of(actuator: PulseSettings) -> str:
    """Say which pulses neutral is made of; whether the speed controller knows them, nobody has checked."""
    if isinstance(actuator, PCA9685Settings):
        actuator = with_myconfig(actuator)
        channels = f"channel {actuator.throttle_channel}", f"channel {actuator.steering_channel}"
    else:
        channels = "the motor's output", "the steering's"
    pulses = neutral_pulses(actuator)
    return f"{pulses.throttle_us:g} us on {channels[0]}, {pulses.steering_us:g} us on {channels[1]}"


def _vcgencmd() -> str:
    done = subprocess.run(["vcgencmd", "get_throttled"], capture_output=True, text=True, timeout=5.0)
    return done.stdout + done.stderr
