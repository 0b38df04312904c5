"""Bad camera files, lanenet's own and those of ROS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from bad_input import Bad, each
from cameras import MOUNTING, ROS_FILE, make_camera

from lanenet.data.camera_file import read_camera, read_lens, write_camera
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Mounting

Act = Callable[[Path], Any]


def changed(key: str, value: Any) -> Act:
    """A valid camera file with one value (dotted key) replaced, or removed if the value is None; read."""

    def act(tmp_path: Path) -> Any:
        path = tmp_path / "camera.yaml"
        write_camera(path, make_camera(), "test")
        data = node = yaml.safe_load(path.read_text())
        *parents, last = key.split(".")
        for parent in parents:
            node = node[parent]
        if value is None:
            del node[last]
        else:
            node[last] = value
        path.write_text(yaml.safe_dump(data))
        return read_camera(path)

    return act


def ros(old: str = "", new: str = "", mounting: Mounting = MOUNTING, wheelbase_cm: float = 26.0) -> Act:
    def act(tmp_path: Path) -> Any:
        path = tmp_path / "info.yaml"
        path.write_text(ROS_FILE.replace(old, new) if old else ROS_FILE)
        return read_lens(path, mounting, wheelbase_cm)

    return act


def write_three(tmp_path: Path) -> None:
    try:
        write_camera(tmp_path / "camera.yaml", make_camera("pinhole", 3), "test")
    finally:
        assert list(tmp_path.iterdir()) == []


def bad(what: str, act: Act, *named: str) -> Bad:
    return Bad(what, act, CalibrationError, named)


def own(what: str, key: str, value: Any, *named: str) -> Bad:
    return bad(what, changed(key, value), "camera.yaml", key.partition(".")[0], *named)


BAD = [
    own("another version", "format", "lanenet-camera/2", "'lanenet-camera/1'", "'lanenet-camera/2'"),
    own("no version", "format", None, "key 'format' is missing"),
    own("another model", "model", "omni", "key 'model'", "'fisheye' or 'pinhole'"),
    own("too many coefficients", "D", [0.0] * 5, "key 'D'", "4", "fisheye", "found 5"),
    own("a nan coefficient", "D", [0.0, float("nan"), 0.0, 0.0], "key 'D.1'", "finite"),
    own("a negative focal length", "K", [[-100.0, 0, 160], [0, 100.0, 120], [0, 0, 1]], "key 'K'", "-100"),
    own("a focal length of 0", "K", [[100.0, 0, 160], [0, 0.0, 120], [0, 0, 1]], "key 'K'", "and 0"),
    own("two rows", "K", [[100.0, 0, 160], [0, 100.0, 120]], "key 'K"),
    own("a scaled matrix", "K", [[100.0, 0, 160], [0, 100.0, 120], [0, 0, 2]], "key 'K'", "[[fx"),
    own("on the ground", "mounting.height_cm", 0.0, "key 'mounting.height_cm'", "0.0"),
    own("on its lens", "mounting.height_cm", 0.3, "key 'mounting.height_cm'", "0.3"),
    own("a focal length in millimetres", "K", [[3.6, 0, 160], [0, 3.6, 120], [0, 0, 1]], "key 'K'", "3.6"),
    own("no height", "mounting.height_cm", None, "key 'mounting.height_cm' is missing"),
    own("a misspelt key", "mounting.pitch_rad", 0.1, "'mounting.pitch_rad'", "'pitch_down_rad'"),
    own("a negative wheelbase", "car.wheelbase_cm", -26.0, "key 'car.wheelbase_cm'", "greater than 0"),
    own("no width", "width", 0, "key 'width'"),
    own("yes for a height", "mounting.height_cm", True, "key 'mounting.height_cm'", "True"),
    own("a height in kilometres", "mounting.height_cm", 1e308, "key 'mounting.height_cm'"),
    own("a pitch in degrees", "mounting.pitch_down_rad", 15.0, "key 'mounting.pitch_down_rad'", "15"),
    own("a roll in degrees", "mounting.roll_rad", -5, "key 'mounting.roll_rad'", "-5"),
    own("a yaw in degrees", "mounting.yaw_rad", 2.0, "key 'mounting.yaw_rad'", "2.0"),
    own("an image beyond all memory", "width", 10**9, "key 'width'"),
    own("a coefficient beyond all lenses", "D", [1e200, 0.0, 0.0, 0.0], "key 'D.0'"),
    own("a width in a text", "width", "320", "key 'width'", "'320'"),
    bad("three coefficients", write_three, "camera.yaml", "key 'D'", "4 or 5", "found 3"),
    bad("no file", lambda folder: read_camera(folder / "camera.yaml"), "camera.yaml", "no such file"),
    bad("a name that no file can have", lambda folder: read_camera(folder / ("x" * 5000)), "xxx"),
    bad("ros: another model", ros("plumb_bob", "double_sphere"), "info.yaml", "'distortion_model'"),
    bad(
        "ros: coefficients of another model",
        ros("plumb_bob", "equidistant"),
        *("info.yaml", "'distortion_coefficients'", "4"),
    ),
    bad("ros: a focal length of 0", ros("500.5", "0.0"), "info.yaml", "'camera_matrix'"),
    bad(
        "ros: a wrong count",
        ros("cols: 5", "cols: 4"),
        *("info.yaml", "'distortion_coefficients.data'", "1 x 4", "found 5"),
    ),
    bad("ros: no width", ros("image_width: 640", "image_width: 0"), "info.yaml", "'image_width'"),
    bad("ros: no wheelbase", ros(wheelbase_cm=0.0), "wheelbase_cm"),
    bad("ros: a focal length in millimetres", ros("500.5", "3.6"), "info.yaml", "'camera_matrix'"),
    bad("ros: below the ground", ros(mounting=Mounting(-1.0)), "height_cm"),
]


@each(BAD)
def test_a_bad_camera_is_refused(tmp_path: Path, bad: Bad) -> None:
    bad.check(tmp_path)
