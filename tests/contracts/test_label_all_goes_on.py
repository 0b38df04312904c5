"""``lanenet label-all`` over drives of which some can do harm: the others are done, each says why not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from drives import record, write_drive, write_tub

from datagen.fleet.checksums import CHECKSUMS_NAME


def with_image(replace: Callable[[Path], None]) -> Callable[[Path], Path]:
    """A drive one image of which is something else."""

    def make(folder: Path) -> Path:
        path = write_drive(folder / "bad", 5)
        (path / "images" / "000001.jpg").unlink()
        replace(path / "images" / "000001.jpg")
        return path

    return make


def beside(make: Callable[[Path], None]) -> Callable[[Path], Path]:
    """A drive with something else in its folder."""

    def act(folder: Path) -> Path:
        path = write_drive(folder / "bad", 7)
        make(path)
        return path

    return act


def latin_1(folder: Path) -> Path:
    path = write_drive(folder / "bad", 5)
    (path / "drive.yaml").write_bytes("format: lanenet-drive/1\nnotes: Straße\n".encode("latin-1"))
    return path


def latin_1_name(folder: Path) -> Path:
    path = Path(os.fsdecode(os.fsencode(str(folder)) + b"/stra\xdfe"))
    return write_drive(folder / "x", 5).rename(path)


def locked(folder: Path) -> Path:
    path = write_tub(folder / "bad", [record(k) for k in range(5)])
    (path / "images").chmod(0)
    return path


def pipe_as_table(folder: Path) -> Path:
    path = write_drive(folder / "bad", 5)
    (path / "truth.csv").unlink(missing_ok=True)
    os.mkfifo(path / "truth.csv")
    return path


TOO_SHORT = "expected 60 at least"
HARMFUL: dict[str, tuple[Callable[[Path], Path], str]] = {
    "an image that is a pipe": (with_image(lambda path: os.mkfifo(path)), "is a pipe"),
    "an image that is a device": (with_image(lambda path: path.symlink_to("/dev/zero")), "copy it there"),
    "a pipe beside": (beside(lambda path: os.mkfifo(path / "notes")), TOO_SHORT),
    "a device beside": (beside(lambda path: (path / "zero").symlink_to("/dev/zero")), TOO_SHORT),
    "a name inside that is no UTF-8": (
        beside(lambda path: Path(os.fsdecode(os.fsencode(str(path)) + b"/stra\xdfe")).touch()),
        TOO_SHORT,
    ),
    "no UTF-8": (latin_1, "cannot be read as text"),
    "a name that is no UTF-8": (latin_1_name, TOO_SHORT),
    "a pipe as truth": (pipe_as_table, TOO_SHORT),
    "locked": (locked, "" if os.geteuid() == 0 else "ermission"),
}


def label_all(folder: Path, *sources: Path) -> dict[str, dict[str, str]]:
    """Run the command; return name, verdict and reason of each drive by its source's name."""
    words = [
        "label-all",
        *map(str, sources),
        "--lane-width",
        "40",
        "--workers",
        "1",
        "--out",
        str(folder / "out"),
    ]
    # In a process of its own, since a pipe without a writer is waited for.
    done = subprocess.run(
        [sys.executable, "-m", "lanenet", *words],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=100,
    )
    assert "Traceback" not in done.stderr and done.returncode in (0, 1), done.stderr
    drives = json.loads((folder / "out" / "drives.json").read_text())["drives"]
    return {each["name"]: each for each in drives}


def test_each_drive_is_done_or_says_why(tmp_path: Path) -> None:
    """All at once, since a run takes seconds: what one does to the others is what counts."""
    sources = {}
    for number, (name, (make, _)) in enumerate(HARMFUL.items()):
        (tmp_path / f"{number}").mkdir()
        made = make(tmp_path / f"{number}")
        # Recordings of the same content are done once.
        sources[name] = made.rename(made.with_name(f"{made.name}_{number}"))
    good = write_drive(tmp_path / "good", 6)
    found = label_all(tmp_path, *sources.values(), good)
    assert len(found) == len(HARMFUL) + 1
    assert TOO_SHORT in found["good"]["reason"]
    for number, (name, (_, words)) in enumerate(HARMFUL.items()):
        each = next(each for known, each in found.items() if known.endswith(f"_{number}"))
        same = each["verdict"] == "duplicate"
        assert same or words in each["reason"], (name, each["reason"])
    # A cache that a power cut tore, or that holds something else, is made anew.
    for text in ('{"a": ["x"', "[1, 2]", '{"a": 5}'):
        (tmp_path / "out" / CHECKSUMS_NAME).write_text(text)
        assert {name: each["verdict"] for name, each in label_all(tmp_path, good).items()} == {
            "good": "refused"
        }
        assert str(good) in json.loads((tmp_path / "out" / CHECKSUMS_NAME).read_text())


@pytest.mark.parametrize(
    "make", [os.mkfifo, lambda path: Path(path).symlink_to("/dev/zero")], ids=["pipe", "device"]
)
def test_a_drive_that_is_no_file_stops_nothing(tmp_path: Path, make: Callable[[str], None]) -> None:
    make(str(tmp_path / "clip.mp4"))
    good = write_drive(tmp_path / "good", 6)
    found = label_all(tmp_path, tmp_path / "clip.mp4", good)
    assert {name: each["verdict"] for name, each in found.items()} == {"clip": "failed", "good": "refused"}
    assert "no file" in found["clip"]["reason"]
    assert list(label_all(tmp_path, tmp_path)) == ["good"]
