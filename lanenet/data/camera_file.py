"""Camera files: lanenet's own YAML and ROS ``camera_info`` YAML, read and written; lenses of others, read."""

from __future__ import annotations

import datetime
import logging
import math
import shlex
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import ConfigDict, Field, field_validator

from lanenet.config import Settings, SettingsT, check_settings, read_yaml
from lanenet.data.files import write_text
from lanenet.data.lens_file import foreign_lens
from lanenet.errors import CalibrationError, ConfigError
from lanenet.geometry.camera import Camera, CameraModel, Mounting
from lanenet.reading import is_folder, is_regular, parsing, read_json

_log = logging.getLogger(__name__)

#: Name of the camera file in the folder of a map.
MAP_CAMERA_NAME = "camera.yaml"

#: Bounds of what a file may hold. Chosen: ten metres, since no car is larger; a right angle, beyond which a
#: camera sees no road ahead and a number is one of degrees; and numbers of lenses whose powers stay finite.
_MAX_CM, _MAX_RAD, _MAX_PX, _MAX_COEFFICIENT = 1000.0, 0.5 * math.pi, 1e6, 1e4
#: Lowest camera; chosen: below that, a lens lies on the road. And the least focal length as a share of the
#: image's side; chosen: half of that of a fisheye whose image circle of 220 degrees fills half of the side.
_LEAST_HEIGHT_CM, _LEAST_FOCAL = 1.0, 0.06
#: Pixels along a side; the largest sensors have fewer.
_MAX_SIDE_PX = 2**14

Number = Annotated[float, Field(ge=-_MAX_PX, le=_MAX_PX)]
Coefficient = Annotated[float, Field(ge=-_MAX_COEFFICIENT, le=_MAX_COEFFICIENT)]
Row = tuple[Number, Number, Number]
Length = Annotated[float, Field(gt=0.0, le=_MAX_CM)]
Place = Annotated[float, Field(ge=-_MAX_CM, le=_MAX_CM)]
#: Radians.
Angle = Annotated[float, Field(gt=-_MAX_RAD, lt=_MAX_RAD)]
Side = Annotated[int, Field(gt=0, le=_MAX_SIDE_PX)]

_D_LENGTHS: dict[str, tuple[int, ...]] = {"fisheye": (4,), "pinhole": (4, 5)}
_ROS_MODELS: dict[str, CameraModel] = {"plumb_bob": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}


class MountingFile(Settings):
    """The mounting as a camera file holds it; see :class:`lanenet.geometry.camera.Mounting`."""

    height_cm: Annotated[float, Field(ge=_LEAST_HEIGHT_CM, le=_MAX_CM)]
    pitch_down_rad: Angle = 0.0
    roll_rad: Angle = 0.0
    yaw_rad: Angle = 0.0
    ahead_of_front_axle_cm: Place = 0.0
    right_of_centre_cm: Place = 0.0


class CarFile(Settings):
    """The car in a camera file."""

    wheelbase_cm: Length


class CameraFile(Settings):
    """A camera file.

    Attributes:
        format: Kind of file and version.
        model: ``fisheye`` (Kannala-Brandt) or ``pinhole`` (Brown-Conrady).
        width: Image width, [px].
        height: Image height, [px].
        K: Camera matrix, [px].
        D: Distortion in OpenCV's order: four numbers for a fisheye, four or five for a pinhole.
        mounting: Pose above the road.
        car: The car that carries it.
        method: How the camera was found.
        residuals: Figures of the fit; each name ends in its unit.
        date: Day of the calibration.
    """

    format: Literal["lanenet-camera/1"]
    model: CameraModel
    width: Side
    height: Side
    K: tuple[Row, Row, Row]
    D: tuple[Coefficient, ...]
    mounting: MountingFile
    car: CarFile
    method: str = ""
    residuals: dict[str, float] = Field(default_factory=dict)
    date: str | datetime.date | None = None

    @field_validator("K")
    @classmethod
    def _check_matrix(cls, K: tuple[Row, Row, Row], info: Any) -> tuple[Row, Row, Row]:
        return _checked_matrix(K, info.data.get("width"), info.data.get("height"))

    @field_validator("D")
    @classmethod
    def _check_distortion(cls, D: tuple[float, ...], info: Any) -> tuple[float, ...]:
        # The model is missing here if it was refused itself.
        return _checked_distortion(D, info.data["model"]) if "model" in info.data else D

    def camera(self) -> Camera:
        """Return the camera that the file describes."""
        return Camera(
            model=self.model,
            width=self.width,
            height=self.height,
            K=np.array(self.K, dtype=np.float64),
            D=np.array(self.D, dtype=np.float64),
            mounting=Mounting(**self.mounting.model_dump()),
            wheelbase_cm=self.car.wheelbase_cm,
        )


def read_camera(path: Path) -> Camera:
    """Read a camera file, or the camera of an earlier map of the same car.

    That of a rejected map is taken with a warning in the log, whether the folder is given or the file in it.

    Args:
        path: The file, or the map's folder.

    Raises:
        CalibrationError: If the file is missing, of an unknown version, or a value is missing, misspelt or
            impossible; names the file and the key.
    """
    if is_folder(path):
        if not is_regular(path / "map.yaml"):
            raise CalibrationError(f"{path}: is a folder without map.yaml, expected a camera file or a map")
        path = path / MAP_CAMERA_NAME
    camera = read_own_camera(path)
    if path.name == MAP_CAMERA_NAME and (why := _why_rejected(path.parent)) is not None:
        _warn(
            f"{path}: a doubtful camera is used: it is that of a rejected map, and wrong where it is the "
            f"camera that spoiled the map{why}; lanenet calibrate measures it without a map"
        )
    return camera


def read_own_camera(path: Path) -> Camera:
    """Read the camera file of what is read as a whole; arguments and errors as for ``read_camera``."""
    if is_regular(path) and (lens := foreign_lens(path)) is not None:
        raise CalibrationError(
            f"{path}: a camera file of {lens.program} holds the lens and no mounting above the road; measure "
            f"the mounting: lanenet calibrate ground POINTS.csv --camera {shlex.quote(str(path))} --out "
            "camera.yaml, and give that file"
        )
    return _read(CameraFile, path).camera()


def read_lens(path: Path, mounting: Mounting, wheelbase_cm: float) -> Camera:
    """Read the lens in a camera file of ROS, OpenCV or Kalibr, or in one of lanenet.

    Args:
        path: The file; or the folder of a map.
        mounting: Pose above the road, where the file has none: only lanenet's has one.
        wheelbase_cm: Distance between the car's axles, where the file has none.

    Raises:
        CalibrationError: If the file is missing, or a value is missing or impossible; names file and key.
    """
    lens = foreign_lens(path) if is_regular(path) else None
    if lens is None:
        return read_camera(path)
    info = _checked(RosCameraInfo, lens.info, str(path))
    _checked(MountingFile, {name: getattr(mounting, name) for name in MountingFile.model_fields}, "mounting")
    _checked(CarFile, {"wheelbase_cm": wheelbase_cm}, "car")
    return Camera(
        model=_ROS_MODELS[info.distortion_model],
        width=info.image_width,
        height=info.image_height,
        K=np.array(info.camera_matrix.data, dtype=np.float64).reshape(3, 3),
        D=np.array(info.distortion_coefficients.data, dtype=np.float64),
        mounting=mounting,
        wheelbase_cm=wheelbase_cm,
    )


def _why_rejected(folder: Path) -> str | None:
    """Return the verdict on a rejected map as the end of a sentence; None for any other folder."""
    meta = folder / "map.yaml"
    if not is_regular(meta) or read_yaml(meta, CalibrationError).get("verdict") != "reject":
        return None
    report = folder / "report.json"
    with suppress(CalibrationError), parsing(str(report), CalibrationError):
        return f" ({read_json(report, CalibrationError)['verdict']['sentence']})"
    return ""


@cache
def _warn(text: str) -> None:
    """Log a warning once: a command reads its camera several times."""
    _log.warning(text)


def write_camera(
    path: Path,
    camera: Camera,
    method: str,
    residuals: dict[str, float] | None = None,
    date: str | None = None,
) -> None:
    """Write a camera file; the camera read back has the same hash.

    Args:
        path: Destination.
        camera: The camera.
        method: How it was found.
        residuals: Figures of the fit; each name ends in its unit.
        date: Day of the calibration, ISO 8601; the same inputs give the same file, so there is no default.

    Raises:
        CalibrationError: If :func:`read_camera` would refuse the camera.
    """
    checked = camera_data(camera, method, residuals, date, str(path))
    write_text(path, _dump(checked))


#: Sigmas of a camera that was found from drives, among the residuals of its file: by the adjustment's names.
_SIGMAS = {
    "focal": "focal_sigma_px",
    "cx": "cx_sigma_px",
    "cy": "cy_sigma_px",
    "k1": "k1_sigma",
    "pitch": "pitch_down_sigma_rad",
    "roll": "roll_sigma_rad",
    "yaw": "yaw_sigma_rad",
    "lever": "ahead_of_front_axle_sigma_cm",
}


def sigma_residuals(camera: Camera, sigma: Mapping[str, float]) -> dict[str, float]:
    """Return a camera's sigmas as residuals of its file.

    That of the focal length is given relative to it, that of its place along the car in camera heights.
    """
    scale = {"focal": float(camera.K[0, 0]), "lever": camera.mounting.height_cm}
    return {file: scale.get(name, 1.0) * sigma[name] for name, file in _SIGMAS.items() if name in sigma}


def read_sigma(path: Path) -> dict[str, float]:
    """Read the sigmas of a camera file, as :func:`sigma_residuals` takes them; empty if it has none.

    Raises:
        CalibrationError: As :func:`read_own_camera`.
    """
    if foreign_lens(path) is not None:
        return {}
    file = _read(CameraFile, path)
    scale = {"focal": file.K[0][0], "lever": file.mounting.height_cm}
    found = {name: file.residuals.get(key) for name, key in _SIGMAS.items()}
    return {name: value / scale.get(name, 1.0) for name, value in found.items() if value is not None}


def camera_data(
    camera: Camera,
    method: str = "",
    residuals: dict[str, float] | None = None,
    date: str | None = None,
    where: str = "camera",
) -> dict[str, Any]:
    """Return a camera as the plain values of its file; the other arguments as for :func:`write_camera`.

    Raises:
        CalibrationError: If :func:`read_camera` would refuse the camera; names ``where``.
    """
    m = camera.mounting
    data = {
        "format": "lanenet-camera/1",
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "K": np.asarray(camera.K, dtype=np.float64).tolist(),
        "D": np.asarray(camera.D, dtype=np.float64).tolist(),
        "mounting": {name: float(getattr(m, name)) for name in MountingFile.model_fields},
        "car": {"wheelbase_cm": float(camera.wheelbase_cm)},
        "method": method,
        "residuals": {name: float(value) for name, value in (residuals or {}).items()},
        "date": date,
    }
    return _checked(CameraFile, data, where).model_dump(mode="json")


class _RosMatrix(Settings):
    rows: int = Field(gt=0, le=16)
    cols: int = Field(gt=0, le=16)
    data: tuple[Number, ...]

    @field_validator("data")
    @classmethod
    def _check_size(cls, data: tuple[float, ...], info: Any) -> tuple[float, ...]:
        rows, cols = info.data.get("rows"), info.data.get("cols")
        if rows is not None and cols is not None and rows * cols != len(data):
            raise ValueError(f"expected {rows} x {cols} numbers, found {len(data)}")
        return data


class RosCameraInfo(Settings):
    """A ROS ``camera_info`` file; other keys are ignored."""

    model_config = ConfigDict(extra="ignore")

    image_width: Side
    image_height: Side
    distortion_model: Literal["plumb_bob", "equidistant", "fisheye"]
    camera_matrix: _RosMatrix
    distortion_coefficients: _RosMatrix

    @field_validator("camera_matrix")
    @classmethod
    def _check_matrix(cls, matrix: _RosMatrix, info: Any) -> _RosMatrix:
        if (matrix.rows, matrix.cols) != (3, 3):
            raise ValueError(f"expected 3 x 3 numbers, found {matrix.rows} x {matrix.cols}")
        d = matrix.data
        width, height = info.data.get("image_width"), info.data.get("image_height")
        _checked_matrix(((d[0], d[1], d[2]), (d[3], d[4], d[5]), (d[6], d[7], d[8])), width, height)
        return matrix

    @field_validator("distortion_coefficients")
    @classmethod
    def _check_distortion(cls, matrix: _RosMatrix, info: Any) -> _RosMatrix:
        if "distortion_model" in info.data:
            _checked_distortion(matrix.data, _ROS_MODELS[info.data["distortion_model"]])
        return matrix


def write_ros_camera_info(path: Path, camera: Camera, name: str) -> None:
    """Write a ROS ``camera_info`` YAML, which has no mounting and no wheelbase.

    A pinhole with four coefficients gets k3 = 0: ``plumb_bob`` has five.

    Args:
        path: Destination.
        camera: The camera.
        name: Value of ``camera_name``.
    """
    D = [float(v) for v in camera.D]
    if camera.model == "pinhole":
        D += [0.0] * (5 - len(D))
    K = np.asarray(camera.K, dtype=np.float64)
    projection = np.concatenate([K, np.zeros((3, 1))], axis=1)
    data = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _ros_matrix(K),
        "distortion_model": "equidistant" if camera.model == "fisheye" else "plumb_bob",
        "distortion_coefficients": _ros_matrix(np.array([D])),
        "rectification_matrix": _ros_matrix(np.eye(3)),
        "projection_matrix": _ros_matrix(projection),
    }
    _checked(RosCameraInfo, data, str(path))
    write_text(path, _dump(data))


def _ros_matrix(matrix: np.ndarray) -> dict[str, Any]:
    rows, cols = matrix.shape
    return {"rows": rows, "cols": cols, "data": matrix.ravel().tolist()}


def _dump(data: dict[str, Any]) -> str:
    # Flow style for the innermost level: one line per matrix row.
    return str(yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110))


def _checked_matrix(K: tuple[Row, Row, Row], width: int | None, height: int | None) -> tuple[Row, Row, Row]:
    """Check a camera matrix; width and height are None if they were refused themselves."""
    if K[0][0] <= 0.0 or K[1][1] <= 0.0:
        raise ValueError(f"expected positive focal lengths, found {K[0][0]:g} and {K[1][1]:g}")
    least_px = _LEAST_FOCAL * min(width or 0, height or 0)
    if min(K[0][0], K[1][1]) < least_px:
        raise ValueError(
            f"expected focal lengths of {least_px:g} px or more in an image of {width}x{height}, found "
            f"{K[0][0]:g} and {K[1][1]:g}"
        )
    if K[1][0] != 0.0 or K[2] != (0.0, 0.0, 1.0):
        raise ValueError("expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    return K


def _checked_distortion(D: tuple[float, ...], model: str) -> tuple[float, ...]:
    lengths = _D_LENGTHS[model]
    if len(D) not in lengths:
        expected = " or ".join(str(n) for n in lengths)
        raise ValueError(f"expected {expected} coefficients for a {model} camera, found {len(D)}")
    return D


def _read(schema: type[SettingsT], path: Path) -> SettingsT:
    return _checked(schema, read_yaml(Path(path), CalibrationError), str(path))


def _checked(schema: type[SettingsT], data: dict[str, Any], where: str) -> SettingsT:
    try:
        return check_settings(schema, data, where)
    except ConfigError as error:
        raise CalibrationError(str(error)) from None
