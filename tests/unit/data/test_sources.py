from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from drives import record, write_drive, write_tub

from lanenet.data.drives.folder import DriveWriter
from lanenet.data.drives.sources import open_source
from lanenet.errors import DriveFormatError
from lanenet.onboard.bench import example_camera


def picture(value: int) -> np.ndarray:
    return np.full((48, 64, 3), value, np.uint8)


def test_one_photo(tmp_path: Path) -> None:
    path = tmp_path / "Photo.PNG"
    cv2.imwrite(str(path), picture(7))
    source = open_source(path)
    assert len(source) == 1 and source.starts.all()
    assert np.isnan(source.t_s).all()
    assert (source.image(0) == 7).all()


def test_images_of_a_drive_are_photos_with_a_word(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "lap", 3)
    photos = open_source(drive / "images")
    assert len(photos) == 3 and photos.starts.all()
    assert len(photos.problems) == 1 and photos.problems[0].endswith(f"type {drive}")
    (tmp_path / "mycar" / "data").mkdir(parents=True)
    tub = write_tub(tmp_path / "mycar" / "data" / "tub_1", [record(0)])
    with pytest.raises(DriveFormatError, match=f"found none of them; there is a drive in it: type {tub}"):
        open_source(tmp_path / "mycar")


def test_folder_of_photos_in_order_of_names(tmp_path: Path) -> None:
    for name, value in (("b.png", 2), ("a.png", 1), ("c.png", 3)):
        cv2.imwrite(str(tmp_path / name), picture(value))
    (tmp_path / "._a.png").write_bytes(b"left by a copy")
    (tmp_path / "notes.txt").write_text("not a photo")
    source = open_source(tmp_path)
    assert [int(source.image(i)[0, 0, 0]) for i in range(len(source))] == [1, 2, 3]
    assert source.starts.all()


def test_drive_brings_camera_times_and_rate(tmp_path: Path) -> None:
    camera = example_camera()
    rng = np.random.default_rng(0)
    with DriveWriter(tmp_path / "drive", camera=camera, lane_width_cm=38.0) as writer:
        for i in range(4):
            frame = rng.integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
            writer.add(frame, 0.1 * i, speed_cm_s=50.0, steering_rad=0.0)
    source = open_source(tmp_path / "drive")
    assert len(source) == 4
    assert source.camera is not None and source.camera.hash == camera.hash
    assert source.lane_width_cm == 38.0
    assert source.rate_hz == pytest.approx(10.0)
    assert not source.starts[1:].any()
    assert source.image(3).shape == (240, 320, 3)


def test_video(tmp_path: Path) -> None:
    path = tmp_path / "drive.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (64, 48))
    for value in (40, 90, 140):
        writer.write(picture(value))
    writer.release()
    source = open_source(path)
    assert len(source) == 3
    assert source.rate_hz == pytest.approx(25.0)
    assert float(source.image(2).mean()) == pytest.approx(140.0, abs=6.0)


@pytest.mark.parametrize("name", ["donkey_circuit", "garage_tape", "usi_mat"])
def test_real_tubs(shared_data: Path, name: str) -> None:
    source = open_source(shared_data / name)
    assert len(source) > 900
    assert source.camera is None
    assert source.image(10).shape == (source.image(0).shape)
