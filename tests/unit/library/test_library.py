from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drives import record, write_drive, write_tub, write_video
from nth_failure import DISK, every_failure, visible
from recordings import lap, write_recording

from lanenet.data.library import Entry, Library, database
from lanenet.data.library.overlap import Overlap, Recording
from lanenet.errors import ConfigError, LanenetError, LibraryError
from lanenet.processes import run_jobs


def _library(folder: Path) -> Library:
    return Library.open(folder / "drives.sqlite", create=True)


def _drive(path: Path, seed: int, n: int = 4) -> Path:
    """A drive whose images are like those of no other seed."""
    write_drive(path, n, camera=None)
    rng = np.random.default_rng(seed)
    for image in sorted(path.glob("images/*")):
        cv2.imwrite(str(image), rng.integers(0, 255, (48, 64, 3), np.uint8))
    return path


def test_an_entry_says_what_the_drive_and_people_say(tmp_path: Path) -> None:
    library = _library(tmp_path)
    added = library.add(write_drive(tmp_path / "tubs" / "one"), car="red", track="hall")
    assert added == library.get("one") == library.entries()[0]
    expected = Entry(
        name="one",
        source=Path("tubs/one"),
        copied=False,
        kind="folder",
        car="red",
        camera="",
        track="hall",
        licence="",
        notes="a test",
        lane_width_cm=40.0,
        frames=5,
        duration_s=0.2,
        checksum=added.checksum,
        added_at=added.added_at,
    )
    assert replace(added, duration_s=round(added.duration_s, 6)) == expected
    assert len(added.checksum) == 64 and added.added_at.endswith("+00:00")
    assert len(library.open_drive("one")) == 5
    library.check("one")


def test_every_kind_of_drive_is_told_apart(tmp_path: Path) -> None:
    library = _library(tmp_path)
    assert library.add(write_tub(tmp_path / "tub", [record(k) for k in range(3)])).kind == "tub"
    assert library.add(write_video(tmp_path / "film.avi", 5)).kind == "video"
    assert library.add(write_drive(tmp_path / "own")).kind == "folder"
    assert [entry.name for entry in library.entries()] == ["film", "own", "tub"]


def test_a_drive_elsewhere_is_kept_by_its_full_path(tmp_path: Path) -> None:
    library = _library(tmp_path / "library")
    entry = library.add(write_drive(tmp_path / "elsewhere"))
    assert entry.source == (tmp_path / "elsewhere").resolve()
    assert library.path_of(entry) == entry.source


def test_a_library_that_moves_with_its_drives_still_finds_them(tmp_path: Path) -> None:
    library = _library(tmp_path / "old")
    library.add(write_drive(tmp_path / "old" / "one"))
    library.add(_drive(tmp_path / "other", 1), copy=True)
    (tmp_path / "old").rename(tmp_path / "new")
    moved = Library.open(tmp_path / "new" / "drives.sqlite")
    for name in ("one", "other"):
        moved.check(name)


def test_names_are_unique_and_told_apart_by_the_folder_above(tmp_path: Path) -> None:
    library = _library(tmp_path)
    for k, car in enumerate(("red", "blue", "blue/x")):
        library.add(_drive(tmp_path / car / "data", k))
    assert [entry.name for entry in library.entries()] == ["blue-data", "data", "x-data"]
    with pytest.raises(LibraryError, match="'data' is taken"):
        library.add(_drive(tmp_path / "green", 9), name="data")
    assert library.add(_drive(tmp_path / "-my tub (1)", 10)).name == "my-tub-1-"


def test_the_same_recording_is_refused_under_another_name_and_as_another_format(tmp_path: Path) -> None:
    library = _library(tmp_path)
    first = library.add(_drive(tmp_path / "one", 1))
    again = _drive(tmp_path / "two", 1)
    with pytest.raises(LibraryError, match="same recording as one"):
        library.add(again)
    forced = library.add(again, force=True)
    assert forced.checksum == first.checksum and len(library.entries()) == 2


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_a_copy_is_whole_and_goes_only_when_asked(tmp_path: Path, kind: str) -> None:
    library = _library(tmp_path / "library")
    source = write_drive(tmp_path / "a") if kind == "folder" else write_video(tmp_path / "a.avi", 5)
    if kind == "video":
        (tmp_path / "a.csv").write_text("frame,t_s,angle\n" + "".join(f"{k},{k},0.1\n" for k in range(5)))
    entry = library.add(source, copy=True)
    home = library.copies / "a"
    assert entry.copied and library.path_of(entry).is_relative_to(home)
    library.check("a")
    library.remove("a")
    assert home.is_dir()
    with pytest.raises(LibraryError, match="left of a drive that was removed"):
        library.add(source, copy=True)
    library.add(source, name="b", copy=True)
    library.remove("b", files=True)
    assert not (library.copies / "b").exists() and library.entries() == []


def test_files_that_are_no_copy_are_never_removed(tmp_path: Path) -> None:
    library = _library(tmp_path)
    source = write_drive(tmp_path / "sub" / "a")
    library.add(source)
    with pytest.raises(LibraryError, match="no copy of the library"):
        library.remove("a", files=True)
    library.remove("a")
    assert source.is_dir() and library.entries() == []


def test_what_people_say_can_be_changed(tmp_path: Path) -> None:
    library = _library(tmp_path)
    library.add(write_drive(tmp_path / "a"))
    changed = library.update("a", track="hall", lane_width_cm=None)
    assert changed == library.get("a") and (changed.track, changed.lane_width_cm) == ("hall", None)
    assert library.update("a") == changed


@pytest.mark.parametrize(
    ("told", "match"),
    [
        ({"frames": 3.0}, "frames: not to be given"),
        ({"lane_width_cm": -1.0}, "above 0"),
        ({"lane_width_cm": float("nan")}, "above 0"),
        ({"lane_width_cm": "wide"}, "above 0"),
        ({"track": None}, "expected a text"),
    ],
)
def test_what_cannot_be_said_is_refused(tmp_path: Path, told: dict[str, object], match: str) -> None:
    library = _library(tmp_path)
    library.add(write_drive(tmp_path / "a"))
    with pytest.raises(LibraryError, match=match):
        library.update("a", **told)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["", ".hidden", "a/b", "a b", "x" * 101, "a\n"])
def test_a_name_that_no_file_could_have_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(LibraryError, match="letters, digits"):
        _library(tmp_path).add(write_drive(tmp_path / "a"), name=name)


def test_an_unknown_name_gets_the_nearest(tmp_path: Path) -> None:
    library = _library(tmp_path)
    library.add(write_drive(tmp_path / "garage_1"))
    for call in (library.get, library.remove, library.open_drive, library.update):
        with pytest.raises(LibraryError, match="no drive 'garage1', did you mean 'garage_1'"):
            call("garage1")


def test_a_source_that_is_gone_or_has_changed_is_told(tmp_path: Path) -> None:
    library = _library(tmp_path)
    source = _drive(tmp_path / "a", 1)
    library.add(source)
    image = sorted(source.glob("images/*"))[0]
    image.write_bytes(image.read_bytes() + b"\0")
    with pytest.raises(LibraryError, match="has changed since it was added"):
        library.check("a")
    source.rename(tmp_path / "b")
    for call in (library.check, library.open_drive):
        with pytest.raises(LibraryError, match="is gone"):
            call("a")


def test_an_image_that_is_missing_is_part_of_what_a_drive_is(tmp_path: Path) -> None:
    library = _library(tmp_path)
    for name in ("a", "b"):
        sorted(_drive(tmp_path / name, 1).glob("images/*"))[2].unlink()
    library.add(tmp_path / "a")
    with pytest.raises(LibraryError, match="same recording as a"):
        library.add(tmp_path / "b")


def test_a_file_that_is_no_library_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.sqlite"
    with pytest.raises(LibraryError, match="no such library"):
        Library.open(path)
    path.write_text("a text that is long enough to be no database " * 20)
    for create in (True, False):
        with pytest.raises(LibraryError, match="no SQLite file"):
            Library.open(path, create=create)
    path.unlink()
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE other (x)")
    connection.commit()
    connection.close()
    for create in (True, False):
        with pytest.raises(LibraryError, match="another database"):
            Library.open(path, create=create)


def test_a_library_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    library = _library(tmp_path)
    connection = sqlite3.connect(library.path)
    connection.execute(f"PRAGMA user_version = {database.SCHEMA_VERSION + 1}")
    connection.close()
    for create in (True, False):
        with pytest.raises(LibraryError, match="pip install --upgrade"):
            Library.open(library.path, create=create)


def test_a_damaged_library_is_told(tmp_path: Path) -> None:
    library = _library(tmp_path)
    library.add(write_drive(tmp_path / "a"))
    data = library.path.read_bytes()
    library.path.write_bytes(data[:4096] + b"\xff" * (len(data) - 4096))
    with pytest.raises(LibraryError, match="damaged"):
        library.entries()


def test_a_locked_library_is_told_and_unlocked_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = _library(tmp_path)
    monkeypatch.setattr(database, "_WAIT_S", 0.05)
    other = sqlite3.connect(library.path, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(LibraryError, match="another program has held this library"):
        library.add(write_drive(tmp_path / "a"))
    other.execute("ROLLBACK")
    other.close()
    library.add(tmp_path / "a")


def test_a_full_disk_leaves_the_library_as_it_was(tmp_path: Path) -> None:
    library = _library(tmp_path)
    library.add(write_drive(tmp_path / "a"))
    with pytest.raises(LibraryError, match="disk is full"), database.writing(library.path) as connection:
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count = {pages}")
        connection.execute("UPDATE drives SET notes = ?", ("x" * 100_000,))
    assert [entry.notes for entry in library.entries()] == ["a test"]


def _add(job: tuple[Library, Path]) -> str:
    return job[0].add(job[1]).name


def test_many_threads_add_at_once(tmp_path: Path) -> None:
    library = _library(tmp_path)
    jobs = [(library, _drive(tmp_path / "tubs" / f"d{k}", k)) for k in range(8)]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(_add, jobs)) == [f"d{k}" for k in range(8)]
    assert len(library.entries()) == 8


@pytest.mark.slow
def test_many_processes_add_at_once(tmp_path: Path) -> None:
    library = _library(tmp_path)
    sources = [_drive(tmp_path / "tubs" / f"d{k}", k) for k in range(20)]
    names = run_jobs(_add, [(str(source), (library, source)) for source in sources], 4)
    assert names == [f"d{k}" for k in range(20)]
    assert len(library.entries()) == 20


def test_each_failure_of_a_copy_leaves_no_half_drive(tmp_path: Path) -> None:
    source = write_drive(tmp_path / "source", 2)
    library = _library(tmp_path / "library")
    points = 0
    for failure in every_failure(lambda: library.add(source, copy=True), [DISK]):
        points += 1
        if failure.error is None:  # a folder that could be made by the next call
            library.remove("source", files=True)
        assert isinstance(failure.error, LanenetError | None), f"{failure.call}: {failure.error!r}"
        assert library.entries() == [], failure.call
        assert not library.copies.is_dir() or visible(library.copies) == [], failure.call
    library.check("source")
    assert points > 5


def test_what_drives_share_is_kept_as_a_relation(tmp_path: Path) -> None:
    library = _library(tmp_path)
    pictures = lap(1, 120)
    library.add(write_recording(tmp_path / "whole", pictures))
    library.add(write_recording(tmp_path / "cut", pictures[30:90], quality=50, first=7))
    library.add(write_recording(tmp_path / "lap", lap(2, 120)))
    ((other, overlap),) = library.relations("cut")
    assert other == "whole" and not overlap.same_bytes
    assert (overlap.frames, overlap.other_frames) == ((7, 66), (30, 89))
    assert library.relations("whole") == [("cut", overlap.swapped)]
    assert library.relations("lap") == []
    copied = library.add(tmp_path / "whole", name="again", force=True)
    assert copied.checksum == library.get("whole").checksum
    assert library.relations("again")[1] == ("whole", Overlap((0, 119), (0, 119), 120, True, 0.0))
    library.remove("whole")
    assert [other for other, _ in library.relations("cut")] == ["again"]


def test_drives_that_were_added_meanwhile_are_compared_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = _library(tmp_path)
    pictures = lap(1, 60)
    one, other = (
        write_recording(tmp_path / f"q{quality}", pictures, quality=quality) for quality in (40, 90)
    )
    compared = library._recordings

    def late() -> Iterator[tuple[int, Recording]]:
        yield from compared()
        monkeypatch.undo()
        library.add(other)

    monkeypatch.setattr(library, "_recordings", late)
    library.add(one)
    assert [name for name, _ in library.relations("q40")] == ["q90"]


def test_a_recording_is_ready_to_be_compared(tmp_path: Path) -> None:
    library = _library(tmp_path)
    library.add(write_recording(tmp_path / "a", lap(1, 20)), track="hall")
    recording = library.recording("a")
    assert (recording.name, recording.track, len(recording.fingerprint)) == ("a", "hall", 20)
    with pytest.raises(LibraryError, match="no drive 'b'"):
        library.recording("b")


def test_what_is_no_drive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LanenetError, match="no such drive"):
        _library(tmp_path).add(tmp_path / "none")
    assert not issubclass(LibraryError, ConfigError)
