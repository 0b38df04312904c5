"""``lanenet drives``: what it says of copies and cuts, what it lists, and what it never removes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from commands import refused
from drives import write_drive
from recordings import lap, write_recording
from typer.testing import CliRunner, Result

from lanenet.cli.app import app
from lanenet.data.library import Library


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["drives", *map(str, words)], env={"COLUMNS": "200"})


def done(*words: object) -> str:
    result = run(*words)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a recording, a cut of it, and another lap."""
    pictures = lap(1, 120)
    write_recording(tmp_path / "whole", pictures)
    write_recording(tmp_path / "club" / "car_1" / "data" / "cut", pictures[30:90], quality=50, first=7)
    write_recording(tmp_path / "club" / "car_2" / "lap", lap(2, 120))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_copies_and_cuts_are_named_with_their_frames_when_they_are_added(here: Path) -> None:
    done("add", "whole", "--track", "hall", "--lane-width", "40")
    said = done("add", "club", "--car", "red")
    assert "lap: added by reference, folder, 120 frames, 6 s" in said
    assert (
        "warning: cut is a cut of whole: its frames 7 to 66 are 30 to 89 of whole (encoded again: of " in said
    )
    assert "lap is" not in said and "lap overlaps" not in said
    assert "2 drives added, 0 there already, 0 not added" in said
    write_recording(here / "again", lap(1, 120), quality=40)
    assert "again is a re-encoded copy of whole: its frames 0 to 119 are 0 to 119" in done("add", "again")
    late = write_recording(here / "late", lap(1, 120)[70:] + lap(3, 60), quality=60)
    assert (
        "late overlaps with whole: both are cuts of one recording: its frames 0 to 49 are 70 to 119"
        in done("add", late)
    )


def test_the_same_recording_is_named_and_not_added_again(here: Path) -> None:
    done("add", "whole")
    shutil.copytree(here / "whole", here / "other_name")
    said = done("add", "other_name")
    assert (
        "other_name: the same recording as whole of the library: the images and commands of all 120" in said
    )
    assert "whole: is in the library as whole" in done("add", "whole")
    assert "is not changed; use lanenet drives set" in run("add", "whole", "--car", "red").output
    assert [entry.name for entry in Library.open().entries()] == ["whole"]
    assert "same recording as whole" in refused(here, "drives", "add", "other_name", "--name", "b")
    said = done("add", "other_name", "--force")
    assert "other_name has the same images as whole: its frames 0 to 119" in said


def test_a_drive_that_was_moved_says_how_it_is_known_at_its_new_place(here: Path) -> None:
    done("add", "whole")
    shutil.move(here / "whole", here / "moved")
    assert "whole is gone: lanenet drives remove whole, then add moved again" in run("add", "moved").stderr


def test_a_drive_that_changed_since_is_not_taken_for_what_it_was(here: Path) -> None:
    done("add", "whole")
    next((here / "whole" / "images").iterdir()).write_bytes(b"")
    assert "whole has changed since it was added" in refused(here, "drives", "add", "whole")
    assert "whole has changed" in refused(here, "drives", "show", "whole", "--check")
    shutil.rmtree(here / "whole")
    assert "are gone" in done("show", "whole")
    assert "is gone; put it back" in refused(here, "drives", "show", "whole", "--check")


def test_a_drive_that_cannot_be_read_keeps_no_other_from_being_added(here: Path) -> None:
    (here / "club" / "car_1" / "data" / "cut" / "frames.csv").write_text("frame,file\n")
    result = run("add", "club")
    assert result.exit_code == 1
    assert "1 drive added, 0 there already, 1 not added" in result.output
    assert "error: 1 drive not added, the first: club/car_1/data/cut/frames.csv" in result.stderr
    assert [entry.name for entry in Library.open().entries()] == ["lap"]


def test_the_list_is_a_table_and_json(here: Path) -> None:
    done("add", "whole", "--track", "hall", "--license", "MIT", "--lane-width", "400mm")
    done("add", "club", "--copy", "--car", "red")
    table = done("list")
    assert "│ whole │ hall  │     │ folder         │ cut                │       40 │    120 │ 0.1 │" in table
    assert "3 drives on 1 named track, 300 frames, 15 s" in table
    assert "lap" not in done("list", "--track", "hall")
    whole, cut = (json.loads(done("show", name, "--json"))[0] for name in ("whole", "cut"))
    assert json.loads(done("list", "--json", "--track", "hall")) == [whole]
    assert (whole["lane_width_cm"], whole["licence"], whole["there"]) == (40.0, "MIT", True)
    assert cut["copied"] and Path(cut["path"]).is_relative_to(here / "drives.files")
    assert [(each["drive"], each["other_frames"]) for each in cut["relations"]] == [("whole", [30, 89])]


def test_copies_of_the_library_are_not_found_as_drives_to_add(here: Path) -> None:
    done("add", "whole", "--copy")
    shutil.rmtree(here / "whole")
    shutil.rmtree(here / "club")
    assert ".: no drive, and holds none" in refused(here, "drives", "add", ".")


def test_what_was_told_can_be_changed(here: Path) -> None:
    write_drive(here / "one", 3)
    (here / "garage").mkdir()
    shutil.copy(here / "one" / "camera.yaml", here / "garage" / "red.yaml")
    done("add", "one", "--library", "garage/all.sqlite", "--car", "red")
    done("set", "one", "--library", "garage/all.sqlite", "--track", "hall", "--camera", "garage/red.yaml")
    done("set", "one", "--library", "garage/all.sqlite", "--car", "")
    entry = Library.open(Path("garage/all.sqlite")).get("one")
    # As the file moves with its folder.
    assert (entry.car, entry.track, entry.camera) == ("", "hall", "red.yaml")
    refusal = refused(
        here, "drives", "set", "one", "--library", "garage/all.sqlite", "--camera", "garage/blue.yaml"
    )
    assert "--camera garage/blue.yaml: no such file" in refusal
    assert "something to set" in refused(here, "drives", "set", "one", "--library", "garage/all.sqlite")


def test_a_drive_that_was_not_copied_is_never_removed_from_disk(here: Path) -> None:
    done("add", "whole", "--copy")
    done("add", "club/car_2/lap")
    assert "no copy of the library and stay" in refused(here, "drives", "remove", "lap", "--files")
    assert f"its files stay in {here / 'club' / 'car_2' / 'lap'}" in done("remove", "lap")
    done("remove", "whole", "--files")
    assert not (here / "drives.files" / "whole").exists()
    assert (here / "whole").is_dir() and (here / "club" / "car_2" / "lap").is_dir()
    assert Library.open().entries() == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("add", "nowhere"), "nowhere: no such drive or folder; expected a drive folder"),
        (("add", "wohle"), "or a folder of them; did you mean whole?"),
        (("add", "club", "--name", "x"), "--name x: is for a single drive, but 2 drives are given"),
        (("show", "wohle"), "no drive 'wohle', did you mean 'whole'?"),
        (("list", "--library", "none.sqlite"), "no such library; lanenet drives add makes it"),
        (("remove", "whole", "x"), "no drive 'x'"),
    ],
)
def test_what_cannot_be_is_one_line(here: Path, words: tuple[str, ...], said: str) -> None:
    done("add", "whole")
    assert said in refused(here, "drives", *words)
    assert [entry.name for entry in Library.open().entries()] == ["whole"]
