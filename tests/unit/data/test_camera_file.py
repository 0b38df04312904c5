from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lanenet.data.camera_file import (
    read_camera,
    read_ros_camera_info,
    write_camera,
    write_ros_camera_info,
)
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, CameraModel, Mounting

MOUNTING = Mounting(19.7, 0.4321, -0.011, 0.02, -2.25, 0.6)


def make_camera(model: CameraModel = "fisheye", n: int = 4, mounting: Mounting = MOUNTING) -> Camera:
    return Camera(
        model=model,
        width=320,
        height=240,
        K=np.array([[107.8, 0.3, 159.123456789], [0.0, 106.3, 119.5], [0.0, 0.0, 1.0]]),
        D=np.array([-0.03, 1e-05, -0.002, 0.0002, 0.004])[:n],
        mounting=mounting,
        wheelbase_cm=26.0,
    )


@pytest.mark.parametrize(("model", "n"), [("fisheye", 4), ("pinhole", 4), ("pinhole", 5)])
def test_a_camera_survives_the_trip(tmp_path: Path, model: CameraModel, n: int) -> None:
    camera = make_camera(model, n)
    write_camera(tmp_path / "camera.yaml", camera, "chessboard", {"rms_px": 0.13}, "2024-05-06")
    back = read_camera(tmp_path / "camera.yaml")
    assert back.hash == camera.hash
    assert back.wheelbase_cm == camera.wheelbase_cm
    assert back.mounting == camera.mounting
    np.testing.assert_array_equal(back.K, camera.K)
    data = yaml.safe_load((tmp_path / "camera.yaml").read_text())
    assert data["method"] == "chessboard"
    assert data["residuals"] == {"rms_px": 0.13}
    assert data["date"] == "2024-05-06"
    assert list(data["mounting"]) == [
        "height_cm",
        "pitch_down_rad",
        "roll_rad",
        "yaw_rad",
        "ahead_of_front_axle_cm",
        "right_of_centre_cm",
    ]


@given(
    height_cm=st.floats(0.1, 1e3),
    angles=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    offsets=st.tuples(*[st.floats(-1e3, 1e3)] * 2),
)
def test_any_mounting_keeps_the_hash(
    tmp_path_factory: pytest.TempPathFactory,
    height_cm: float,
    angles: tuple[float, float, float],
    offsets: tuple[float, float],
) -> None:
    camera = make_camera(mounting=Mounting(height_cm, *angles, *offsets))
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    write_camera(path, camera, "test")
    assert read_camera(path).hash == camera.hash


def changed(tmp_path: Path, key: str, value: Any) -> Path:
    """A valid camera file with one value (dotted key) replaced, or removed if the value is None."""
    path = tmp_path / "camera.yaml"
    write_camera(path, make_camera(), "test")
    data = yaml.safe_load(path.read_text())
    *parents, last = key.split(".")
    node = data
    for parent in parents:
        node = node[parent]
    if value is None:
        del node[last]
    else:
        node[last] = value
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", "lanenet-camera/2", "key 'format'.*lanenet-camera/1.*found 'lanenet-camera/2'"),
        ("format", None, "key 'format' is missing"),
        ("model", "omni", "key 'model'.*'fisheye' or 'pinhole'"),
        ("D", [0.0] * 5, "key 'D'.*expected 4 coefficients for a fisheye camera, found 5"),
        ("D", [0.0, float("nan"), 0.0, 0.0], "key 'D.1'.*finite"),
        ("K", [[-100.0, 0, 160], [0, 100.0, 120], [0, 0, 1]], "key 'K'.*positive focal lengths"),
        ("K", [[100.0, 0, 160], [0, 0.0, 120], [0, 0, 1]], "key 'K'.*positive focal lengths"),
        ("K", [[100.0, 0, 160], [0, 100.0, 120]], "key 'K.*missing|key 'K'"),
        ("K", [[100.0, 0, 160], [0, 100.0, 120], [0, 0, 2]], "key 'K'.*expected \\[\\[fx"),
        ("mounting.height_cm", 0.0, "key 'mounting.height_cm'.*greater than 0"),
        ("mounting.height_cm", None, "key 'mounting.height_cm' is missing"),
        ("mounting.pitch_rad", 0.1, "unknown key 'mounting.pitch_rad', did you mean 'pitch_down_rad'"),
        ("car.wheelbase_cm", -26.0, "key 'car.wheelbase_cm'.*greater than 0"),
        ("width", 0, "key 'width'"),
    ],
)
def test_a_wrong_value_is_named_by_file_and_key(tmp_path: Path, key: str, value: Any, message: str) -> None:
    path = changed(tmp_path, key, value)
    with pytest.raises(CalibrationError, match=rf"(?s)camera\.yaml: .*{message}"):
        read_camera(path)


def test_pinhole_coefficients_are_counted(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"key 'D'.*expected 4 or 5 coefficients.*found 3"):
        write_camera(tmp_path / "camera.yaml", make_camera("pinhole", 3), "test")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_file_is_a_calibration_error(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"camera\.yaml: no such file"):
        read_camera(tmp_path / "camera.yaml")


def test_a_date_without_quotes_is_a_date(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    write_camera(path, make_camera(), "test", date="2024-05-06")
    path.write_text(path.read_text().replace("'2024-05-06'", "2024-05-06"))
    assert read_camera(path).hash == make_camera().hash


@pytest.mark.parametrize(("model", "n"), [("fisheye", 4), ("pinhole", 5)])
def test_ros_round_trip(tmp_path: Path, model: CameraModel, n: int) -> None:
    camera = make_camera(model, n)
    path = tmp_path / "info.yaml"
    write_ros_camera_info(path, camera, "front")
    assert read_ros_camera_info(path, MOUNTING, 26.0).hash == camera.hash
    data = yaml.safe_load(path.read_text())
    assert data["camera_name"] == "front"
    assert data["distortion_model"] == {"fisheye": "equidistant", "pinhole": "plumb_bob"}[model]
    assert data["projection_matrix"]["cols"] == 4
    assert data["projection_matrix"]["data"][:4] == [107.8, 0.3, 159.123456789, 0.0]


def test_four_pinhole_coefficients_become_the_five_of_ros(tmp_path: Path) -> None:
    camera = make_camera("pinhole", 4)
    write_ros_camera_info(tmp_path / "info.yaml", camera, "front")
    back = read_ros_camera_info(tmp_path / "info.yaml", MOUNTING, 26.0)
    np.testing.assert_array_equal(back.D, [*camera.D, 0.0])
    points = np.array([[0.0, 30.0], [-20.0, 50.0]])
    np.testing.assert_array_equal(back.project_ground(points), camera.project_ground(points))


#: As ROS' camera_calibration writes it.
ROS_FILE = """
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0.0, 320.25, 0.0, 501.5, 240.75, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3, 0.1, 0.001, -0.002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
"""


def test_a_ros_file_is_understood(tmp_path: Path) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(ROS_FILE)
    camera = read_ros_camera_info(path, MOUNTING, 25.0)
    assert (camera.model, camera.width, camera.height, camera.wheelbase_cm) == ("pinhole", 640, 480, 25.0)
    assert (camera.K[0, 0], camera.K[0, 2], camera.K[1, 1], camera.K[1, 2]) == (500.5, 320.25, 501.5, 240.75)
    np.testing.assert_array_equal(camera.D, [-0.3, 0.1, 0.001, -0.002, 0.0])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("plumb_bob", "rational_polynomial", "key 'distortion_model'"),
        ("plumb_bob", "equidistant", "key 'distortion_coefficients'.*expected 4 coefficients"),
        ("500.5", "0.0", "key 'camera_matrix'.*positive focal lengths"),
        ("cols: 5", "cols: 4", "key 'distortion_coefficients.data'.*expected 1 x 4 numbers, found 5"),
        ("image_width: 640", "image_width: 0", "key 'image_width'"),
    ],
)
def test_a_wrong_ros_file_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(ROS_FILE.replace(old, new))
    with pytest.raises(CalibrationError, match=rf"info\.yaml: .*{message}"):
        read_ros_camera_info(path, MOUNTING, 26.0)


def test_ros_needs_a_possible_car(tmp_path: Path) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(ROS_FILE)
    with pytest.raises(CalibrationError, match="wheelbase_cm"):
        read_ros_camera_info(path, MOUNTING, 0.0)
    with pytest.raises(CalibrationError, match="height_cm"):
        read_ros_camera_info(path, Mounting(-1.0), 26.0)
