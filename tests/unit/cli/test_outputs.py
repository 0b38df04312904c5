"""Outputs that would replace a file of their own source are refused before anything is read or written."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from drives import write_video
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.cli.shared.options import check_ending, check_not_source
from lanenet.data.detections import DetectionTable
from lanenet.data.drives.folder import DriveWriter
from lanenet.errors import ConfigError
from lanenet.outputs import lock_output


def touched(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.mark.parametrize(
    "name", ["frames.csv", "Frames.csv", "truth.csv", "drive.yaml", "track.json", "images/0001.png"]
)
def test_a_drive_keeps_its_files(tmp_path, name):
    drive = touched(tmp_path / "drive", "frames.csv", "images/0001.png")
    with pytest.raises(ConfigError, match=r"(is|taken for) a file of .*drive"):
        check_not_source(drive, tmp_path / "lanes.csv", drive / name)


def test_a_tub_a_video_a_map_and_a_label_set_keep_theirs(tmp_path):
    tub = touched(tmp_path / "tub", "manifest.json", "catalog_0.catalog")
    a_map = touched(tmp_path / "map", "map.yaml", "edges.parquet")
    touched(tmp_path, "a.mp4", "a.csv", "b.parquet", "photo.jpg")
    refused = [
        (tub, tub / "manifest.json"),
        (tub, tub / "catalog_0.catalog"),
        (a_map, a_map / "edges.parquet"),
        (tmp_path / "a.mp4", tmp_path / "a.mp4"),
        # What was recorded with it; the message says what to type.
        (tmp_path / "a.mp4", tmp_path / "a.csv"),
        (tmp_path / "b.parquet", tmp_path / "b.json"),
        (tmp_path / "photo.jpg", tmp_path / "photo.jpg"),
    ]
    for source, out in refused:
        with pytest.raises(ConfigError, match=f"choose another name: .*{out.stem}_out{out.suffix}"):
            check_not_source(source, out)


def test_a_link_does_not_hide_what_it_leads_to(tmp_path):
    drive = touched(tmp_path / "drive", "frames.csv")
    (tmp_path / "link").symlink_to(drive)
    (tmp_path / "out.csv").symlink_to(drive / "frames.csv")
    for source, out in ((tmp_path / "link", drive / "frames.csv"), (drive, tmp_path / "out.csv")):
        with pytest.raises(ConfigError, match="choose another name"):
            check_not_source(source, out)


def test_other_files_beside_and_within_are_fine(tmp_path):
    drive = touched(tmp_path / "drive", "frames.csv", "images/0001.png", "lanes.csv")
    photos = touched(tmp_path / "photos", "a.jpg")
    touched(tmp_path, "a.mp4")
    check_not_source(drive, drive / "lanes.csv", drive / "lanes.mp4", drive / "camera.yaml", None)
    check_not_source(drive, tmp_path / "frames.csv", drive / "lanes" / "frames.csv")
    check_not_source(photos, photos / "frames.csv", photos / "a.csv")
    check_not_source(photos / "a.jpg", photos / "a.csv")
    check_not_source(tmp_path / "a.mp4", tmp_path / "a.parquet", tmp_path / "a_lanes.csv")


def test_answers_may_have_the_name_of_their_video(tmp_path):
    """The name that everybody chooses; readers pass such a table over."""
    video, out = touched(tmp_path, "a.mp4") / "a.mp4", tmp_path / "a.csv"
    check_not_source(video, out)
    DetectionTable().write(out)
    check_not_source(video, out)


def test_the_video_of_answers_gets_another_name_than_its_source(tmp_path):
    video = write_video(tmp_path / "a.mp4")
    words = ["detect", str(video), "--detector", "painter", "--out", str(tmp_path / "a.csv")]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "1000"})
    assert result.exit_code == 0, result.output
    assert "a_lanes.mp4" in result.stdout.rpartition("next: ")[2]


@pytest.mark.parametrize(
    ("words", "out", "beside", "other"),
    [
        (["label", "{drive}"], "a.parquet", "a.png", "a_out.parquet"),
        (["localise", "{drive}"], "a.csv", "a.tum", "a_out.csv"),
        (["calibrate", "chessboard", "no.jpg", "--board", "9x6"], "a.yaml", "a-board.png", "a_out.yaml"),
        (
            ["calibrate", "ground", "--camera", "no", "--image", "no"],
            "a.yaml",
            "a-birdseye.png",
            "a_out.yaml",
        ),
        (["calibrate", "drive", "{drive}"], "a.yaml", "a-undistorted.png", "a_out.yaml"),
        (["val", "{drive}"], "a", "a.json", "a_out"),
        (["val", "{drive}"], "a", "a-plain.jpg", "a_out"),
        (["export", "{drive}", "--int8"], "a.onnx", "a.json", "a_out.onnx"),
    ],
)
def test_what_nobody_named_is_not_replaced(tmp_path, words, out, beside, other):
    drive = touched(tmp_path / "drive", "map.yaml")
    touched(tmp_path, beside)
    filled = [word.format(drive=drive) for word in words]
    line = refused(tmp_path, *filled, "--out", tmp_path / out)
    assert f"{beside}: is there already" in line and line.endswith(f"another name: {tmp_path / other}")
    # Of the last run.
    touched(tmp_path, "a.html" if out == "a" else out)
    assert "is there already" not in refused(tmp_path, *filled, "--out", tmp_path / out)


def test_endings(tmp_path):
    check_ending(tmp_path / "a.CSV", ".parquet", ".csv")
    with pytest.raises(ConfigError, match=r"a\.txt: expected a name that ends in \.parquet or \.csv"):
        check_ending(tmp_path / "a.txt", ".parquet", ".csv")


def test_the_commands_ask(tmp_path):
    """Every command that reads a source and writes files leaves the source's own alone."""
    drive = tmp_path / "drive"
    with DriveWriter(drive) as writer:
        for k in range(3):
            writer.add(np.full((60, 80, 3), 40 * k, np.uint8), 0.05 * k, speed_cm_s=20.0)
    a_map = touched(tmp_path / "map", "map.yaml", "edges.parquet", "report.json", "map.png")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for words in (
        ("detect", drive, "--detector", "hough", "--out", drive / "frames.csv"),
        ("localise", drive, "--out", drive / "frames.csv"),
        ("label", a_map, "--out", a_map / "edges.parquet"),
        ("label", a_map, "--out", a_map / "map.parquet"),
        ("calibrate", "drive", drive, "--lane-width", "40", "--out", drive / "drive.yaml"),
        ("val", drive, a_map, "--no-baselines", "--out", a_map / "report"),
    ):
        result = CliRunner().invoke(app, [str(word) for word in words])
        assert result.exit_code == 1, words
        assert "choose another name" in result.stderr, (words, result.stderr)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@contextmanager
def written_by_another(out: Path) -> Iterator[None]:
    """Another run, here a thread, has the lock of an output."""
    locked, over = threading.Event(), threading.Event()

    def run() -> None:
        with lock_output(out):
            locked.set()
            over.wait()

    thread = threading.Thread(target=run)
    thread.start()
    locked.wait()
    yield
    over.set()
    thread.join()


ROOT = Path(__file__).resolve().parents[3]
#: Verbs with the option that names their output, and the output's name.
WRITERS: list[tuple[tuple[object, ...], str, str]] = [
    (("map", "nowhere", "--lane-width", "40"), "--out", "one"),
    (("label", "nowhere"), "--out", "one.parquet"),
    (("detect", "nowhere", "--detector", "painter"), "--out", "one.csv"),
    (("detect", "nowhere", "--detector", "painter", "--out", "x.csv"), "--video", "one.mp4"),
    (("localise", "nowhere"), "--out", "one.csv"),
    (("export", ROOT / "checkpoints" / "small"), "--out", "one.onnx"),
    (("calibrate", "chessboard", "nowhere.jpg", "--board", "9x6"), "--out", "one.yaml"),
    (("calibrate", "ground", "nowhere.csv", "--camera", "nowhere.yaml"), "--out", "one.yaml"),
    (("calibrate", "drive", "nowhere", "--lane-width", "40"), "--out", "one.yaml"),
    (("judge",), "--out", "one"),
    (("reality", "nowhere"), "--out", "one"),
    (("track", "oval"), "--out", "one.png"),
    (("sheets",), "--out", "one"),
    (("bench",), "--out", "one.json"),
    (("val", ROOT / "checkpoints" / "small", "nowhere"), "--out", "one"),
    (("simulate", ROOT / "configs" / "drives" / "example.yaml"), "--out", "one"),
]


@pytest.mark.parametrize(("words", "option", "name"), WRITERS, ids=[f"{w[0]}-{o}" for w, o, _ in WRITERS])
def test_what_another_run_writes_is_refused_before_the_work(
    tmp_path: Path, words: tuple[object, ...], option: str, name: str
) -> None:
    with written_by_another(tmp_path / name):
        line = refused(tmp_path, *words, option, tmp_path / name)
    assert str(tmp_path / name) in line and f"process {os.getpid()} " in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_training_of_the_same_name_is_refused_before_the_work(tmp_path: Path) -> None:
    config = ROOT / "configs" / "small.yaml"
    with written_by_another(tmp_path / "one"):
        line = refused(tmp_path, "train", config, "name=one", f"checkpoints_dir={tmp_path}")
    assert str(tmp_path / "one") in line
    with written_by_another(tmp_path / "work" / "sweep"):
        assert "sweep" in refused(tmp_path, "sweep", config, f"work_dir={tmp_path / 'work'}")


def test_a_full_disk_and_no_memory_are_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for error, word in (
        (OSError(28, "No space left on device"), "No space"),
        (MemoryError(), "out of memory"),
    ):

        def fail(*_: object, error: Exception = error) -> None:
            raise error

        monkeypatch.setattr("lanenet.data.camera_file.read_camera", fail)
        assert word in refused(tmp_path, "analyse", "nowhere.yaml")


def test_the_map_of_another_drive_is_replaced_with_force_only(tmp_path):
    """A map takes minutes; a drive that cannot be mapped ends the commands that are let through."""
    for name in ("one", "other"):
        with DriveWriter(tmp_path / name) as writer:
            writer.add(np.zeros((48, 64, 3), np.uint8), 0.0)
    drive_map = touched(tmp_path / "map", "map.yaml")
    (drive_map / "map.yaml").write_text(f"format: lanenet-map/1\ndrive: {tmp_path / 'one'}\n")
    words = ("map", tmp_path / "other", "--lane-width", "40", "--out", drive_map)
    assert f"map of another drive, {tmp_path / 'one'}" in refused(tmp_path, *words)
    for again in ((*words, "--force"), ("map", tmp_path / "one", *words[2:])):
        result = CliRunner().invoke(app, [str(word) for word in again])
        assert result.exit_code == 1 and "1 frame of a car that drives" in result.stderr
