"""Rerun files, read back chunk by chunk."""

from __future__ import annotations

import shutil
import socket
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun
from rerun.chunk import RrdReader
from watched import CAMERA, PATH, POINTS_CM, POSE, SCENE, frames, image

from lanenet.errors import LanenetError
from lanenet.geometry.frames import map_from_car
from lanenet.geometry.lane import ROWS_CM
from lanenet.viewers.recording import record

LEFT_CM = np.column_stack([POINTS_CM[:3], ROWS_CM])


class Rrd:
    """The columns of each entity, in the order of the frames."""

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, list[dict[str, Any]]] = {}
        for chunk in RrdReader(str(path)).stream():
            rows = chunk.to_record_batch().to_pylist()
            self.rows.setdefault(chunk.entity_path, []).extend(rows)
        for rows in self.rows.values():
            rows.sort(key=lambda row: row.get("frame") or 0)

    def column(self, entity: str, name: str) -> list[Any]:
        """Values by frame of the column whose name ends so."""
        found = []
        for row in self.rows[entity]:
            value = next((value for key, value in row.items() if key.endswith(name)), None)
            found.append(value)
        return found


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Rrd:
    path = tmp_path_factory.mktemp("rerun") / "drive.rrd"
    with record({"rerun": str(path)}, SCENE) as recording:
        for seen in frames():
            recording.add(seen)
    return Rrd(path)


def test_all_that_was_seen_is_on_one_timeline(rrd: Rrd) -> None:
    for entity in (
        "camera/image",
        "birdseye/image",
        "world/car",
        "plots/values/confidence",
        "birdseye/edges",
    ):
        rows = rrd.rows[f"/{entity}"]
        assert [row["frame"] for row in rows] == [7, 8, 9]
        seconds = [row["time"] / np.timedelta64(1, "s") for row in rows]
        assert seconds == pytest.approx([0.0, 0.05, 0.1])


def test_images_are_read_back(rrd: Rrd) -> None:
    first, _, last = rrd.column("/camera/image", "EncodedImage:blob")
    again = cv2.imdecode(np.array(first[0], np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(again.astype(int) - image()).mean() < 4.0
    assert not last  # it could not be read


def test_angles_are_in_degrees_and_positive_to_the_left(rrd: Rrd) -> None:
    assert rrd.column("/plots/angles/steering_deg", "scalars") == [[pytest.approx(np.rad2deg(0.25))]] * 2
    assert rrd.column("/plots/values/confidence", "scalars") == [[0.75], [0.75], [0.25]]


def test_the_lane_comes_to_its_place_on_the_map(rrd: Rrd) -> None:
    points = np.array(rrd.column("/world/car/detected/left/points", "positions")[0])
    np.testing.assert_allclose(points[:, :2], LEFT_CM, atol=1e-5)
    turn = np.array(rrd.column("/world/car", "mat3x3")[0]).reshape(3, 3, order="F")
    origin = np.array(rrd.column("/world/car", "translation")[0]).ravel()
    on_map = points @ turn.T + origin
    np.testing.assert_allclose(on_map[:, :2], map_from_car(LEFT_CM, POSE, CAMERA.wheelbase_cm), atol=1e-3)


def test_lines_lie_in_the_images_where_the_camera_sees_them(rrd: Rrd) -> None:
    px = CAMERA.project_ground(LEFT_CM) + 0.5
    drawn = np.array(rrd.column("/camera/detected/left", "strips")[0][0])
    inside = (px > 0).all(axis=1) & (px < (160, 120)).all(axis=1)
    assert inside.any()
    assert (np.linalg.norm(drawn[:, None] - px[inside], axis=2).min(axis=0) < 1.5).all()
    above = np.array(rrd.column("/birdseye/detected/left", "strips")[0][0])
    # 48 cm to the left edge, 72 cm to the far one, two pixels to a cell of 0.75 cm.
    expected = np.column_stack([(LEFT_CM[:, 0] + 48.0) / 0.375, (72.0 - LEFT_CM[:, 1]) / 0.375])
    np.testing.assert_allclose(above[[0, 3, 6]], expected, atol=1e-3)


def test_a_line_that_is_gone_is_taken_away(rrd: Rrd) -> None:
    right, left = (rrd.column(f"/camera/detected/{side}", "strips") for side in ("right", "left"))
    assert right[0] and not right[2] and left[2]


def test_the_map_is_there_all_the_time(rrd: Rrd) -> None:
    strips = rrd.column("/world/map/lines/0/left_0", "strips")[0]
    assert [len(strip) for strip in strips] == [2, 2]
    np.testing.assert_allclose(np.array(strips[1])[:, :2], [[80.0, 20.0], [90.0, 25.0]])
    path = np.array(rrd.column("/world/map/path", "strips")[0][0])
    np.testing.assert_allclose(path[:, :2], PATH[:, :2])
    assert len(rrd.column("/world/map/edges", "positions")[0]) == 2


def test_photos_have_no_time(tmp_path: Path) -> None:
    with record({"rerun": str(tmp_path / "p.rrd")}, SCENE) as recording:
        for seen in frames((np.nan, np.nan, np.nan)):
            recording.add(seen)
    rows = Rrd(tmp_path / "p.rrd").rows["/camera/image"]
    assert [row["frame"] for row in rows] == [7, 8, 9] and "time" not in rows[0]


def test_a_viewer_that_nobody_runs_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"rerun+http://127.0.0.1:{free.getsockname()[1]}/proxy"
    with (
        pytest.raises(LanenetError, match=r"no viewer can be reached \(.*refused.*\)"),
        record({"rerun": address}, SCENE),
    ):
        pass

    def spawn(self: rerun.RecordingStream, **_: Any) -> None:
        assert shutil.which("rerun") is not None, "the SDK's own viewer is not on the path"
        raise RuntimeError("no display\nuse another one")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", spawn)
    monkeypatch.setenv("PATH", "")
    with (
        pytest.raises(LanenetError, match=r"reached \(no display\); --rerun FILE\.rrd"),
        record({"rerun": "live"}, SCENE),
    ):
        pass
