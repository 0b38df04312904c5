"""Which drives had the same camera, and which maps lie on one another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_map import CAMERA

from datagen.tracks import join
from datagen.tracks.align import Alignment
from datagen.tracks.cameras import DriveCamera
from datagen.tracks.car import agreeing_drives
from datagen.tracks.recognise import Recognised
from datagen.tracks.shape import Similarity
from datagen.tracks.visit import Visit
from lanenet.errors import LanenetError

SIGMA = {"focal": 0.01, "pitch": 0.01, "cx": 0.5, "cy": 0.5, "k1": 0.005, "roll": 0.004, "yaw": 0.008}


def found(pitch_rad: float = 0.25, focal_sigma: float = 0.01, width: int | None = None) -> DriveCamera:
    camera = CAMERA.with_mounting(pitch_down_rad=pitch_rad)
    if width is not None:
        camera = replace(camera, width=width)
    return DriveCamera("drive", camera, {**SIGMA, "focal": focal_sigma})


def test_the_most_drives_agree_and_come_in_the_order_of_what_they_know():
    cameras = [found(0.25, 0.02), found(0.40, 0.001), found(0.26, 0.01), found(0.255, 0.03)]
    agreeing, odd = agreeing_drives(cameras)
    assert agreeing == [2, 0, 3]
    assert [(one.place, one.than) for one in odd] == [(1, 2)] and "most in pitch" in odd[0].text


def test_a_chain_of_cameras_that_differ_at_its_ends_is_not_one_camera():
    agreeing, odd = agreeing_drives([found(0.25), found(0.28), found(0.31)])
    # 0.03 rad are two sigmas of both, 0.06 rad four.
    assert agreeing == [0, 1] and [one.place for one in odd] == [2]


def test_images_of_another_size_are_of_another_camera_and_one_drive_agrees_with_itself():
    agreeing, odd = agreeing_drives([found(), found(width=320), found()])
    assert agreeing == [0, 2] and odd[0].text == "images of another size or lens"
    assert agreeing_drives([found()]) == ([0], [])


def visit(name: str) -> Visit:
    """A map of which nothing but its folder is looked at; its first letters say its track."""
    one = object.__new__(Visit)
    one.__dict__.update(folder=Path(name), mapped=None)
    return one


@pytest.fixture
def by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps are of one track if their names begin alike."""

    def recognise(one: Path, other: Path, drives: Any) -> Recognised:
        same = one.name[0] == other.name[0]
        alignment = Alignment(Similarity(), False, np.zeros(1), np.zeros(1), 0.0)
        sentence = f"{one.name} beside {other.name}"
        return Recognised("same" if same else "different", sentence, alignment if same else None)

    monkeypatch.setattr(join, "read_shape", lambda folder: folder)
    monkeypatch.setattr(join, "recognise", recognise)


def test_the_most_maps_that_lie_on_one_another_are_joined_and_the_others_named(by_name: None):
    visits = {name: visit(name) for name in ("x1", "hall1", "yard", "hall2", "hall3", "x2")}
    placed, left_out = join._largest_track(visits, lambda *_: None)
    assert list(placed) == ["hall1", "hall2", "hall3"]
    assert list(left_out) == ["x1", "yard", "x2"]
    assert left_out["yard"] == "is of another track: yard beside hall1"
    # It came first, and the others were laid on it.
    assert left_out["x1"] == "is of another track: hall1 beside x1"


def test_no_two_maps_of_one_track_are_refused(by_name: None, tmp_path: Path):
    visits = {name: visit(name) for name in ("hall", "yard")}
    with pytest.raises(LanenetError, match=r"no two of 2 maps are joined: .*yard beside hall"):
        join.join_fitting(visits, tmp_path / "out")
    assert not (tmp_path / "out").exists()
