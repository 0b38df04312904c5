"""Lenses in the camera files of other programs: ROS, OpenCV and Kalibr; brought into the form of ROS.

    ROS     the file of camera_calibration, and what ``ros2 topic echo`` and ``rostopic echo`` print
    OpenCV  what ``cv::FileStorage`` writes (YAML, XML, JSON), with the names that its samples and users give
    Kalibr  a camera chain with one camera

None of them says how the camera is mounted above the road.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lanenet.config import parse_yaml
from lanenet.errors import CalibrationError
from lanenet.reading import MEBIBYTE, parsing, read_text

#: OpenCV's sample writes the corners of every photo, too.
_MAX_FILE = 4 * MEBIBYTE
#: Brackets and tags within each other: OpenCV's parsers call themselves for each, and crash. Files have 3.
_MAX_DEPTH = 32
#: Numbers of a matrix that are read; the largest has nine.
_MAX_NUMBERS = 32
#: Names of keys without their underscores and in small letters.
_MATRIX = ("cameramatrix", "k", "mtx", "intrinsicmatrix", "intrinsics", "m")
_DISTORTION = (
    *("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "dist", "distortion", "d"),
)
#: The last is that of the usual tutorials of OpenCV's fisheye in Python.
_SIZE = ("resolution", "imagesize", "imgsize", "size", "dim")
#: What others call the two lens models that ROS calls plumb_bob and equidistant.
_MODELS = {
    **dict.fromkeys(("plumb_bob", "rational_polynomial", "radtan", "none", ""), "plumb_bob"),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt", "equi"), "equidistant"),
}
#: Coefficients of a pinhole; further ones have to be zero, as those of the rational model often are. And of a
#: fisheye, which OpenCV's older pinholes have, too.
_PINHOLE_COUNT, _FISHEYE_COUNT = 5, 4


@dataclass(frozen=True)
class ForeignLens:
    """A lens in another program's file.

    Attributes:
        program: Whose file it is.
        info: The lens as ROS's ``camera_info`` file holds it, not yet checked.
    """

    program: str
    info: dict[str, Any]


def foreign_lens(path: Path) -> ForeignLens | None:
    """Read the lens in a camera file of another program; None for a file that is not known as one.

    Raises:
        CalibrationError: If the file cannot be read, holds several cameras, or a lens model or a region of
            the image that lanenet does not have.
    """
    text = read_text(path, CalibrationError, _MAX_FILE)
    if text.startswith("# oST version"):
        raise CalibrationError(
            f"{path}: is ROS's ost.txt; give the ost.yaml that camera_calibration wrote beside it"
        )
    is_storage = text.lstrip().startswith(("<?xml", "<opencv", "%YAML", "{")) or "!!opencv-" in text
    data = _storage(path, text) if is_storage else _first_document(path, text)
    if not isinstance(data, dict) or str(data.get("format", "")).startswith("lanenet") or "mounting" in data:
        return None
    program = "OpenCV"
    if cameras := [key for key, value in data.items() if isinstance(value, dict) and "intrinsics" in value]:
        if len(cameras) > 1:
            raise CalibrationError(
                f"{path}: holds {len(cameras)} cameras ({', '.join(map(str, cameras))}), expected one: "
                "delete those that do not look ahead"
            )
        program, data = "Kalibr", data[cameras[0]]
    plain = {re.sub("[^a-z0-9]", "", str(key).lower()): value for key, value in data.items()}
    if {"m1", "m2"} <= set(plain) or {"k1", "k2"} <= set(plain) - {"d"} or {"cameramatrix1"} <= set(plain):
        raise CalibrationError(f"{path}: holds the cameras of a stereo pair, expected one")
    matrix = _first(plain, _MATRIX)
    if matrix is None:
        if is_storage or _first(plain, _DISTORTION) is not None:
            found = ", ".join(map(str, data))[:200]
            raise CalibrationError(
                f"{path}: holds no camera matrix under a known name (found {found}); expected image_width, "
                "image_height, camera_matrix and distortion_coefficients: rename the keys"
            )
        return None
    if program == "OpenCV" and not is_storage and "distortionmodel" in plain:
        program = "ROS"
    _refuse_part(path, plain)
    width, height = _size(plain)
    if width is None or height is None:
        raise CalibrationError(
            f"{path}: has no size of the images; add image_width and image_height, in pixels"
        )
    model = _model(plain)
    distortion = _as_distortion(path, _first(plain, _DISTORTION), model)
    if not {"distortionmodel", "fisheyemodel"} & set(plain) and distortion["cols"] == _FISHEYE_COUNT:
        raise CalibrationError(
            f"{path}: four coefficients are those of a fisheye or of a pinhole, expected the key "
            "fisheye_model with 1 or 0; add it"
        )
    info = {
        **{"image_width": width, "image_height": height, "distortion_model": model},
        "camera_matrix": _as_matrix(path, "camera_matrix", matrix, (3, 3)),
        "distortion_coefficients": distortion,
    }
    # What is not there is missing, not empty.
    return ForeignLens(program, {key: value for key, value in info.items() if value is not None})


def _first_document(path: Path, text: str) -> Any:
    """Return the first of the documents that a topic printed."""
    parts = [part for part in re.split(r"^---[ \t]*$", text, flags=re.MULTILINE) if part.strip()]
    return parse_yaml(parts[0] if parts else "", path, CalibrationError)


def _storage(path: Path, text: str) -> dict[str, Any]:
    """Return the values of a file of ``cv::FileStorage``."""
    import cv2

    text = text.lstrip()
    if not text.startswith(("<", "%YAML", "{")):
        text = f"%YAML:1.0\n---\n{text.removeprefix('---')}"
    depth = 0
    for opened in re.finditer(r"([\[{]|<[A-Za-z_])|[\]}]|</", text):
        depth += 1 if opened[1] else -1
        if depth > _MAX_DEPTH:
            raise CalibrationError(f"{path}: nested too deeply")
    try:
        with parsing(f"{path}: not a readable file of OpenCV", CalibrationError):
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            root = storage.root()
            return {key: _plain(root.getNode(key)) for key in root.keys()}  # noqa: SIM118
    except (cv2.error, SystemError) as error:
        raise CalibrationError(f"{path}: not a readable file of OpenCV") from error


def _plain(node: Any, depth: int = 0) -> Any:
    """Return a node's value; matrices as maps, since OpenCV makes room for whatever size they claim."""
    if node.isMap() and depth < 3:
        return {key: _plain(node.getNode(key), depth + 1) for key in node.keys()}  # noqa: SIM118
    if node.isSeq() and depth < 3:
        return [_plain(node.at(k), depth + 1) for k in range(min(node.size(), _MAX_NUMBERS))]
    if node.isInt() or node.isReal():
        return int(node.real()) if node.isInt() else float(node.real())
    return node.string() if node.isString() else None


def _first(plain: dict[str, Any], names: tuple[str, ...]) -> Any:
    return next((plain[name] for name in names if plain.get(name) is not None), None)


def _size(plain: dict[str, Any]) -> tuple[Any, Any]:
    size = _first(plain, _SIZE)
    if isinstance(size, list) and len(size) == 2:
        return size[0], size[1]
    return _first(plain, ("imagewidth", "width")), _first(plain, ("imageheight", "height"))


def _model(plain: dict[str, Any]) -> str:
    if plain.get("cameramodel") not in (None, "pinhole") and "intrinsics" in plain:
        return str(plain["cameramodel"])
    name = plain.get("distortionmodel")
    if name is None:
        name = "equidistant" if plain.get("fisheyemodel") else "plumb_bob"
    return _MODELS.get(str(name).lower(), str(name))


def _refuse_part(path: Path, plain: dict[str, Any]) -> None:
    """Refuse a matrix of a larger image than those that the camera gives."""
    roi = plain.get("roi")
    moved = isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset"))
    if moved or any(plain.get(key) not in (None, 0, 1) for key in ("binningx", "binningy")):
        raise CalibrationError(
            f"{path}: the images are binned or a part of the sensor, expected a calibration of the images as "
            "they come"
        )


def _as_matrix(path: Path, key: str, value: Any, shape: tuple[int, int]) -> Any:
    """Return a matrix as ROS writes it, from a map, a flat list, rows, or Kalibr's four numbers."""
    if isinstance(value, dict):
        return {name: value.get(name) for name in ("rows", "cols", "data")}
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        value = [number for row in value for number in row]
    if isinstance(value, list) and shape == (3, 3) and len(value) == 4:
        fx, fy, cx, cy = value
        value = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    if not isinstance(value, list):
        raise CalibrationError(f"{path}: key {key!r}: expected numbers, found {str(value)[:40]!r}")
    rows, cols = shape if len(value) == shape[0] * shape[1] else (1, len(value))
    return {"rows": rows, "cols": cols, "data": value}


def _as_distortion(path: Path, value: Any, model: str) -> Any:
    """Return the coefficients as ROS writes them, without zeros behind those that the model has."""
    count = _PINHOLE_COUNT if model == "plumb_bob" else _FISHEYE_COUNT
    matrix = _as_matrix(path, "distortion_coefficients", [] if value is None else value, (1, 0))
    numbers = matrix["data"]
    # A map that contradicts itself is told by its check.
    if not isinstance(numbers, list) or (matrix["rows"], matrix["cols"]) not in (
        *((1, len(numbers)), (len(numbers), 1)),
    ):
        return matrix
    if model != "plumb_bob":
        return {"rows": 1, "cols": len(numbers) or count, "data": numbers or [0.0] * count}
    if any(numbers[count:]):
        raise CalibrationError(
            f"{path}: key 'distortion_coefficients': {len(numbers)} numbers that are not zero, expected "
            f"{count}; calibrate again without the rational model"
        )
    numbers = numbers[:count] or [0.0] * count
    return {"rows": 1, "cols": len(numbers), "data": numbers}
