"""A drive before it is tracked: cut into segments, checked, its images read once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drives import write_drive
from made_up_drive import made_up_drive

from datagen.pipeline import map_key
from datagen.prepare import (
    KeptImages,
    MapRequest,
    check_count,
    check_lens,
    check_size,
    hide_bumper,
    prepare,
    readable_frames,
    without_deleted,
)
from datagen.settings import MapSettings
from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.settings import GuessSettings
from datagen.slam.view import mapping_range, on_road
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RangeSettings, RoadTable


def test_a_drive_of_a_few_frames_cannot_be_mapped():
    check_count(made_up_drive(60, [20, 40]))
    with pytest.raises(TrackingLostError, match="59 frames"):
        check_count(made_up_drive(59, []))


@pytest.mark.parametrize("frames", [1, 3])
def test_a_handful_of_frames_is_refused_for_being_few(tmp_path, frames):
    with DriveWriter(tmp_path / "drive") as writer:
        for k in range(frames):
            writer.add(np.full((48, 64, 3), 20 * k, np.uint8), 0.05 * k)
    with pytest.raises(TrackingLostError, match=f"{frames} frame"):
        prepare(MapRequest(tmp_path / "drive", 40.0), MapSettings())


def test_only_the_frames_that_were_asked_for_are_mapped(tmp_path):
    rng = np.random.default_rng(0)
    with DriveWriter(tmp_path / "drive") as writer:
        for k in range(200):
            writer.add(rng.integers(0, 255, (48, 64, 3)).astype(np.uint8), 0.05 * k, throttle=0.2)
    prepared = prepare(MapRequest(tmp_path / "drive", 40.0, frames=(50, 149)), MapSettings())
    assert (prepared.drive.frames[0], prepared.drive.frames[-1]) == (50, 149)
    assert any("from 50 to 149" in note for note in prepared.notes)
    with pytest.raises(TrackingLostError, match="50 frames"):
        prepare(MapRequest(tmp_path / "drive", 40.0, frames=(100, 149)), MapSettings())


def test_a_floor_of_strong_texture_is_named(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    with DriveWriter(tmp_path / "drive") as writer:
        for k in range(70):
            writer.add(rng.integers(0, 255, (48, 64, 3)).astype(np.uint8), 0.05 * k, throttle=0.2)
    for most, named in ((6000, False), (100, True)):
        monkeypatch.setattr("datagen.prepare.MOST_POINTS", most)
        notes = prepare(MapRequest(tmp_path / "drive", 40.0), MapSettings()).notes
        assert any("at most 100 of a frame" in note for note in notes) == named


def test_a_map_is_known_by_all_that_it_is_made_from(tmp_path, monkeypatch):
    write_drive(tmp_path / "drive")
    write_drive(tmp_path / "other")
    drive = tmp_path / "drive"
    settings = MapSettings()
    keys = [
        map_key(request, settings)
        for request in (
            MapRequest(drive, 40.0),
            MapRequest(tmp_path / "other", 40.0),
            MapRequest(drive, 41.0),
            MapRequest(drive, 40.0, wheelbase_cm=17.0),
            MapRequest(drive, 40.0, tape_width_cm=2.0),
            MapRequest(drive, 40.0, frames=(0, 3)),
            MapRequest(drive, 40.0, drive / "camera.yaml"),
        )
    ]
    keys.append(map_key(MapRequest(drive, 40.0), MapSettings(held_out_every=0)))
    assert len(set(keys)) == len(keys)
    # Not by the folder from which it was made.
    monkeypatch.chdir(tmp_path)
    assert map_key(MapRequest(Path("drive"), 40.0), settings) == keys[0]
    with pytest.raises(DriveFormatError, match="no such drive"):
        map_key(MapRequest(tmp_path / "nowhere", 40.0), settings)


def test_a_video_without_commands_is_mapped_with_a_word(tmp_path):
    video = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    rng = np.random.default_rng(0)
    for _ in range(70):
        writer.write(cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (64, 48)))
    writer.release()

    def words() -> list[str]:
        notes = prepare(MapRequest(video, 40.0), MapSettings()).notes
        return [note for note in notes if "neither speed nor steering" in note]

    (note,) = words()
    assert f"expected in {tmp_path / 'clip.csv'}" in note
    rows = "".join(f"{k},{0.05 * k},50\n" for k in range(70))
    (tmp_path / "clip.csv").write_text(f"frame,t_s,speed_cm_s\n{rows}")
    assert not words()


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


class _Few:
    """Images of one gray level, some of which cannot be read."""

    def __init__(self, bad: set[int]) -> None:
        self.bad = bad

    def read(self, row: int) -> np.ndarray:
        if row in self.bad:
            raise DriveFormatError(f"{row}.jpg: the image file is empty")
        return np.full((120, 160, 3), 90, np.uint8)


def test_images_that_a_power_cut_left_empty_are_left_out_without_a_break():
    drive = replace(made_up_drive(100, [50], first_frame=300), images=_Few({20, 99}))
    kept, (note,) = readable_frames(drive)
    assert np.setdiff1d(drive.frames, kept.frames).tolist() == [320, 399] and kept.breaks.sum() == 1
    assert "2 images" in note and "frame 320" in note and "20.jpg" in note
    whole = replace(drive, images=_Few(set()))
    assert readable_frames(whole) == (whole, [])
    with pytest.raises(DriveFormatError, match=r"11 of 100 images.*10%.*frame 300: 0\.jpg"):
        readable_frames(replace(drive, images=_Few(set(range(11)))))


class _Lens:
    """A textured floor as a fisheye shows it: black outside a circle."""

    def __init__(self, radius_px: float) -> None:
        v, u = np.mgrid[:120, :160]
        self.outside = np.hypot(u - 79.5, v - 59.5) > radius_px

    def read(self, row: int) -> np.ndarray:
        rng = np.random.default_rng(row)
        image = rng.integers(60, 200, (120, 160, 3), dtype=np.uint8)
        image[self.outside] = rng.integers(0, 20, (int(self.outside.sum()), 3))
        return image


def test_a_full_circle_fisheye_is_named_and_dark_corners_are_not():
    with pytest.raises(CalibrationError, match=r"radius of 5[567] px.*--camera"):
        check_lens(replace(made_up_drive(60), images=_Lens(56.0)))
    for radius_px in (82.0, 95.0, 200.0):
        check_lens(replace(made_up_drive(60), images=_Lens(radius_px)))
    # A dark room with a lamp.
    check_lens(replace(made_up_drive(60), images=_Lens(20.0)))


def test_long_deleted_sections_are_left_out_and_short_ones_hold_the_drive_together():
    drive = made_up_drive(300, [])
    deleted = np.zeros(300, dtype=bool)
    # At 20 images a second: 1.9 s and 2.1 s from the first to the last frame.
    deleted[50:89] = deleted[150:193] = True
    left, (note,) = without_deleted(replace(drive, deleted=deleted))
    np.testing.assert_array_equal(left.frames, np.delete(drive.frames, np.arange(150, 193)))
    assert "43 frames" in note
    assert np.flatnonzero(left.breaks).tolist() == [150]
    everything = replace(drive, deleted=np.ones(300, dtype=bool))
    assert without_deleted(everything) == (everything, [])


@pytest.mark.parametrize(("sign", "count"), [(1.0, 0), (-1.0, 1)])
def test_a_throttle_that_is_negative_forward_is_named(tmp_path, sign, count):
    rng = np.random.default_rng(0)
    with DriveWriter(tmp_path / "drive") as writer:
        for k in range(70):
            image = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            writer.add(image, 0.05 * k, throttle=sign * 0.3)
    notes = prepare(MapRequest(tmp_path / "drive", 40.0), MapSettings(find_bumper=False)).notes
    assert sum("100 %" in note for note in notes) == count


def test_edges_at_the_rim_of_a_lens_have_no_place_on_the_road():
    """Found in the last pixel that sees the road, and moved a little further: there is no road."""
    camera = guessed_camera(160, 120, 38.0, 30.0, GuessSettings())
    table = RoadTable(camera, mapping_range(camera.mounting, RangeSettings()))
    uv = np.array([[80.0, 100.0], [80.0, 2.0]])
    normals = np.array([[0.0, 1.0], [0.0, 1.0]])
    kept = on_road(EdgePixels(uv, normals), table)
    np.testing.assert_array_equal(kept.uv_px, uv[:1])
