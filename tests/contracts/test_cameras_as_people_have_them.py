"""Camera files of other programs: every command reads the lens, or says that the mounting is missing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import refused
from drives import write_drive
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.data.camera_file import read_camera, read_lens
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Mounting

CASES = Path(__file__).resolve().parents[1] / "support/cases"
OPENCV = CASES / "camera_opencv_filestorage"
K = np.array([[322.6, 0.0, 166.9], [0.0, 323.2, 121.6], [0.0, 0.0, 1.0]])
D = [-0.31, 0.11, 0.0005, -0.0004, -0.02]
#: As ``ros2 topic echo /camera/camera_info`` prints a message, and the beginning of the next.
ECHO = """header:
  stamp:
    sec: 1700000000
    nanosec: 5
  frame_id: camera
height: 240
width: 320
distortion_model: MODEL
d: [-0.31, 0.11, 0.0005, -0.0004, -0.02REST]
k:
- 322.6
- 0.0
- 166.9
- 0.0
- 323.2
- 121.6
- 0.0
- 0.0
- 1.0
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [322.6, 0.0, 166.9, 0.0, 0.0, 323.2, 121.6, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
header:
  stamp:
    sec: 17000
"""
#: As ``rostopic echo`` of ROS 1.
ECHO_1 = (
    ECHO.replace("d: [", "D: [").replace("\nk:\n", "\nK:\n").replace("\nr:", "\nR:").replace("\np:", "\nP:")
)
KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.31, 0.11, 0.0005, -0.0004]
  distortion_model: radtan
  intrinsics: [322.6, 323.2, 166.9, 121.6]
  resolution: [320, 240]
  rostopic: /camera/image_raw
"""
PYTHON = """%YAML:1.0
---
mtx: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 322.6, 0., 166.9, 0., 323.2, 121.6, 0., 0., 1. ]
dist: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.31, 0.11, 0.0005, -0.0004, -0.02 ]
image_size: [ 320, 240 ]
"""
LISTS = """camera_matrix: [[322.6, 0.0, 166.9], [0.0, 323.2, 121.6], [0.0, 0.0, 1.0]]
dist_coeff: [[-0.31, 0.11, 0.0005, -0.0004, -0.02]]
image_width: 320
image_height: 240
"""


#: What camera_calibration writes beside ``ost.yaml``.
OST = """# oST version 5.0 parameters


[image]

width
320

height
240

[narrow_stereo]

camera matrix
322.6 0.0 166.9
0.0 323.2 121.6
0.0 0.0 1.0

distortion
-0.31 0.11 0.0005 -0.0004 -0.02
"""
#: As tutorials of OpenCV's fisheye print it, and the key that says what it is.
FISHEYE = {
    "DIM": [320, 240],
    "K": K.tolist(),
    "D": [[value] for value in D[:4]],
    "fisheye_model": 1,
}


def echo(model: str = "plumb_bob", rest: str = "", text: str = ECHO) -> str:
    return text.replace("MODEL", model).replace("REST", rest)


ROS = (CASES / "camera_ros" / "ost.yaml").read_text()
#: Name, text, and how many coefficients it has.
LENSES: dict[str, tuple[str, int]] = {
    "ost.yaml": (ROS, 5),
    "opencv.yml": ((OPENCV / "opencv.yml").read_text(), 5),
    "opencv_old_header.yml": ((OPENCV / "opencv_old_header.yml").read_text(), 5),
    "opencv.xml": ((OPENCV / "opencv.xml").read_text(), 5),
    "no_header.yml": ((OPENCV / "opencv.yml").read_text().partition("---\n")[2], 5),
    "python.yml": (PYTHON, 5),
    "lists.yaml": (LISTS, 5),
    "echo.yaml": (echo(), 5),
    "echo_eight.yaml": (echo("rational_polynomial", ", 0.0, 0.0, 0.0"), 5),
    "echo_eight_plumb_bob.yaml": (echo("plumb_bob", ", 0.0, 0.0, 0.0"), 5),
    "echo_ros1.yaml": (echo(text=ECHO_1), 5),
    "camchain.yaml": (KALIBR, 4),
}
MOUNTING = Mounting(20.0)


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_of_another_program_is_read(tmp_path: Path, name: str) -> None:
    text, count = LENSES[name]
    (tmp_path / name).write_text(text)
    camera = read_lens(tmp_path / name, MOUNTING, 26.0)
    assert (camera.model, camera.width, camera.height) == ("pinhole", 320, 240)
    np.testing.assert_allclose(camera.K, K)
    np.testing.assert_allclose(camera.D, D[:count])
    assert camera.mounting == MOUNTING and camera.wheelbase_cm == 26.0


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("echo.yaml", echo("equidistant").replace(", -0.02]", "]")),
        ("camchain.yaml", KALIBR.replace("radtan", "equidistant")),
        (
            "opencv.yml",
            PYTHON.replace(", -0.02 ]", " ]").replace("rows: 5", "rows: 4") + "fisheye_model: 1\n",
        ),
        ("fisheye.json", json.dumps(FISHEYE)),
        ("fisheye.yaml", yaml.safe_dump(FISHEYE)),
    ],
)
def test_a_fisheye_of_another_program_is_read(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    camera = read_lens(tmp_path / name, MOUNTING, 26.0)
    assert camera.model == "fisheye"
    np.testing.assert_allclose(camera.D, D[:4])


@pytest.mark.parametrize("name", LENSES)
def test_what_needs_the_mounting_names_the_way_to_it(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(LENSES[name][0])
    with pytest.raises(
        CalibrationError, match=r"no mounting .* lanenet calibrate ground .* --camera \S+"
    ) as error:
        read_camera(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "words",
    [
        ("detect", "{drive}", "--detector", "painter", "--out", "{out}.csv"),
        ("map", "{drive}", "--lane-width", "40", "--out", "{out}"),
        pytest.param(("train", "{drive}", "--lane-width", "40", "--name", "a"), marks=pytest.mark.slow),
        ("bench",),
        ("doctor",),
        ("calibrate", "drive", "{drive}", "--refine", "--lane-width", "40", "--out", "{out}.yaml"),
    ],
    ids=lambda words: "-".join(words[:2]),
)
def test_every_command_says_so(
    tmp_path: Path, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    drive = write_drive(tmp_path / "lap", 80, None)
    path = tmp_path / "ost.yaml"
    path.write_text(ROS)
    filled = [word.format(drive=drive, out=tmp_path / "out") for word in words]
    result = CliRunner().invoke(app, [*filled, "--camera", str(path)])
    assert result.exit_code != 0, result.output
    assert "lanenet calibrate ground" in " ".join(result.output.split()), result.output


@pytest.mark.parametrize("name", ["opencv.yml", "opencv_old_header.yml", "opencv.xml"])
def test_the_mounting_of_such_a_camera_is_measured(tmp_path: Path, name: str) -> None:
    out = tmp_path / "camera.yaml"
    result = CliRunner().invoke(
        app,
        ["calibrate", "ground", f"{OPENCV}/points.csv", "--camera", f"{OPENCV}/{name}", "--out", str(out)],
    )
    assert result.exit_code == 0, result.output
    camera = read_camera(out)
    np.testing.assert_allclose(camera.K, K)
    assert 5.0 < camera.mounting.height_cm < 100.0


BAD = {
    "another rational model": (echo("rational_polynomial", ", 0.1, 0.0, 0.0"), "without the rational model"),
    "another lens": (echo("thin_prism"), "'distortion_model'"),
    "not calibrated": (
        ECHO.replace("MODEL", "''").replace("322.6", "0.0").replace("323.2", "0.0"),
        "focal length",
    ),
    "binned": (echo().replace("binning_x: 0", "binning_x: 2"), "binned or a part"),
    "a region": (echo().replace("x_offset: 0", "x_offset: 8"), "binned or a part"),
    "two cameras": (KALIBR + KALIBR.replace("cam0", "cam1"), "2 cameras (cam0, cam1)"),
    "a stereo pair": (PYTHON.replace("mtx", "M1").replace("dist", "M2"), "stereo pair"),
    "an omnidirectional lens": (KALIBR.replace("pinhole", "omni"), "'distortion_model'"),
    "no size": (PYTHON.replace("image_size", "points"), "add image_width and image_height"),
    "other names": (PYTHON.replace("mtx", "M1").replace("dist", "D1"), "found M1, D1, image_size); expected"),
    "other names in XML": (
        (OPENCV / "opencv.xml").read_text().replace("camera_matrix", "K1").replace("distortion_c", "c"),
        "K1, coefficients, ",
    ),
    "no matrix": (
        ROS.replace("camera_matrix", "matrix"),
        "expected image_width, image_height, camera_matrix",
    ),
    "the text of ROS": (OST, "give the ost.yaml"),
    "four coefficients": (
        PYTHON.replace(", -0.02 ]", " ]").replace("rows: 5", "rows: 4"),
        "key fisheye_model with 1 or 0",
    ),
    "nested": ("%YAML:1.0\n---\na: " + "[" * 100_000, "nested too deeply"),
    "nested tags": ('<?xml version="1.0"?><opencv_storage>' + "<a>" * 100_000, "nested too deeply"),
    "torn": (PYTHON[:-60], "not a readable file of OpenCV"),
    "a matrix beyond all memory": (
        PYTHON.replace("rows: 3\n   cols: 3", "rows: 300000\n   cols: 300000"),
        "found 300000",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_lens_that_cannot_be_used_is_refused(tmp_path: Path, name: str) -> None:
    text, words = BAD[name]
    (tmp_path / "lens.yaml").write_text(text)
    with pytest.raises(CalibrationError) as caught:
        read_lens(tmp_path / "lens.yaml", MOUNTING, 26.0)
    assert words in str(caught.value) and "lens.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_misspelt_file_of_lanenet_is_not_taken_for_anothers(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text("model: pinhole\nK: [[1, 0, 0]]\nmounting: {height_cm: 20}\n")
    line = refused(tmp_path, "bench", "--camera", tmp_path / "camera.yaml")
    assert "key 'format' is missing" in line
