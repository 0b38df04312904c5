"""What counts as done."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from datagen.datasets.done import fingerprint, forget_done, is_done, key_of, mark_done
from lanenet.errors import DriveFormatError


@pytest.fixture
def labels_file(tmp_path: Path) -> Path:
    path = tmp_path / "labels" / "drive.parquet"
    path.parent.mkdir()
    path.write_bytes(b"labels")
    mark_done(path, "0123abcd")
    return path


def test_what_is_marked_is_done(labels_file):
    assert is_done(labels_file, "0123abcd")


def test_another_key_or_a_missing_file_is_not_done(labels_file):
    assert not is_done(labels_file, "0123abce")
    labels_file.unlink()
    assert not is_done(labels_file, "0123abcd")


def test_without_a_marker_nothing_is_done(tmp_path):
    path = tmp_path / "drive.parquet"
    path.write_bytes(b"labels")
    assert not is_done(path, "0123abcd")


@pytest.mark.parametrize(
    "content", [b"", b"{", b'{"key": 7}', b"{}", b"[1, 2]", b"null", b'"0123abcd"', b"\xff\xfe\x00"]
)
def test_a_damaged_marker_means_not_done(labels_file, content):
    (marker,) = labels_file.parent.glob("*.json")
    marker.write_bytes(content)
    assert not is_done(labels_file, "0123abcd")


def test_parts_of_one_drive_have_markers_of_their_own(tmp_path):
    for name in ("a.parquet", "a.train.parquet"):
        (tmp_path / name).write_bytes(b"labels")
    mark_done(tmp_path / "a.parquet", "k")
    assert not is_done(tmp_path / "a.train.parquet", "k")


def test_a_key_depends_on_every_setting_and_not_on_their_order():
    first = key_of([{"a": 1, "b": 2.0}, "train"])
    assert first == key_of([{"b": 2.0, "a": 1}, "train"])
    assert first != key_of([{"a": 1, "b": 2.5}, "train"])
    assert first != key_of([{"a": 1, "b": 2.0}, "test"])
    json.loads(json.dumps(first))


def test_a_recording_that_changes_has_another_fingerprint(tmp_path):
    (tmp_path / "frames.csv").write_text("frame\n1\n")
    first = fingerprint(tmp_path)
    assert first == fingerprint(tmp_path)
    (tmp_path / "frames.csv").write_text("frame\n1\n2\n")
    assert first != fingerprint(tmp_path)
    with pytest.raises(DriveFormatError, match="no such drive"):
        fingerprint(tmp_path / "nowhere")


def test_what_is_forgotten_is_done_again(labels_file):
    forget_done(labels_file)
    assert not is_done(labels_file, "0123abcd") and labels_file.is_file()
    forget_done(labels_file)
