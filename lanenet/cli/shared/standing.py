"""``lanenet`` without a verb: what lies in this folder, and what comes next."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lanenet.cli.shared import console
from lanenet.cli.shared.own_drive import learned_from
from lanenet.config import read_yaml
from lanenet.data.drives import find_format
from lanenet.errors import LanenetError
from lanenet.outputs import restore_output
from lanenet.viewers.mcap_file import is_own

#: Folders deep that are looked into, and how many in all. Chosen: ``mycar/data/tub_1`` is found from the one
#: above ``mycar``, and a home folder takes about a second.
_DEPTH, _MOST_FOLDERS = 3, 1000
#: Where ``train`` puts the maps that it makes, below the folder of its run.
_MADE_MAPS = Path("drives") / "maps"
#: The car's file, as the tutorial has it, and what it is a copy of.
_CAR, _TEMPLATE = Path("car.yaml"), Path("configs/car/picamera_pca9685.yaml")
#: Names of one kind that are listed.
_MOST_NAMED = 4


@dataclass(frozen=True)
class Standing:
    """What lies in a folder, each by its path relative to it, in the order of names.

    Attributes:
        drives: Tubs, drive folders and, in the folder itself, videos.
        maps: Maps that can be used, with the full path of their drive.
        refused: Rejected maps and the reports of drives that gave none, with the full path of the drive.
        label_sets: Label sets, known by the report beside them.
        checkpoints: Checkpoint folders.
    """

    drives: tuple[Path, ...]
    maps: dict[Path, Path]
    refused: dict[Path, Path]
    label_sets: tuple[Path, ...]
    checkpoints: tuple[Path, ...]


def look_around(folder: Path) -> Standing:
    """Find drives, maps, label sets and checkpoints in a folder and those in it, by the names of files."""
    drives, checkpoints, labels = [], [], []
    maps: dict[Path, Path] = {}
    refused: dict[Path, Path] = {}
    for path, entries in _folders(folder):
        files = [entry for entry in entries if not entry.is_dir()]
        labels += [file for file in files if file.suffix == ".parquet" and file.with_suffix(".json") in files]
        if path == folder:
            drives += [file for file in files if find_format(file) is not None and not is_own(file)]
        if path / "map.yaml" in files:
            meta = _content(path / "map.yaml")
            rejected = meta.get("verdict") not in ("good", "usable")
            (refused if rejected else maps)[path] = _drive_of(meta)
        elif path / "refused.yaml" in files:
            refused[path] = _drive_of(_content(path / "refused.yaml"))
        elif path / "checkpoint.yaml" in files:
            checkpoints.append(path)
        elif find_format(path) is not None:
            drives.append(path)
    return Standing(tuple(drives), maps, refused, tuple(labels), tuple(checkpoints))


def say_standing(folder: Path) -> None:
    """Print what lies in a folder and what comes next.

    Args:
        folder: The working folder, as ``Path()``: its names are printed as a command takes them.
    """
    here = look_around(folder)
    rows = {
        "drives": [str(path) for path in here.drives],
        "maps": [str(path) for path in here.maps],
        "no good map": [str(path) for path in here.refused],
        "label sets": [str(path) for path in here.label_sets],
        "checkpoints": [str(path) for path in here.checkpoints],
    }
    if any(rows.values()):
        console.say("In this folder:")
        for kind, names in rows.items():
            more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
            if names:
                console.show_lines([f"{kind:<12} {', '.join(names[:_MOST_NAMED])}{more}"])
    else:
        console.say("Neither a drive nor a map, a label set or a checkpoint lies in this folder.")
    say_next(here)
    console.say("lanenet --help lists all commands; lanenet COMMAND --help shows an example of each")


def say_next(here: Standing) -> None:
    """Print the next step from what lies in a folder to a driving car."""
    trained = {drive: path for path in here.checkpoints for drive in learned_from(path / "run.yaml")}
    mapped = {path.resolve() for path in here.maps.values()}
    tried = {path.resolve(): at for at, path in here.refused.items()}
    new = [drive for drive in here.drives if drive.resolve() not in {*mapped, *trained}]
    unlearned = [path for path, drive in here.maps.items() if drive.resolve() not in trained]
    if unlearned:
        console.next_command("train", unlearned[0], "--name", unlearned[0].name)
    elif here.maps:
        next_on_car(trained[next(iter(here.maps.values())).resolve()])
    elif untried := [drive for drive in new if drive.resolve() not in tried]:
        name = untried[0].resolve().stem
        lengths = ("--lane-width", "CM", "--wheelbase", "CM")
        console.next_command("train", untried[0], *lengths, "--name", name)
    elif here.refused:
        console.say(f"next: read why there is no map, in {next(iter(here.refused)) / 'report.html'}")
    elif trained:
        next_on_car(next(iter(trained.values())))
    else:
        console.say(
            "next: copy a drive here (a Donkeycar tub, a folder with frames.csv, or a video), then "
            "lanenet train DRIVE --lane-width CM --wheelbase CM --name NAME"
        )


def next_on_car(checkpoint: Path = Path("checkpoints/NAME")) -> None:
    """Print what comes next once there is a network: a drive, or making and checking the car's file."""
    own = checkpoint / _CAR
    if _CAR.is_file():
        console.next_command("drive", _CAR, "--dry-run")
    elif own.is_file():
        console.next_command("doctor", "--config", own)
    else:
        copied = shlex.join(["cp", str(_TEMPLATE), str(own)])
        checked = shlex.join(["lanenet", "doctor", "--config", str(own)])
        console.say(f"next, for the car: {copied}, set its pulses, then {checked}")


def _folders(top: Path) -> Iterator[tuple[Path, list[Path]]]:
    """Yield folders with their sorted contents, the nearest first; what a found thing holds is left out."""
    level, looked, seen = [top], 0, set[Path]()
    for depth in range(_DEPTH + 1):
        below: list[Path] = []
        for path in level:
            if path in seen:
                continue
            seen.add(path)
            restore_output(path)
            try:
                entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
            except OSError:  # closed to this user
                continue
            looked += 1
            yield path, entries
            if depth < _DEPTH and (path / _MADE_MAPS).is_dir():
                below += sorted(entry for entry in (path / _MADE_MAPS).iterdir() if entry.is_dir())
            known = ("map.yaml", "refused.yaml", "checkpoint.yaml")
            whole = any(path / name in entries for name in known) or find_format(path) is not None
            if depth < _DEPTH and not whole and looked + len(below) < _MOST_FOLDERS:
                below += [entry for entry in entries if entry.is_dir() and not entry.is_symlink()]
        level = below[: _MOST_FOLDERS - looked]


def _content(path: Path) -> dict[str, Any]:
    try:
        return read_yaml(path)
    except LanenetError:  # listed as a map that is of no use
        return {}


def _drive_of(meta: dict[str, Any]) -> Path:
    return Path(str(meta.get("drive", "")))
