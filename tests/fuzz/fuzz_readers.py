"""Every reader of files, with files that it accepts."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from bags import usual, write_bag, write_foxglove
from cameras import ROS_FILE, make_camera
from drives import CAMERA, frame_image, record, write_drive, write_tub, write_video
from synthetic_labels import WINDOW, make_label_set

from datagen.judge.contest import read_run, read_trajectory
from datagen.judge.run import RunResult
from datagen.judge.settings import JudgeSettings
from datagen.settings import MapSettings
from datagen.world.road.track import Marking, Track, read_track, write_track
from datagen.world.road.track_settings import load_track_settings
from datagen.world.world import SimulationSettings
from lanenet.calibration.chessboard import read_picture
from lanenet.cli.calibrate import _read_points
from lanenet.cli.train import run_settings_schema
from lanenet.config import dump_settings, load_settings
from lanenet.data.camera_file import read_camera, read_lens, write_camera
from lanenet.data.drives import open_drive, read_truth
from lanenet.data.drives.folder import TRUTH_NAMES, DriveWriter
from lanenet.data.drives.sources import open_source, read_mask
from lanenet.data.files import write_json
from lanenet.data.label_set import read_labels, write_labels
from lanenet.data.maps.folder import FORMAT, DriveMap, MapMeta, read_map, write_map
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.line import LaneLine, Side
from lanenet.data.tables import write_csv
from lanenet.geometry.camera import Mounting
from lanenet.learn.checkpoint import METRICS_FORMAT, read_finished
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.export import export_onnx, read_network, read_rasters, write_rasters, write_weights
from lanenet.learn.network import new_network
from lanenet.onboard.actuators.myconfig import settings_from_myconfig
from lanenet.onboard.drive import load_drive_settings
from lanenet.perception.hough.detector import HoughSettings
from lanenet.perception.network.model_file import ModelMeta, open_model

MYCONFIG = """
DRIVE_TRAIN_TYPE = "PWM_STEERING_THROTTLE"
PWM_STEERING_THROTTLE = {
    "PWM_STEERING_PIN": "PCA9685.1:40.1", "PWM_STEERING_SCALE": 1.0, "PWM_STEERING_INVERTED": False,
    "PWM_THROTTLE_PIN": "PCA9685.1:40.0", "PWM_THROTTLE_SCALE": 1.0, "PWM_THROTTLE_INVERTED": False,
    "STEERING_LEFT_PWM": 460, "STEERING_RIGHT_PWM": 290,
    "THROTTLE_FORWARD_PWM": 500, "THROTTLE_STOPPED_PWM": 370, "THROTTLE_REVERSE_PWM": 220,
}
"""
ROOT = Path(__file__).resolve().parents[2]
SIZE = {"channels": (4, 8), "hidden": 8, "bins": 0}


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes:
        make: Writes what it accepts into a folder.
        read: Reads it, all of it.
        anywhere: Whether the files may name files in any folder: a person wrote them for this computer.
    """

    make: Callable[[Path], object]
    read: Callable[[Path], object]
    anywhere: bool = False


def copied(name: str) -> Callable[[Path], object]:
    return lambda folder: shutil.copy(ROOT / "configs" / name, folder / "file.yaml")


def copied_car(folder: Path) -> None:
    """A car's file, whose paths count from it."""
    text = (ROOT / "configs" / "car" / "replay.yaml").read_text()
    (folder / "file.yaml").write_text(text.replace("../../", f"{ROOT}/"))


def settings(schema: Callable[[], type[Any]], name: str) -> Reader:
    return Reader(copied(name), lambda folder: load_settings(schema(), folder / "file.yaml"))


def images(folder: Path) -> None:
    drive = open_drive(folder)
    for k in range(min(len(drive), 3)):
        drive.image(k)


def make_truth(folder: Path) -> None:
    with DriveWriter(folder / "drive", CAMERA, lane_width_cm=40.0) as writer:
        for k in range(3):
            writer.add(frame_image(k), 0.05 * k, truth={n: float(j + k) for j, n in enumerate(TRUTH_NAMES)})


def make_map(folder: Path) -> None:
    folder.mkdir()
    n, rng = 12, np.random.default_rng(0)
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 200.0, 11), np.full(3, 200.0)])

    def line(side: Side, y_cm: float) -> LaneLine:
        control = np.column_stack([np.linspace(0.0, 200.0, 13), np.full(13, y_cm)])
        return LaneLine(side, knots, control, np.array([[0.0, 200.0]]), 0.1)

    lane = DriveMap(
        meta=MapMeta(
            format=FORMAT,
            drive="drive",
            lane_width_cm=36.0,
            mapped_lane_cm=36.0,
            tape_cm=2.0,
            scale_from="x",
            laps=0,
        ),
        camera=CAMERA,
        frames=np.arange(n),
        t_s=0.05 * np.arange(n),
        poses=np.column_stack([np.linspace(0.0, 60.0, n), np.zeros((n, 2))]),
        lap=np.zeros(n, np.int64),
        segment=np.zeros(n, np.int64),
        s_cm=np.linspace(0.0, 60.0, n),
        match=rng.uniform(0.2, 0.9, n),
        lines={0: [line("left", 18.0), line("right", -18.0)]},
        tilt_rad=np.zeros((n, 2)),
        held_out=np.zeros(n, bool),
        errors=LabelErrors.none(n),
    )
    write_map(folder, lane, {"frame": np.arange(3)}, {"frames": n}, "by hand")


def read_whole_map(folder: Path) -> None:
    found = read_map(folder)
    found.camera_at(0)
    assert len(found.lanes.lane) == len(found.frames)


def make_track(folder: Path) -> None:
    s = np.arange(0.0, 100.0)
    painted = np.array([[0.0, 40.0], [50.0, 90.0]])
    track = Track(
        s_cm=s,
        xy_cm=np.column_stack([s, np.zeros(100)]),
        heading_rad=np.zeros(100),
        curvature_per_cm=np.zeros(100),
        closed=False,
        lane_width_cm=40.0,
        markings=(Marking(20.0, 2.0, (250.0, 250.0, 250.0), painted),),
    )
    write_track(folder / "track.json", track)


def make_run(folder: Path) -> None:
    result = RunResult("truth", "open", 0, 1, True, "completed", 1.0, 0, 0, 0.1, 0.2, 0.1, 0.0, 3, 0.1)
    write_json(folder / "run.json", {"key": "k", **vars(result)})
    names = ("t_s", "x_cm", "y_cm", "s_cm", "offset_cm", "steering_rad")
    flags = dict.fromkeys(("answered", "over", "put_back"), np.zeros(3, bool))
    write_csv(folder / "run.csv", {**{name: np.arange(3) * 0.5 for name in names}, **flags})


def read_whole_run(folder: Path) -> None:
    if read_run(folder / "run.json", "k") is not None:
        read_trajectory(folder / "run.json")


def make_checkpoint(folder: Path) -> None:
    sized = NetworkSettings(**SIZE)
    network = new_network(sized, WINDOW.rows, WINDOW.columns, 0).eval()
    network.mean_cm.copy_(torch.tensor([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0]))
    meta = ModelMeta(WINDOW, ("any",), 26.0, 40.0, "abc", (1.0,) * 6, "truth", planes=5)
    labels = make_label_set(2, 0)
    rasters = np.stack([labels.raster(k) for k in range(2)])
    (folder / "config.yaml").write_text(dump_settings(LearnSettings(network=sized)))
    (folder / "checkpoint.yaml").write_text("format: lanenet-checkpoint/1\nname: x\n")
    write_json(folder / "metrics.json", {"format": METRICS_FORMAT, "run_hash": "x", "val_rmse_cm": 1.0})
    write_weights(folder / "weights.safetensors", network, meta)
    write_rasters(folder / "check_rasters.png", rasters)
    export_onnx(network, meta, rasters, folder / "model.onnx")


def read_checkpoint(folder: Path) -> None:
    _, meta = read_network(folder)
    read_rasters(folder / "check_rasters.png", meta)
    read_finished(folder, "x")


def make_model(folder: Path) -> None:
    make_checkpoint(folder)
    for path in folder.iterdir():
        if path.name != "model.onnx":
            path.unlink()


def photo(name: str) -> Callable[[Path], object]:
    return lambda folder: cv2.imwrite(str(folder / name), np.full((48, 64, 3), 90, np.uint8))


def make_video(folder: Path) -> None:
    write_video(folder / "lap.avi", 6)
    (folder / "lap.csv").write_text("frame,t_s,throttle\n0,0.0,0.1\n1,0.05,0.2\n4,0.2,0.3\n")


OPENCV_FILE = (ROOT / "tests/support/cases/camera_opencv_filestorage/opencv.yml").read_text()


def make_ros(folder: Path) -> None:
    (folder / "info.yaml").write_text(ROS_FILE)


READERS: dict[str, Reader] = {
    "training": settings(run_settings_schema, "small.yaml"),
    "simulation": settings(lambda: SimulationSettings, "drives/example.yaml"),
    "hough": settings(lambda: HoughSettings, "detectors/hough_value.yaml"),
    "contest": Reader(
        lambda f: (f / "file.yaml").write_text(dump_settings(JudgeSettings())),
        lambda f: load_settings(JudgeSettings, f / "file.yaml"),
    ),
    "mapping": Reader(
        lambda f: (f / "file.yaml").write_text(dump_settings(MapSettings())),
        lambda f: load_settings(MapSettings, f / "file.yaml"),
    ),
    "car": Reader(copied_car, lambda f: load_drive_settings(f / "file.yaml"), anywhere=True),
    "road": Reader(copied("tracks/town.yaml"), lambda f: load_track_settings(f / "file.yaml"), anywhere=True),
    "camera": Reader(
        lambda f: write_camera(f / "camera.yaml", make_camera(), "by hand"),
        lambda f: read_camera(f / "camera.yaml").intersect_ground(np.zeros((4, 2))),
    ),
    "opencv camera": Reader(
        lambda f: (f / "lens.yml").write_text(OPENCV_FILE),
        lambda f: read_lens(f / "lens.yml", Mounting(20.0), 26.0),
    ),
    "ros camera": Reader(make_ros, lambda f: read_lens(f / "info.yaml", Mounting(20.0), 26.0)),
    "folder": Reader(lambda f: write_drive(f / "drive", 3), lambda f: images(f / "drive")),
    "truth": Reader(make_truth, lambda f: read_truth(f / "drive")),
    "tub": Reader(
        lambda f: write_tub(f / "tub", [record(k) for k in range(4)], deleted=[2]),
        lambda f: images(f / "tub"),
    ),
    "video": Reader(make_video, lambda f: images(f / "lap.avi")),
    "bag": Reader(lambda f: write_bag(f / "lap", usual(4)), lambda f: images(f / "lap")),
    "bag of mcap": Reader(lambda f: write_bag(f / "lap", usual(4), "mcap"), lambda f: images(f / "lap")),
    "mcap": Reader(lambda f: write_foxglove(f / "lap.mcap", 4), lambda f: images(f / "lap.mcap")),
    "photo": Reader(photo("a.jpg"), lambda f: open_source(f / "a.jpg").image(0)),
    "tiff": Reader(photo("a.tiff"), lambda f: open_source(f / "a.tiff").image(0)),
    "webp": Reader(photo("a.webp"), lambda f: read_picture(f / "a.webp")),
    "mask": Reader(
        lambda f: cv2.imwrite(str(f / "mask.png"), np.eye(48, 64, dtype=np.uint8) * 255),
        lambda f: read_mask(f / "mask.png"),
    ),
    "labels": Reader(
        lambda f: write_labels(f / "a.parquet", make_label_set(3, 0)), lambda f: read_labels(f / "a.parquet")
    ),
    "map": Reader(lambda f: make_map(f / "map"), lambda f: read_whole_map(f / "map")),
    "track": Reader(make_track, lambda f: read_track(f / "track.json")),
    "run": Reader(make_run, read_whole_run),
    "checkpoint": Reader(make_checkpoint, read_checkpoint),
    "model": Reader(make_model, lambda f: open_model(f / "model.onnx")),
    "myconfig": Reader(
        lambda f: (f / "myconfig.py").write_text(MYCONFIG),
        lambda f: settings_from_myconfig(f / "myconfig.py"),
    ),
    "points": Reader(
        lambda f: (f / "points.csv").write_text("x_cm,y_cm,u_px,v_px\n1,20,30,40\n2,30,31,20\n"),
        lambda f: _read_points(f / "points.csv"),
    ),
}
