"""Checks of an installation and of a camera file, each with what to do about a problem."""

from __future__ import annotations

import platform
import re
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np

from lanenet.data.camera_file import read_camera
from lanenet.errors import LanenetError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM
from lanenet.onboard.cameras import jpeg
from lanenet.perception.edges import compiled
from lanenet.perception.edges.road import RangeSettings, RoadTable
from lanenet.perception.network import compiled as network_compiled

State = Literal["ok", "note", "problem"]

#: y = -x in ONNX (IR 7, opset 13): tests the runtime without the onnx package, which a car does not have.
_NEGATE_ONNX = bytes.fromhex(
    "080712003a320a0b0a017812017922034e65671201675a0f0a0178120a0a08080112040a020801620f0a0179120a0a0808011204"
    "0a02080142040a00100d"
)
_OPENCV_PACKAGES = (
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)


@dataclass(frozen=True)
class Check:
    """One line of the report.

    Attributes:
        name: What was checked.
        state: ``problem`` keeps something from working; ``note`` is worth knowing.
        text: What was found, and what to do about a problem.
    """

    name: str
    state: State
    text: str


def run_checks(camera: Path | None = None) -> list[Check]:
    """Check the installation, and a camera file if one is given.

    Args:
        camera: Camera YAML to check.

    Returns:
        All checks in the order of the report; problems are checks, not errors.
    """
    checks = [_python(), *_packages(), _opencv_packages(), _opencv(), _jpeg(), _kernels(), _onnxruntime()]
    if camera is not None:
        checks += check_camera_file(camera)
    return checks


def check_camera_file(path: Path) -> list[Check]:
    """Check that a camera file can be read and that its camera sees the road at the label rows."""
    try:
        camera = read_camera(path)
    except LanenetError as error:
        return [Check("camera file", "problem", str(error))]
    name = f"{camera.model} {camera.width}x{camera.height}, hash {camera.hash}"
    return [Check("camera file", "ok", f"{path}: {name}"), *check_camera(camera)]


def check_camera(camera: Camera) -> list[Check]:
    """Check that a camera is plausible for a 1:10 car and sees the road at the label rows."""
    checks = []
    pose = camera.mounting
    if not 3.0 <= pose.height_cm <= 100.0:
        checks.append(
            Check("height", "problem", f"{pose.height_cm:g} cm: 3 to 100 cm expected; is it in centimetres?")
        )
    for angle_rad, what, limit_deg in (
        (pose.pitch_down_rad, "pitch down", 80.0),
        (pose.roll_rad, "roll", 15.0),
        (pose.yaw_rad, "yaw", 15.0),
    ):
        degrees = float(np.rad2deg(angle_rad))
        low_deg = -10.0 if what == "pitch down" else -limit_deg
        if not low_deg <= degrees <= limit_deg:
            text = f"{degrees:.1f} degrees: {low_deg:g} to {limit_deg:g} expected; is it in radians?"
            checks.append(Check(what, "problem", text))
    centre = camera.K[0, 2] / camera.width, camera.K[1, 2] / camera.height
    if not all(0.25 <= c <= 0.75 for c in centre):
        text = f"at {centre[0]:.2f} of the width and {centre[1]:.2f} of the height: far from the middle"
        checks.append(Check("principal point", "problem", text + "; is the file for another image size?"))
    try:
        table = RoadTable(camera, RangeSettings())
    except LanenetError as error:
        return [*checks, Check("road", "problem", str(error))]
    seen = [row for row in ROWS_CM if _sees(camera, row)]
    share = float(np.mean(table.keep > 0))
    if not any(row > 0.0 for row in seen):
        text = "no label row (y = 15, 30 cm) lies inside the image; check pitch, height and position"
        return [*checks, Check("road", "problem", text)]
    rows = ", ".join(f"{row:g}" for row in seen)
    text = f"{100.0 * share:.0f} % of the pixels see the road in range; straight ahead at y = {rows} cm"
    return [*checks, Check("road", "ok", text)]


def _sees(camera: Camera, y_cm: float) -> bool:
    return bool(camera.shows_ground(np.array([[0.0, y_cm]]))[0])


def _python() -> Check:
    found = f"Python {platform.python_version()} on {platform.machine()}, {platform.system()}"
    if sys.maxsize < 2**32:
        return Check("python", "problem", f"{found}: a 64-bit system is needed for the wheels")
    return Check("python", "ok", found)


def _packages() -> list[Check]:
    """Return the versions of the base packages, and which extras are complete."""
    try:
        lines = metadata.requires("lanenet") or []
        version = metadata.version("lanenet")
    except metadata.PackageNotFoundError:
        return [Check("lanenet", "note", "runs from a folder, not installed: pip install -e .")]
    needed: dict[str, list[str]] = {}
    for line in lines:
        extra = re.search(r"extra\s*==\s*['\"](\w+)['\"]", line)
        name = re.match(r"[A-Za-z0-9_.-]+", line)
        if name is not None and name.group() != "lanenet":
            needed.setdefault(extra.group(1) if extra else "", []).append(name.group())
    checks = [Check("lanenet", "ok", version)]
    for extra_name, names in needed.items():
        versions = {name: _version(name) for name in names}
        missing = [name for name, found in versions.items() if found is None]
        label = f"extra {extra_name}" if extra_name else "packages"
        if not missing:
            text = ", ".join(f"{name} {found}" for name, found in versions.items())
            checks.append(Check(label, "ok", text))
        elif extra_name:
            text = f"without {', '.join(missing)}: pip install 'lanenet[{extra_name}]' if you need it"
            checks.append(Check(label, "note", text))
        else:
            checks.append(Check(label, "problem", f"{', '.join(missing)} not installed: pip install lanenet"))
    return checks


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _opencv_packages() -> Check:
    found = [name for name in _OPENCV_PACKAGES if _version(name) is not None]
    if len(found) > 1:
        text = f"{' and '.join(found)} overwrite each other's files: uninstall all but one, then reinstall it"
        return Check("opencv package", "note", text)
    return Check("opencv package", "ok", found[0] if found else "from the system")


def _opencv() -> Check:
    """Test OpenCV: find the edge of a drawn step, and encode and decode a JPEG."""
    try:
        import cv2

        step = np.zeros((32, 32), np.uint8)
        step[:, 16:] = 200
        edges = cv2.Canny(step, 40.0, 100.0)
        columns = np.unique(np.nonzero(edges)[1])
        encoded, data = cv2.imencode(".jpg", step)
        back = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if encoded else None
    except Exception as error:
        return Check("opencv", "problem", f"self test failed ({error}): pip install opencv-python-headless")
    if columns.size != 1 or abs(int(columns[0]) - 15.5) > 1.0 or back is None or back.shape != step.shape:
        return Check("opencv", "problem", f"{cv2.__version__}: self test gave a wrong answer; reinstall it")
    return Check("opencv", "ok", f"{cv2.__version__}, edges and JPEG work")


def _jpeg() -> Check:
    """Test the decoder of camera images with one that lost bytes in its middle."""
    if not jpeg.is_strict():
        text = (
            "cannot be loaded: of images that lost bytes fewer are refused; pip install --force-reinstall it"
        )
        return Check("simplejpeg", "note", text)
    try:
        import cv2

        noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8)
        whole = cv2.imencode(".jpg", noise)[1].tobytes()
        middle = len(whole) // 2
        cut = whole[:middle] + whole[middle + 500 :]
        works = jpeg.decode_jpeg(whole) is not None and jpeg.decode_jpeg(cut) is None
    except Exception as error:
        return Check("simplejpeg", "problem", f"self test failed ({error}): reinstall it")
    if not works:
        return Check("simplejpeg", "problem", "self test gave a wrong answer: reinstall it")
    return Check("simplejpeg", "ok", "images that lost bytes are refused")


def _kernels() -> Check:
    if not (compiled.is_here() and network_compiled.is_here()):
        text = "not here: the same answers, slower; install g++ and the headers of Python, then lanenet again"
        return Check("compiled loops", "note", text)
    return Check("compiled loops", "ok", "for edges and lines")


def _onnxruntime() -> Check:
    """Test onnxruntime: negate a number with a model of one node."""
    try:
        import onnxruntime

        session = onnxruntime.InferenceSession(_NEGATE_ONNX, providers=["CPUExecutionProvider"])
        answer = session.run(None, {"x": np.array([1.5], np.float32)})[0]
    except Exception as error:
        return Check("onnxruntime", "problem", f"self test failed ({error}): pip install onnxruntime")
    if float(answer[0]) != -1.5:
        return Check("onnxruntime", "problem", f"{onnxruntime.__version__}: -(1.5) gave {answer[0]}")
    return Check("onnxruntime", "ok", f"{onnxruntime.__version__}, a model of one node runs")
