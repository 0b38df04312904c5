"""Poses that are written as frames come, the trajectory and picture at the end, and the command for it."""

from __future__ import annotations

import math
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from tum import read_tum
from typer.testing import CliRunner

from datagen.localise.live_filter import LiveFrame, StartSettings, live_frames
from datagen.localise.localise import HEADER, LiveCanvas, localise
from datagen.settings import MapSettings
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.cli.app import app
from lanenet.cli.research.localise import CameraFrames, _show
from lanenet.data.camera_file import read_camera
from lanenet.data.drives import open_drive, read_truth
from lanenet.errors import HardwareError, LanenetError, TrackingLostError
from lanenet.onboard.devices import Frame, SourceEnded

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


def test_every_pose_is_on_disk_before_the_next_frame_comes(simulated, tmp_path, capsys):
    drive, out = open_drive(simulated), tmp_path / "new" / "poses.csv"
    written: list[int] = []

    def watched():
        for frame in live_frames(drive):
            written.append(len(rows_of(out)) if out.exists() else 0)
            yield frame

    report = localise(watched(), drive.camera, SETTINGS, out, KNOWN)
    assert written == list(range(len(drive)))
    assert (report.frames, report.poses, report.segments, report.localiser.standing) == (70, 70, 1, 0)
    rows = rows_of(out)
    t_s, poses = read_tum(out.with_suffix(".tum"))
    np.testing.assert_allclose(t_s, drive.t_s, atol=1e-6)
    np.testing.assert_allclose(poses, [[float(v) for v in row[2:5]] for row in rows], atol=1e-3)
    truth = read_truth(simulated)
    true_way = np.hypot(np.diff(truth["x_cm"]), np.diff(truth["y_cm"])).sum()
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() == pytest.approx(true_way, rel=0.06)
    assert 0.0 < report.median_ms <= report.p99_ms and report.localiser.map_bytes > 1e6
    picture = cv2.imread(str(report.picture))
    assert (picture == 255).all(axis=2).sum() > 50
    _show(replace(report, median_ms=math.nan, p99_ms=math.nan))
    assert "nan" not in capsys.readouterr().out


def test_ctrl_c_ends_the_drive_and_keeps_what_was_driven(simulated, tmp_path):
    drive, out = open_drive(simulated), tmp_path / "poses.csv"

    def stopped():
        for frame in live_frames(drive):
            if frame.frame == 12:
                raise KeyboardInterrupt
            yield frame

    assert localise(stopped(), drive.camera, SETTINGS, out, KNOWN).poses == 12
    assert len(rows_of(out)) == len(read_tum(out.with_suffix(".tum"))[0]) == 12
    assert out.with_suffix(".png").is_file()


def test_an_error_leaves_the_poses_so_far_and_no_half_trajectory(simulated, tmp_path):
    drive, out = open_drive(simulated), tmp_path / "poses.csv"

    def torn():
        for frame in live_frames(drive):
            if frame.frame == 12:
                raise LanenetError("the camera is gone")
            yield frame

    with pytest.raises(LanenetError, match="the camera is gone"):
        localise(torn(), drive.camera, SETTINGS, out, KNOWN)
    assert len(rows_of(out)) == 12
    assert [path.name for path in tmp_path.iterdir()] == ["poses.csv"]


def test_nothing_to_see_is_said(simulated, tmp_path):
    drive = open_drive(simulated)
    blind = (LiveFrame(m.frame, m.t_s, None, m.commands) for m in live_frames(drive))
    with pytest.raises(TrackingLostError, match="0 frames of a moving car"):
        localise(blind, drive.camera, SETTINGS, tmp_path / "poses.csv")
    (tmp_path / "file").touch()
    with pytest.raises(LanenetError, match="is a file, expected a folder"):
        localise(live_frames(drive), drive.camera, SETTINGS, tmp_path / "file" / "poses.csv", KNOWN)


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
    assert "70 poses of 70 frames, 1 segment;" in result.output and "frames/s" in result.output
    assert "gain of the speed 1.000" in result.output and len(rows_of(out)) == 70
    # The map's own settings and camera will do, too.
    assert read_camera(simulated / "camera.yaml").hash == open_drive(simulated).camera.hash
    wrong = invoke(simulated, "--out", tmp_path / "poses.txt")
    assert wrong.exit_code == 1 and "ends in .csv" in wrong.stderr


@pytest.fixture
def car(simulated, tmp_path) -> Path:
    """A car whose camera is a replayed drive, at the pace at which it was recorded or near it."""
    config = {
        "source": {"kind": "replay", "path": str(simulated), "pace": "real", "rate_hz": 40.0, "loop": True},
        "camera": str(simulated / "camera.yaml"),
        "detector": {"kind": "lane-filter", "lane_width_cm": 35.0},
        "control": {},
    }
    path = tmp_path / "car.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


class Replayed:
    """A source of given frames; then a failure, or the end."""

    def __init__(self, frames: list[Frame | None], failure: Exception | None = None) -> None:
        self.frames, self.failure = list(frames), failure
        self.opened = self.closed = 0

    def open(self) -> None:
        self.opened += 1

    def read(self, timeout_s: float) -> Frame | None:
        if self.frames:
            return self.frames.pop(0)
        raise SourceEnded("over") if self.failure is None else self.failure

    def close(self) -> None:
        self.closed += 1


def frames_at(*rows: tuple[int, float]) -> list[Frame | None]:
    return [Frame(np.full((4, 6, 3), number, np.uint8), t_s, number) for number, t_s in rows]


def test_a_running_camera_gives_frames_at_the_speed_that_is_meant():
    rows = frames_at((0, 5.0), (1, 5.1), (4, 5.4))
    source = Replayed([rows[0], None, *rows[1:]])
    frames = CameraFrames(source, 50.0)
    taken = list(frames)
    assert [(m.frame, m.t_s, m.starts) for m in taken] == [(0, 5.0, False), (1, 5.1, False), (4, 5.4, False)]
    assert all(m.image is row.image_bgr for m, row in zip(taken, rows, strict=True))
    assert all(m.commands.speed_cm_s == [50.0] and m.commands.steering_rad is None for m in taken)
    assert frames.skipped == 2 and frames.failure is None and (source.opened, source.closed) == (1, 1)


def test_a_frame_stamped_before_the_last_one_is_left_out():
    frames = list(CameraFrames(Replayed(frames_at((0, 1.0), (1, 1.0), (2, 0.9), (3, 1.1))), 50.0))
    assert [m.frame for m in frames] == [0, 3]


def test_as_many_frames_as_asked():
    source = Replayed(frames_at(*((k, 0.1 * k) for k in range(9))))
    assert [m.frame for m in CameraFrames(source, 50.0, 4)] == [0, 1, 2, 3] and source.closed == 1


def test_a_signal_ends_the_frames_and_the_camera_is_let_go():
    source, numbers = Replayed(frames_at(*((k, 0.1 * k) for k in range(9)))), []
    for frame in CameraFrames(source, 50.0):
        numbers.append(frame.frame)
        if frame.frame == 3:
            signal.raise_signal(signal.SIGTERM)
    assert numbers == [0, 1, 2, 3] and source.closed == 1
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_camera_that_is_lost_ends_the_frames_and_is_told():
    frames = CameraFrames(Replayed(frames_at((0, 0.0), (1, 0.1)), HardwareError("cam: lost for 60 s")), 50.0)
    assert len(list(frames)) == 2
    assert str(frames.failure) == "cam: lost for 60 s"


def test_a_filter_that_is_too_slow_for_its_camera_keeps_to_the_way(simulated, tmp_path):
    """Frames that were left out make the next way longer, and the speed's gain is what the truth says."""
    drive, truth = open_drive(simulated), read_truth(simulated)
    kept = [k for k in range(len(drive)) if k % 3 != 1]
    source = Replayed([Frame(drive.image(k), float(drive.t_s[k]), k) for k in kept])
    way_cm = np.hypot(*(np.diff(truth[name][kept]) for name in ("x_cm", "y_cm"))).sum()
    speed_cm_s = way_cm / (drive.t_s[kept[-1]] - drive.t_s[0])
    frames = CameraFrames(source, speed_cm_s)
    report = localise(frames, drive.camera, SETTINGS, tmp_path / "poses.csv", KNOWN)
    assert (report.frames, report.poses, report.segments) == (len(kept), len(kept), 1)
    assert frames.skipped == len(drive) - len(kept) and report.speed_known
    _, poses = read_tum(report.trajectory)
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() == pytest.approx(way_cm, rel=0.06)


def test_the_live_command(simulated, car, tmp_path):
    few, out = tmp_path / "few.yaml", tmp_path / "poses.csv"
    few.write_text("filter: {particles: 40}\n")
    words = ["--live", car, "--config", few, "--factor", 1.0, "--frames", 20, "--out", out]
    result = CliRunner().invoke(app, ["localise", *map(str, words)])
    assert result.exit_code == 0, result.output
    assert "of 20 frames" in result.output and "gain of the speed 1.000" in result.output
    rows = rows_of(out)
    numbers = np.array([int(row[0]) for row in rows])
    # However busy the machine is: each frame once, numbers and times are the camera's.
    assert len(rows) > 10 and (np.diff(numbers) > 0).all()
    np.testing.assert_allclose(np.diff([float(row[1]) for row in rows]), np.diff(numbers) / 40.0, atol=2e-6)
    assert out.with_suffix(".png").is_file() and out.with_suffix(".tum").is_file()


def test_either_a_recording_or_a_running_camera(simulated, car, tmp_path):
    def said(*words: object) -> str:
        result = CliRunner().invoke(app, ["localise", *map(str, words), "--out", str(tmp_path / "p.csv")])
        assert result.exit_code == 1
        return result.stderr

    assert "expected either SOURCE or --live CONFIG, found both" in said(simulated, "--live", car)
    assert "expected either SOURCE or --live CONFIG, found neither" in said()
    blind = tmp_path / "blind.yaml"
    blind.write_text(car.read_text().replace("control: {}", "control: {steering: {wheelbase_cm: 17}}"))
    text = "".join(line for line in blind.read_text().splitlines(True) if not line.startswith("camera"))
    blind.write_text(text)
    assert "key 'camera' is missing" in said("--live", blind)
