"""What counts as done."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import pytest
from drives import write_drive, write_video

from datagen.made import Output, fingerprint, key_of
from lanenet.config import Settings
from lanenet.errors import DriveFormatError


@pytest.fixture
def labels_file(tmp_path: Path) -> Path:
    path = tmp_path / "labels" / "drive.parquet"
    path.parent.mkdir()
    path.write_bytes(b"labels")
    Output(path, "0123abcd").mark()
    return path


def test_what_is_marked_is_done(labels_file):
    assert Output(labels_file, "0123abcd").done


def test_another_key_or_a_missing_file_is_not_done(labels_file):
    assert not Output(labels_file, "0123abce").done
    labels_file.unlink()
    assert not Output(labels_file, "0123abcd").done


def test_without_a_marker_nothing_is_done(tmp_path):
    path = tmp_path / "drive.parquet"
    path.write_bytes(b"labels")
    assert not Output(path, "0123abcd").done


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"key": 7}', b"{}", b"[1, 2]", b"null", b'"0123abcd"', b"\xff\xfe\x00"]
)
def test_a_damaged_marker_means_not_done(labels_file, content):
    (marker,) = labels_file.parent.glob("*.json")
    marker.write_bytes(content)
    assert not Output(labels_file, "0123abcd").done


def test_parts_of_one_drive_have_markers_of_their_own(tmp_path):
    for name in ("a.parquet", "a.train.parquet"):
        (tmp_path / name).write_bytes(b"labels")
    Output(tmp_path / "a.parquet", "k").mark()
    assert not Output(tmp_path / "a.train.parquet", "k").done


def test_a_key_depends_on_every_setting_and_not_on_their_order():
    first = key_of({"a": 1, "b": 2.0}, "train")
    assert first == key_of({"b": 2.0, "a": 1}, "train")
    assert first != key_of({"a": 1, "b": 2.5}, "train")
    assert first != key_of({"a": 1, "b": 2.0}, "test")
    json.loads(json.dumps(first))


def test_a_recording_that_changes_has_another_fingerprint(tmp_path):
    (tmp_path / "frames.csv").write_text("frame\n1\n")
    first = fingerprint(tmp_path)
    assert first == fingerprint(tmp_path)
    (tmp_path / "frames.csv").write_text("frame\n1\n2\n")
    assert first != fingerprint(tmp_path)
    with pytest.raises(DriveFormatError, match="no such drive"):
        fingerprint(tmp_path / "nowhere")


def test_a_drive_is_known_by_its_content(tmp_path):
    """Not by the times of its files, which a copy has not, nor by names that a recorder uses again."""
    drive = write_drive(tmp_path / "drive", n=80)
    first, images = fingerprint(drive), sorted((drive / "images").iterdir())
    stats = [path.stat() for path in images]
    for path in images:
        os.utime(path)
    (drive / ".DS_Store").touch()
    assert fingerprint(drive) == first
    for path, before in zip(images, stats, strict=True):
        data = bytearray(path.read_bytes())
        data[-3] ^= 1
        path.write_bytes(data)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert fingerprint(drive) != first


def test_the_table_beside_a_video_is_a_part_of_it(tmp_path):
    video = write_video(tmp_path / "a.mp4")
    first = fingerprint(video)
    (tmp_path / "b.csv").write_text("frame,t_s\n0,0.0\n")
    assert fingerprint(video) == first
    (tmp_path / "a.csv").write_text("frame,t_s\n0,0.0\n")
    assert fingerprint(video) != first


def test_what_is_forgotten_is_done_again(labels_file):
    Output(labels_file, "0123abcd").forget()
    assert not Output(labels_file, "0123abcd").done and labels_file.is_file()
    Output(labels_file, "0123abcd").forget()


def test_a_file_is_made_once_for_each_key(tmp_path):
    made: list[str] = []
    path = tmp_path / "drive.yaml"

    def make() -> None:
        assert not (tmp_path / "drive.done.json").exists()
        made.append(path.name)
        path.touch()

    for key in ("a", "a", "b", "a"):
        Output(path, key).make(make)
    assert len(made) == 3

    def fail() -> None:
        raise DriveFormatError("no drive")

    # What was there is not what it was, once it has begun to be made again.
    with pytest.raises(DriveFormatError):
        Output(path, "c").make(fail)
    assert not Output(path, "a").done and not Output(path, "c").done


def test_settings_and_dataclasses_count_by_their_values():
    @dataclass(frozen=True)
    class Window:
        cell_cm: float

    class Edges(Settings):
        sigma: float

    assert key_of(Edges(sigma=1.5), Window(0.5)) == key_of({"sigma": 1.5}, {"cell_cm": 0.5})
    assert key_of(Edges(sigma=1.5)) != key_of(Edges(sigma=2.0))


@pytest.mark.parametrize("moves", [True, False])
def test_what_is_replaced_as_a_whole_stays_known_while_another_is_made(tmp_path, moves):
    path = tmp_path / "map.yaml"
    path.write_text("of 31 cm")
    old, new = Output(path, "31 cm", moves), Output(path, "37 cm", moves)
    old.mark()

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        new.make(interrupted)
    assert old.done == moves and not new.done
    new.make(lambda: path.write_text("of 37 cm"))
    assert new.done and not old.done
