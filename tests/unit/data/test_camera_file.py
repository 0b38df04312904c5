from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from cameras import MOUNTING, ROS_FILE, make_camera
from hypothesis import given
from hypothesis import strategies as st

from lanenet.data.camera_file import (
    read_camera,
    read_lens,
    write_camera,
    write_ros_camera_info,
)
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import CameraModel, Mounting


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
    height_cm=st.floats(1.0, 1e3),
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
    assert read_lens(path, MOUNTING, 26.0).hash == camera.hash
    data = yaml.safe_load(path.read_text())
    assert data["camera_name"] == "front"
    assert data["distortion_model"] == {"fisheye": "equidistant", "pinhole": "plumb_bob"}[model]
    assert data["projection_matrix"]["cols"] == 4
    assert data["projection_matrix"]["data"][:4] == [107.8, 0.3, 159.123456789, 0.0]


def test_four_pinhole_coefficients_become_the_five_of_ros(tmp_path: Path) -> None:
    camera = make_camera("pinhole", 4)
    write_ros_camera_info(tmp_path / "info.yaml", camera, "front")
    back = read_lens(tmp_path / "info.yaml", MOUNTING, 26.0)
    np.testing.assert_array_equal(back.D, [*camera.D, 0.0])
    points = np.array([[0.0, 30.0], [-20.0, 50.0]])
    np.testing.assert_array_equal(back.project_ground(points), camera.project_ground(points))


def test_a_ros_file_is_understood(tmp_path: Path) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(ROS_FILE)
    camera = read_lens(path, MOUNTING, 25.0)
    assert (camera.model, camera.width, camera.height, camera.wheelbase_cm) == ("pinhole", 640, 480, 25.0)
    assert (camera.K[0, 0], camera.K[0, 2], camera.K[1, 1], camera.K[1, 2]) == (500.5, 320.25, 501.5, 240.75)
    np.testing.assert_array_equal(camera.D, [-0.3, 0.1, 0.001, -0.002, 0.0])


@pytest.mark.parametrize("verdict", ["good", "usable", "reject"])
def test_the_camera_of_an_earlier_map_is_taken_and_doubted_if_it_was_rejected(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, verdict: str
) -> None:
    camera = make_camera("fisheye", 4)
    write_camera(tmp_path / "camera.yaml", camera, "from the drive")
    with pytest.raises(CalibrationError, match=r"map\.yaml"):
        read_camera(tmp_path)
    (tmp_path / "map.yaml").write_text(f"format: lanenet-map/1\nverdict: {verdict}\n")
    (tmp_path / "report.json").write_text('{"verdict": {"sentence": "the lines are not there"}}')
    # Of the folder and of the file, it is the same camera, and the same is said of it, once.
    for path in (tmp_path, tmp_path / "camera.yaml", tmp_path):
        assert read_camera(path).hash == camera.hash
    said = [record.getMessage() for record in caplog.records]
    if verdict == "reject":
        (text,) = said
        assert text.startswith(f"{tmp_path}/camera.yaml: a doubtful camera is used")
        assert "(the lines are not there)" in text
    else:
        assert not said


@pytest.mark.parametrize("report", [None, "{", '{"verdict": 3}', "[]"])
def test_a_rejected_map_without_its_report_is_doubted_too(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, report: str | None
) -> None:
    camera = make_camera("fisheye", 4)
    write_camera(tmp_path / "camera.yaml", camera, "from the drive")
    (tmp_path / "map.yaml").write_text("format: lanenet-map/1\nverdict: reject\n")
    if report is not None:
        (tmp_path / "report.json").write_text(report)
    assert read_camera(tmp_path).hash == camera.hash
    assert "a doubtful camera is used" in caplog.text
