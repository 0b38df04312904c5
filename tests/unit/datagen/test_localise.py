"""Poses that are written as frames come, the trajectory and picture at the end, and the command for it."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.live_picture import LiveCanvas
from datagen.localise import HEADER, localise
from datagen.map_settings import MapSettings
from datagen.slam.filter import FilterSettings
from datagen.slam.moments import Moment, StartSettings, moments_of
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.cli import app
from lanenet.data.camera_file import read_camera
from lanenet.data.drive import open_drive, read_truth
from lanenet.data.trajectory import read_tum
from lanenet.errors import LanenetError, TrackingLostError

SETTINGS = MapSettings(filter=FilterSettings(particles=60))
KNOWN = StartSettings(factor=1.0)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}
    settings = {"seed": 3, "frames": 70, "camera": camera, "track": {"preset": "mat"}}
    return simulate_drive(
        SimulationSettings.model_validate(settings), tmp_path_factory.mktemp("live") / "drive"
    )


def rows_of(path: Path) -> list[list[str]]:
    text = path.read_text()
    assert text.startswith(HEADER)
    return [line.split(",") for line in text.splitlines()[1:]]


def test_every_pose_is_on_disk_before_the_next_frame_comes(simulated, tmp_path):
    drive, out = open_drive(simulated), tmp_path / "new" / "poses.csv"
    written: list[int] = []

    def watched():
        for moment in moments_of(drive):
            written.append(len(rows_of(out)) if out.exists() else 0)
            yield moment

    report = localise(watched(), drive.camera, SETTINGS, out, KNOWN)
    assert written == list(range(len(drive)))
    assert (report.frames, report.poses, report.segments, report.standing) == (70, 70, 1, 0)
    rows = rows_of(out)
    t_s, poses = read_tum(out.with_suffix(".tum"))
    np.testing.assert_allclose(t_s, drive.t_s, atol=1e-6)
    np.testing.assert_allclose(poses, [[float(v) for v in row[2:5]] for row in rows], atol=1e-3)
    truth = read_truth(simulated)
    true_way = np.hypot(np.diff(truth["x_cm"]), np.diff(truth["y_cm"])).sum()
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() == pytest.approx(true_way, rel=0.06)
    assert 0.0 < report.median_ms <= report.p99_ms and report.map_mb > 1.0
    picture = cv2.imread(str(report.picture))
    assert (picture == 255).all(axis=2).sum() > 50


def test_ctrl_c_ends_the_drive_and_keeps_what_was_driven(simulated, tmp_path):
    drive, out = open_drive(simulated), tmp_path / "poses.csv"

    def stopped():
        for moment in moments_of(drive):
            if moment.frame == 12:
                raise KeyboardInterrupt
            yield moment

    assert localise(stopped(), drive.camera, SETTINGS, out, KNOWN).poses == 12
    assert len(rows_of(out)) == len(read_tum(out.with_suffix(".tum"))[0]) == 12
    assert out.with_suffix(".png").is_file()


def test_an_error_leaves_the_poses_so_far_and_no_half_trajectory(simulated, tmp_path):
    drive, out = open_drive(simulated), tmp_path / "poses.csv"

    def torn():
        for moment in moments_of(drive):
            if moment.frame == 12:
                raise LanenetError("the camera is gone")
            yield moment

    with pytest.raises(LanenetError, match="the camera is gone"):
        localise(torn(), drive.camera, SETTINGS, out, KNOWN)
    assert len(rows_of(out)) == 12
    assert [path.name for path in tmp_path.iterdir()] == ["poses.csv"]


def test_nothing_to_see_is_said(simulated, tmp_path):
    drive = open_drive(simulated)
    blind = (Moment(m.frame, m.t_s, None, m.commands) for m in moments_of(drive))
    with pytest.raises(TrackingLostError, match="0 frames of a moving car"):
        localise(blind, drive.camera, SETTINGS, tmp_path / "poses.csv")
    (tmp_path / "file").touch()
    with pytest.raises(LanenetError, match="is a file, expected a folder"):
        localise(moments_of(drive), drive.camera, SETTINGS, tmp_path / "file" / "poses.csv", KNOWN)


def test_a_canvas_coarsens_and_keeps_what_was_drawn():
    canvas = LiveCanvas(size_px=200)
    corners = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 30.0], [1200.0, 30.0], [1200.0, -900.0]])
    for corner in corners:
        canvas.add(corner + [[0.0, 5.0]], corner)
    assert canvas.cm_per_px == 8.0 and canvas.frames == 5
    picture = canvas.picture()
    assert max(picture.shape) < 200 + 2 * 40 + 2
    white = np.argwhere((picture[:-40] == 255).all(axis=2))
    across, down = (np.ptp(white[:, i]) * 8.0 for i in (1, 0))
    assert across == pytest.approx(1200.0, abs=20.0) and down == pytest.approx(930.0, abs=20.0)


def test_the_command(simulated, tmp_path):
    def invoke(*words: object):
        return CliRunner().invoke(app, ["localise", *map(str, words)])

    config = tmp_path / "few.yaml"
    config.write_text("filter: {particles: 40}\n")
    out = tmp_path / "poses.csv"
    result = invoke(simulated, "--config", config, "--factor", 1.0, "--out", out)
    assert result.exit_code == 0, result.output
    assert "70 poses of 70 frames, 1 segment(s)" in result.output and "frames/s" in result.output
    assert "gain of the speed 1.000" in result.output and len(rows_of(out)) == 70
    # The map's own settings and camera will do, too.
    assert read_camera(simulated / "camera.yaml").hash == open_drive(simulated).camera.hash
    wrong = invoke(simulated, "--out", tmp_path / "poses.txt")
    assert wrong.exit_code == 1 and "ends in .csv" in wrong.stderr
