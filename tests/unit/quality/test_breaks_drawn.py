"""Stretches that lie on one map are drawn apart: nobody drove from one to the next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from datagen.quality.figures import steering_answer
from datagen.quality.pictures import draw_map
from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.settings import GuessSettings
from lanenet.data.drives.recording import Commands, Drive, ImageFiles
from lanenet.data.maps.folder import FORMAT, DriveMap, MapMeta
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.perception.edges.road import PerceptionSettings

CAMERA = guessed_camera(160, 120, 80.0, 15.0, GuessSettings())
#: Frames of the drive; of its four runs the third is not on the map, and the second in one of its own.
N, BREAKS = 80, [10, 20, 25]
ROWS = np.delete(np.arange(N), np.arange(20, 25))
STARTS = [0, 10, 20]


@pytest.fixture
def mapped() -> MappedDrive:
    """The runs start 200 cm apart, on parallel paths, 2 cm per frame."""
    run = np.repeat([0, 1, 3], [10, 10, 55])
    since = np.concatenate([np.arange(10), np.arange(10), np.arange(55)])
    poses = np.column_stack([2.0 * since, 200.0 * run, 0.0 * since])
    n = len(ROWS)
    drive_map = DriveMap(
        meta=MapMeta(
            format=FORMAT,
            drive="made-up",
            lane_width_cm=40.0,
            mapped_lane_cm=40.0,
            tape_cm=2.0,
            scale_from="camera",
            laps=0,
        ),
        camera=CAMERA,
        frames=ROWS,
        t_s=0.05 * ROWS,
        poses=poses,
        lap=np.zeros(n, np.int64),
        segment=np.where(run == 1, 1, 0),
        s_cm=2.0 * np.arange(n),
        match=np.full(n, 0.6),
        lines={},
        tilt_rad=np.zeros((n, 2)),
        held_out=np.zeros(n, dtype=bool),
        errors=LabelErrors.none(n),
    )
    drive = Drive(
        name="made-up",
        path=Path("made-up"),
        frames=np.arange(N),
        t_s=0.05 * np.arange(N),
        times_trusted=True,
        commands=Commands(angle=np.sin(0.3 * np.arange(N))),
        deleted=np.zeros(N, dtype=bool),
        breaks=np.isin(np.arange(N), BREAKS),
        camera=None,
        lane_width_cm=None,
        problems=(),
        width=160,
        height=120,
        images=ImageFiles([]),
        rows=np.arange(N),
    )
    return MappedDrive(drive_map, drive, ROWS, PerceptionSettings())


def test_a_run_starts_at_a_break_and_after_one_that_was_left_out(mapped):
    np.testing.assert_array_equal(np.flatnonzero(mapped.starts), STARTS)


def test_the_path_is_not_drawn_across_a_break(tmp_path, mapped):
    clouds = [np.empty((0, 2))] * len(ROWS)
    draw_map(tmp_path / "map.png", mapped.drive_map, clouds, mapped.starts)
    image = cv2.imread(str(tmp_path / "map.png"))
    # Left of the metre of scale in the corner there is nothing else that is white.
    white = (image > 200).all(axis=2)[: image.shape[0] - 80]
    scale = 1600 / 640.0
    rows = np.flatnonzero(white.any(axis=1))
    expected = image.shape[0] - 1 - scale * (20.0 + np.array([200.0, 600.0]))
    assert np.min(np.abs(rows[:, None] - expected), axis=1).max() <= 2.0
    assert {int(np.abs(expected - row).argmin()) for row in rows} == {0, 1}
    # The run between them is a segment of its own, and nothing lies above or below it.
    first, second = (
        np.flatnonzero(white[np.rint(row).astype(int) - 2 :][:5].any(axis=0)) for row in expected
    )
    assert first.min() > second.max()


@pytest.mark.parametrize("sign", [1.0, -1.0, None])
def test_steering_that_turns_the_car_the_other_way_is_noticed(mapped, sign):
    """The car turns as it is steered, the other way round, or for reasons of its own; two frames later."""
    n = len(ROWS)
    steered = mapped.drive.commands.angle[np.maximum(ROWS - 2, 0)]
    # Donkeycar's angle is positive to the right.
    turn = np.random.default_rng(0).normal(size=n) if sign is None else -sign * steered
    heading = 0.05 * np.cumsum(turn)
    poses = np.cumsum(2.0 * np.column_stack([np.cos(heading), np.sin(heading), 0.0 * heading]), axis=0)
    poses[:, 2] = heading
    turned = replace(mapped, drive_map=replace(mapped.drive_map, poses=poses))
    found = steering_answer(turned)
    assert found is None if sign is None else abs(found - sign) < 0.05
    blind = replace(mapped, drive=replace(mapped.drive, commands=Commands()))
    assert steering_answer(blind) is None
