"""Frames that show the lines elsewhere than the map are found, and only those and their neighbours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from datagen.quality.residuals import contradicted_lines
from lanenet.data.drives.recording import Commands, Drive
from lanenet.data.maps.folder import FORMAT, DriveMap, MapMeta
from lanenet.data.maps.line import LaneLine, Side
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.frames import car_from_map
from lanenet.perception.edges.road import PerceptionSettings

N, STEP_CM, TAPE_CM = 72, 3.0, 2.4
CAMERA = Camera(
    "fisheye",
    160,
    120,
    np.array([[70.0, 0.0, 79.5], [0.0, 70.0, 59.5], [0.0, 0.0, 1.0]]),
    np.zeros(4),
    Mounting(15.0, pitch_down_rad=0.4, ahead_of_front_axle_cm=-3.0),
    17.0,
)


class _Pictures:
    def __init__(self, images: list[np.ndarray]) -> None:
        self.images = images

    def read(self, row: int) -> np.ndarray:
        return self.images[row]


def _poses() -> np.ndarray:
    return np.column_stack([STEP_CM * np.arange(N), np.zeros(N), np.zeros(N)])


def _picture(pose: np.ndarray, aside_cm: np.ndarray, paint: np.ndarray) -> np.ndarray:
    """Two tapes along the map's x axis, at 18 cm on either side and each moved by so much, if it is there."""
    image = np.full((120, 160), 60, np.uint8)
    along = pose[0] + np.arange(10.0, 150.0, 2.0)
    for y, moved_cm in zip(np.array([18.0, -18.0])[paint], aside_cm[paint], strict=True):
        borders = []
        for half in (0.5, -0.5):
            place = np.column_stack([along, np.full(len(along), y + moved_cm + half * TAPE_CM)])
            borders.append(CAMERA.project_ground(car_from_map(place, pose, CAMERA.wheelbase_cm)))
        outline = np.concatenate([borders[0], borders[1][::-1]])
        outline = outline[np.isfinite(outline).all(axis=1)]
        cv2.fillPoly(image, [np.rint(outline * 16.0).astype(np.int32)], 220, cv2.LINE_AA, shift=4)
    return cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 0.7), cv2.COLOR_GRAY2BGR)


def _line(side: Side, y_cm: float) -> LaneLine:
    knots = np.concatenate([np.full(3, -100.0), np.linspace(-100.0, 500.0, 11), np.full(3, 500.0)])
    s = np.array([knots[i + 1 : i + 4].mean() for i in range(13)])
    control = np.column_stack([s, np.full(13, y_cm)])
    return LaneLine(side, knots, control, np.array([[-100.0, 500.0]]), 0.1, marking_cm=TAPE_CM)


def _mapped(aside_cm: np.ndarray, painted: np.ndarray | None = None) -> MappedDrive:
    """A map of two lines; per frame, by how far the left and the right tape lie beside them."""
    aside_cm = np.broadcast_to(aside_cm.T, (2, N)).T
    painted = np.ones((N, 2), dtype=bool) if painted is None else painted
    poses, t_s = _poses(), 0.05 * np.arange(N)
    images = [_picture(*shown) for shown in zip(poses, aside_cm, painted, strict=True)]
    none = np.zeros(N, dtype=bool)
    drive = Drive(
        "made-up", Path("made-up"), np.arange(N), t_s, True, Commands(), none, none, None, 36.0, (),
        160, 120, _Pictures(images), np.arange(N),
    )  # fmt: skip
    drive_map = DriveMap(
        meta=MapMeta(
            format=FORMAT, drive="made-up", lane_width_cm=36.0, mapped_lane_cm=36.0, tape_cm=TAPE_CM,
            scale_from="camera", laps=0,
        ),
        camera=CAMERA,
        frames=np.arange(N),
        t_s=t_s,
        poses=poses,
        lap=np.zeros(N, np.int64),
        segment=np.zeros(N, np.int64),
        s_cm=poses[:, 0],
        match=np.full(N, 0.6),
        lines={0: [_line("left", 18.0), _line("right", -18.0)]},
        tilt_rad=np.zeros((N, 2)),
        held_out=np.zeros(N, dtype=bool), contradicted=np.zeros((N, 2), dtype=bool),
    )  # fmt: skip
    return MappedDrive(drive_map, drive, np.arange(N), PerceptionSettings())


WRONG = (np.arange(N) >= 30) & (np.arange(N) < 45)
NEAR = (np.arange(N) >= 22) & (np.arange(N) < 53)


def _darkened(mapped: MappedDrive, markings: Literal["light", "dark"]) -> MappedDrive:
    """The same tapes, dark on a light floor, on a map that says what they are."""
    drive, drive_map = mapped.drive, mapped.drive_map
    images = [255 - drive.image(k) for k in range(N)]
    meta = drive_map.meta.model_copy(update={"markings": markings})
    return replace(
        mapped,
        drive=replace(drive, images=_Pictures(images)),
        drive_map=replace(drive_map, meta=meta),
    )


def test_frames_that_agree_are_left_alone():
    assert not contradicted_lines(_mapped(np.where(WRONG, 0.15, 0.0))).any()


def test_dark_lines_are_where_the_image_darkens_towards_them():
    right = _mapped(np.where(WRONG, 2.5, 0.0))
    found = contradicted_lines(_darkened(right, "dark"))
    np.testing.assert_array_equal(found, contradicted_lines(right))
    assert contradicted_lines(_darkened(right, "light")).mean() > 0.8


@pytest.mark.parametrize("aside_cm", [2.5, -2.5, 7.0])
def test_lines_that_lie_elsewhere_are_found(aside_cm):
    found = contradicted_lines(_mapped(np.where(WRONG, aside_cm, 0.0)))
    assert found[WRONG].all()
    assert not found[~NEAR].any()


def test_lines_that_are_not_there_are_found():
    found = contradicted_lines(_mapped(np.zeros(N), np.column_stack([~WRONG, ~WRONG])))
    assert found[WRONG].all()
    assert not found[~NEAR].any()


@pytest.mark.parametrize("side", [0, 1])
def test_one_line_that_lies_elsewhere_is_found_and_the_other_one_is_left_alone(side):
    aside_cm = np.zeros((N, 2))
    aside_cm[WRONG, side] = 2.5
    found = contradicted_lines(_mapped(aside_cm))
    assert found[WRONG, side].all()
    assert not found[~NEAR, side].any() and not found[:, 1 - side].any()


@pytest.mark.parametrize("side", [0, 1])
def test_one_line_may_be_interrupted(side):
    painted = np.ones((N, 2), dtype=bool)
    painted[WRONG, side] = False
    assert not contradicted_lines(_mapped(np.zeros(N), painted)).any()


def test_a_line_that_is_not_there_goes_with_the_one_that_lies_elsewhere():
    painted = np.column_stack([np.ones(N, dtype=bool), ~WRONG])
    found = contradicted_lines(_mapped(np.where(WRONG, 2.5, 0.0), painted))
    assert found[WRONG].all()
