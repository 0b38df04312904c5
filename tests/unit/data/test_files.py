from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from lanenet import outputs
from lanenet.data.files import (
    FOLDER_KINDS,
    atomic_file,
    atomic_folder,
    check_destination,
    check_replaceable,
    require,
    write_json,
    write_text,
)
from lanenet.errors import LanenetError, MissingExtraError


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_a_file_appears_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.csv"
    with atomic_file(path) as temporary:
        assert temporary.suffix == ".csv"
        assert temporary.parent == path.parent
        temporary.write_text("x")
        assert not path.exists()
    assert path.read_text() == "x"
    assert names(path.parent) == ["a.csv"]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with pytest.raises(ZeroDivisionError), atomic_file(path) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_a_file_does_not_replace_a_folder(tmp_path: Path) -> None:
    with pytest.raises(LanenetError, match="is a folder"), atomic_file(tmp_path):
        pass


def test_a_file_does_not_replace_a_pipe(tmp_path: Path) -> None:
    """Nor a device: as root it would be gone for the whole system."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for refuses in (check_destination, lambda path: write_text(path, "x")):
        with pytest.raises(LanenetError, match="pipe"):
            refuses(pipe)
    assert pipe.is_fifo()


def test_a_mounted_disk_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Said before the work: in the end its name cannot be exchanged."""
    monkeypatch.setattr(Path, "is_mount", lambda path: path == tmp_path)
    with pytest.raises(LanenetError, match="mounted"):
        check_replaceable(tmp_path, "drive")


def test_a_file_below_a_file_is_refused(tmp_path: Path) -> None:
    write_text(tmp_path / "a", "x")
    with pytest.raises(LanenetError, match="cannot be made"):
        write_text(tmp_path / "a" / "b.txt", "y")


def test_a_link_keeps_pointing_at_its_file(tmp_path: Path) -> None:
    write_text(tmp_path / "real.txt", "old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def fill(folder: Path, text: str) -> None:
    (folder / "drive.yaml").write_text("format: lanenet-drive/1\n")
    (folder / "frames.csv").write_text("frame,t_s,file\n")
    (folder / "truth.csv").write_text("frame\n")
    (folder / "images").mkdir()
    (folder / "images" / "a.txt").write_text(text)


def make_folder(path: Path, text: str) -> None:
    with atomic_folder(path, "drive") as temporary:
        fill(temporary, text)


def test_a_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    path = tmp_path / "out"
    make_folder(path, "one")
    (path / "images" / "stale.txt").write_text("from the first run")
    make_folder(path, "two")
    assert (path / "images" / "a.txt").read_text() == "two"
    assert names(path) == ["drive.yaml", "frames.csv", "images", "truth.csv"]
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("links", [True, False])
def test_what_others_put_into_a_folder_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    if not links:
        monkeypatch.setattr(os, "link", lambda *_, **__: (_ for _ in ()).throw(OSError("no links here")))
    path, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    make_folder(path, "one")
    elsewhere.mkdir()
    (elsewhere / "photo.jpg").write_text("far")
    (path / "notes.txt").write_text("mine")
    (path / "lanes" / "deep").mkdir(parents=True)
    (path / "lanes" / "deep" / "b.csv").write_text("mine, too")
    (path / "album").symlink_to(elsewhere)
    (path / "nowhere").symlink_to(tmp_path / "gone")
    for text in ("two", "three"):
        make_folder(path, text)
    assert (path / "images" / "a.txt").read_text() == "three"
    assert (path / "notes.txt").read_text() == "mine"
    assert (path / "lanes" / "deep" / "b.csv").read_text() == "mine, too"
    assert (path / "album").is_symlink() and (path / "nowhere").is_symlink()
    assert names(elsewhere) == ["photo.jpg"]


def test_others_files_in_a_checkpoint_stay_whose_names_look_like_its_own(tmp_path: Path) -> None:
    def train() -> None:
        with atomic_folder(tmp_path / "mine", "checkpoint") as folder:
            for name in (*FOLDER_KINDS["checkpoint"], "results-worst.jpg", "example.png"):
                (folder / name).write_text("format: lanenet-checkpoint/1\n")

    train()
    for name in ("results_of_my_race.txt", "example.docx", "curve.ods", "my_rasters.png"):
        (tmp_path / "mine" / name).write_text("mine")
    (tmp_path / "mine" / "results").mkdir()
    before = names(tmp_path / "mine")
    (tmp_path / "mine" / "results-plain.jpg").write_text("of the last run")
    train()
    assert names(tmp_path / "mine") == before


def test_maps_of_others_in_a_joined_folder_stay(tmp_path: Path) -> None:
    def join(*members: str) -> None:
        with atomic_folder(tmp_path / "track", "joined") as folder:
            drives = "".join(f"- {{map: {name}}}\n" for name in members)
            (folder / "joined.yaml").write_text(f"format: lanenet-joined/1\ndrives:\n{drives}")
            (folder / "join.json").write_text("{}")
            for name in members:
                (folder / name).mkdir()

    join("monday", "tuesday")
    (tmp_path / "track" / "my_map").mkdir()
    join("monday", "friday")
    assert names(tmp_path / "track") == ["friday", "join.json", "joined.yaml", "monday", "my_map"]


def test_a_drive_that_was_recorded_is_not_replaced(tmp_path: Path) -> None:
    """People write drive.yaml into their tubs, and a recorder writes one."""
    path = tmp_path / "tub"
    make_folder(path, "one")
    (path / "truth.csv").unlink()
    with pytest.raises(LanenetError, match=r"tub: holds a drive without truth\.csv"):
        make_folder(path, "two")
    assert (path / "images" / "a.txt").read_text() == "one"


def test_an_error_leaves_the_old_folder_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "out"
    make_folder(path, "one")
    with pytest.raises(KeyboardInterrupt), atomic_folder(path, "drive") as temporary:
        (temporary / "half.txt").write_text("x")
        raise KeyboardInterrupt
    assert (path / "images" / "a.txt").read_text() == "one"
    assert names(tmp_path) == ["out"]


def test_an_empty_folder_may_be_filled(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    make_folder(tmp_path / "out", "one")
    assert names(tmp_path / "out") == ["drive.yaml", "frames.csv", "images", "truth.csv"]


@pytest.mark.parametrize(
    ("marker", "text"),
    [
        ("photo.jpg", "mine"),
        ("drive.yaml", "format: something-else/1"),
        ("drive.yaml", "[not, a, mapping]"),
        # A camera file may lie among anything.
        ("camera.yaml", "format: lanenet-camera/1"),
        ("map.yaml", "format: lanenet-map/1"),
    ],
)
def test_a_folder_of_someone_else_is_kept(tmp_path: Path, marker: str, text: str) -> None:
    path = tmp_path / "out"
    path.mkdir()
    (path / marker).write_text(text)
    with pytest.raises(LanenetError, match=r"out: the folder is not empty and holds no drive\.yaml"):
        make_folder(path, "one")
    assert (path / marker).read_text() == text


def test_a_folder_that_fills_up_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "out"
    with pytest.raises(LanenetError, match="not replaced"), atomic_folder(path, "drive") as temporary:
        fill(temporary, "one")
        path.mkdir()
        (path / "mine.txt").write_text("x")
    assert names(path) == ["mine.txt"]


def test_json_has_null_for_what_is_not_finite(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json",
        {
            "nan": float("nan"),
            "deep": [np.float32(0.5), (np.int64(3), np.array([1.0, np.inf]))],
            "flag": np.bool_(True),
            "path": Path("a/b"),
            "text": "\u00fc",
        },
    )
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {
        "nan": None,
        "deep": [0.5, [3, [1.0, None]]],
        "flag": True,
        "path": "a/b",
        "text": "\u00fc",
    }


def test_require_returns_the_module() -> None:
    assert require("json.decoder", "data").JSONDecoder is json.JSONDecoder


def test_a_missing_package_names_its_extra() -> None:
    with pytest.raises(MissingExtraError, match=r"no_such_package .*pip install 'lanenet\[data\]'"):
        require("no_such_package.part", "data")


@pytest.mark.parametrize("lost", ["drive.yaml", "frames.csv", "all", "its text"])
def test_a_folder_that_lost_a_file_replaces_nothing(tmp_path: Path, lost: str) -> None:
    path = tmp_path / "out"
    make_folder(path, "one")
    named = "drive.yaml" if lost == "drive.yaml" else "frames.csv"
    refused = pytest.raises(LanenetError, match=rf"out: not written: .*{named}")
    with refused, atomic_folder(path, "drive") as temporary:
        fill(temporary, "two")
        for name in ("drive.yaml", "frames.csv") if lost == "all" else (lost,):
            (temporary / name).unlink(missing_ok=True)
        if lost == "its text":
            (temporary / "frames.csv").write_text("")
    assert (path / "images" / "a.txt").read_text() == "one"
    assert names(tmp_path) == ["out"]


def test_a_folder_that_cannot_be_read_replaces_nothing(tmp_path: Path) -> None:
    path = tmp_path / "out"
    make_folder(path, "one")

    def check(folder: Path) -> None:
        raise LanenetError(f"{folder / 'frames.csv'}: line 7")

    refused = pytest.raises(LanenetError, match=r"out: not written: .*frames\.csv: line 7")
    with refused, atomic_folder(path, "drive", check) as temporary:
        fill(temporary, "two")
    assert (path / "images" / "a.txt").read_text() == "one"


def test_a_folder_is_on_the_disk_before_it_gets_its_name_and_its_name_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_folder(tmp_path / "out", "one")
    done: list[str] = []
    exchange, sync = outputs.exchange, os.fsync

    def synced(handle: int) -> None:
        sync(handle)
        done.append(re.sub(r"\.out\.[^/]*", "new", os.readlink(f"/proc/self/fd/{handle}")))

    def exchanged(one: Path, other: Path) -> bool:
        done.append("exchange")
        return exchange(one, other)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(outputs, "exchange", exchanged)
    make_folder(tmp_path / "out", "two")
    new = tmp_path / "new"
    inside = ("images", "images/a.txt", "drive.yaml", "frames.csv", "truth.csv")
    files = [*(new / name for name in inside), new]
    assert sorted(done[:-2]) == sorted(map(str, files)) and done[-3] == str(new)
    assert done[-2:] == ["exchange", str(tmp_path)]
