"""A drive before it is tracked: cut into segments, checked, its images read once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_up_drive import made_up_drive

from datagen.prepare import KeptImages, check_size, hide_bumper, split_segments
from datagen.settings import MapSettings
from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.settings import GuessSettings
from lanenet.data.drives import open_drive
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError


def test_an_uninterrupted_drive_is_one_segment():
    assert split_segments(made_up_drive(200, [])) == [slice(0, 200)]
    assert split_segments(made_up_drive(60, [])) == [slice(0, 60)]


def test_a_drive_is_cut_at_its_breaks_and_short_segments_are_left_out():
    assert split_segments(made_up_drive(400, [100, 130, 300])) == [
        slice(0, 100),
        slice(130, 300),
        slice(300, 400),
    ]


def test_a_drive_of_scraps_cannot_be_mapped():
    with pytest.raises(TrackingLostError, match=r"120 frames.* 50.*60"):
        split_segments(made_up_drive(120, [50, 90]))
    with pytest.raises(TrackingLostError, match="59 frames"):
        split_segments(made_up_drive(59, []))


def test_a_camera_of_another_size_is_refused():
    drive = made_up_drive(100, [])
    check_size(guessed_camera(160, 120, 80.0, 0.2, GuessSettings()), drive, None)
    with pytest.raises(CalibrationError, match=r"320x240.*160x120"):
        check_size(guessed_camera(320, 240, 80.0, 0.2, GuessSettings()), drive, Path("camera.yaml"))


def test_rows_in_which_the_car_sees_itself_are_left_out(shared_data: Path) -> None:
    """garage_tape shows the car's bumper in its lowest rows; the other drive shows no part of the car."""
    settings, (note,) = hide_bumper(open_drive(shared_data / "garage_tape"), MapSettings())
    assert 5 <= settings.perception.range.bottom_rows <= 9 and "sees itself" in note
    assert hide_bumper(open_drive(shared_data / "donkey_circuit"), MapSettings()) == (MapSettings(), ())
    given = MapSettings(find_bumper=False)
    assert hide_bumper(open_drive(shared_data / "garage_tape"), given) == (given, ())


class _Counting:
    """Makes an image of each row, but for row 9, and counts."""

    def __init__(self) -> None:
        self.reads: list[int] = []

    def read(self, row: int) -> np.ndarray:
        self.reads.append(row)
        if row == 9:
            raise DriveFormatError("row 9: no such image")
        return np.full((4, 5, 3), row, np.uint8)


def test_an_image_is_read_once_and_stays_as_it_was():
    source = _Counting()
    images = KeptImages(source)
    for row in (3, 1, 3, 1, 3):
        np.testing.assert_array_equal(images.read(row), np.full((4, 5, 3), row))
    assert source.reads == [3, 1]
    with pytest.raises(ValueError, match="read-only"):
        images.read(3)[0, 0] = 0


def test_what_does_not_fit_is_read_again():
    source = _Counting()
    images = KeptImages(source, most_bytes=2 * 60 + 59)
    for _ in range(2):
        for row in (0, 1, 2):
            assert images.read(row)[0, 0, 0] == row
    assert source.reads == [0, 1, 2, 2]


def test_an_image_that_cannot_be_read_is_not_kept():
    source = _Counting()
    images = KeptImages(source)
    for _ in range(2):
        with pytest.raises(DriveFormatError, match="row 9"):
            images.read(9)
    assert source.reads == [9, 9]
