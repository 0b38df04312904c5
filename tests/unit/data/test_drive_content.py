"""What a map was made from is known by its bytes: not by names and times, and quickly."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from drives import frame_image, write_drive, write_video

from lanenet.data.drives import open_drive
from lanenet.data.drives.content import content_key, file_mark, image_marks, mark_of, other_images
from lanenet.data.drives.folder import DriveWriter
from lanenet.errors import DriveFormatError


def images_of(drive: Path) -> list[Path]:
    return sorted((drive / "images").iterdir())


def test_the_mark_is_size_and_digest(tmp_path: Path):
    # sha256sum of "abc", from FIPS 180-2.
    assert mark_of(b"abc") == "3-ba7816bf8f01cfea"
    (tmp_path / "a").write_bytes(b"abc")
    assert file_mark(tmp_path / "a") == mark_of(b"abc")
    with pytest.raises(DriveFormatError, match="b: cannot be read"):
        file_mark(tmp_path / "b")


def test_a_large_file_is_known_by_its_size_and_pieces_of_it(tmp_path: Path):
    path = tmp_path / "a.mp4"
    path.write_bytes(bytes(2**25 + 1))
    before = file_mark(path)
    assert before.startswith(f"{2**25 + 1}-") and before == file_mark(path)
    for place in (0, 2**25):
        with path.open("r+b") as stream:
            stream.seek(place)
            stream.write(b"x")
        assert file_mark(path) != before
        path.write_bytes(bytes(2**25 + 1))


def test_the_same_bytes_are_the_same_drive_wherever_and_whenever_they_were_written(tmp_path: Path):
    drive = write_drive(tmp_path / "one", n=100)
    marks, key = image_marks(open_drive(drive)), content_key(drive)
    assert marks[7] == mark_of(images_of(drive)[7].read_bytes())
    shutil.copytree(drive, tmp_path / "copy", copy_function=shutil.copyfile)
    drive.rename(tmp_path / "moved")
    for same in (tmp_path / "copy", tmp_path / "moved"):
        image = images_of(same)[3]
        data = image.read_bytes()
        image.unlink()
        image.write_bytes(data)
        os.utime(image, (1.0, 1.0))
        assert not other_images(open_drive(same), marks).any() and content_key(same) == key


def test_other_images_under_the_same_names_are_found(tmp_path: Path):
    drive = write_drive(tmp_path / "one", n=150)
    marks, key = image_marks(open_drive(drive)), content_key(drive)
    for path in images_of(drive)[75:]:
        data = bytearray(path.read_bytes())
        data[-3] ^= 1  # of the same size
        path.write_bytes(data)
    np.testing.assert_array_equal(np.flatnonzero(other_images(open_drive(drive), marks)), np.arange(75, 150))
    assert content_key(drive) != key


def test_one_image_of_another_size_is_found_and_one_that_is_gone_is_no_other(tmp_path: Path):
    drive = write_drive(tmp_path / "one", n=150)
    opened = open_drive(drive)
    marks, key = image_marks(opened), content_key(drive)
    images_of(drive)[149].unlink()
    assert not other_images(opened, marks).any()
    path = images_of(drive)[12]
    path.write_bytes(path.read_bytes() + b"x")
    assert np.flatnonzero(other_images(opened, marks)).tolist() == [12] and content_key(drive) != key


def test_every_digest_finds_what_a_sample_may_miss(tmp_path: Path):
    drive = write_drive(tmp_path / "one", n=150)
    opened = open_drive(drive)
    marks = image_marks(opened)
    path = images_of(drive)[100]
    data = bytearray(path.read_bytes())
    data[-3] ^= 1
    path.write_bytes(data)
    assert not other_images(opened, marks).any()
    assert np.flatnonzero(other_images(opened, marks, every=True)).tolist() == [100]
    # An image that could not be read is not compared.
    assert not other_images(opened, ["" if k == 100 else mark for k, mark in enumerate(marks)], True).any()


def test_a_video_is_known_by_its_file(tmp_path: Path):
    path = write_video(tmp_path / "a.mp4")
    marks = image_marks(open_drive(path))
    assert set(marks) == {file_mark(path)} and content_key(path) == file_mark(path)
    path.rename(tmp_path / "b.mp4")
    assert not other_images(open_drive(tmp_path / "b.mp4"), marks).any()
    with DriveWriter(tmp_path / "other") as writer:
        for k in range(len(marks)):
            writer.add(frame_image(k), 0.1 * k)
    assert other_images(open_drive(tmp_path / "b.mp4"), ["7-0123456789abcdef"] * len(marks)).all()


@pytest.mark.slow
def test_twenty_thousand_frames_take_less_than_a_second(tmp_path: Path):
    """No timing of the product, but of what it may cost at all: a factor of three is left."""
    images = tmp_path / "tub" / "images"
    images.mkdir(parents=True)
    rows, data = ["frame,t_s,file"], bytes(5000)
    for k in range(20_000):
        (images / f"{k}.jpg").write_bytes(data + str(k).encode())
        rows.append(f"{k},{0.05 * k:.2f},images/{k}.jpg")
    first = write_drive(tmp_path / "one", n=1)
    shutil.copyfile(images_of(first)[0], images / "0.jpg")
    (tmp_path / "tub" / "frames.csv").write_text("\n".join(rows) + "\n")
    drive = open_drive(tmp_path / "tub")
    marks = image_marks(drive)
    for call in (lambda: other_images(drive, marks), lambda: content_key(tmp_path / "tub")):
        start_s = time.process_time()
        call()
        assert time.process_time() - start_s < 3.0
