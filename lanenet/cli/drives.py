"""``lanenet drives``: a library of drives, in which each recording is known again under any name."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import lane_cm
from lanenet.data.files import json_text
from lanenet.data.library import DEFAULT_LIBRARY, Entry, Library
from lanenet.data.library.overlap import Overlap
from lanenet.errors import ConfigError, LanenetError, SameRecordingError, counted

app = typer.Typer(
    name="drives",
    no_args_is_help=True,
    help="A library of drives: which there are, of which car and track, and which are copies of each other.",
)

#: Folders deep in which drives are looked for. Chosen: ``course/team/mycar/data/tub_1``.
_DEPTH = 5

_Names = Annotated[list[str], typer.Argument(metavar="NAME...", help="Drives of the library.")]
_File = Annotated[Path, typer.Option("--library", metavar="FILE", help="The library.")]
_Json = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]
_Car = Annotated[str | None, typer.Option(help="Name of the car.")]
_Camera = Annotated[str | None, typer.Option(help="Camera YAML or an earlier map of the car, or a name.")]
_Track = Annotated[str | None, typer.Option(help="Name of the track.")]
_Licence = Annotated[
    str | None, typer.Option("--licence", "--license", help="Under what the recording may be used.")
]
_Notes = Annotated[str | None, typer.Option(help="Anything else.")]
_LaneWidth = Annotated[
    float | None,
    typer.Option(
        "--lane-width",
        parser=lane_cm,
        metavar="CM",
        help="Between the middles of the lane's two lines, cm.",
    ),
]


@app.command(epilog="Example: lanenet drives add my_tub --car red --track hall --lane-width 40")
def add(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="DRIVE...", help="Tubs, drive folders, videos or bags; folders of them."),
    ],
    file: _File = DEFAULT_LIBRARY,
    name: Annotated[
        str | None, typer.Option(help="Name in the library, of a single drive; default: that of its files.")
    ] = None,
    copy: Annotated[
        bool, typer.Option("--copy", help="Copy the drives beside the library; default: note where they are.")
    ] = False,
    car: _Car = None,
    camera: _Camera = None,
    track: _Track = None,
    licence: _Licence = None,
    notes: _Notes = None,
    lane_width: _LaneWidth = None,
    force: Annotated[
        bool, typer.Option("--force", help="Add a recording again that the library holds already.")
    ] = False,
) -> None:
    """Add drives, and say which of them are copies or cuts of each other.

    A recording that is there under another name is not added twice. Copies that were encoded again and cuts
    that overlap are added, and kept as relations: training refuses to learn from the one and test on the
    other.
    """
    library = Library.open(file, create=True)
    told = _told(library, car, camera, track, licence, notes, lane_width)
    found = _drives_of(library, sources)
    if name is not None and len(found) > 1:
        raise ConfigError(
            f"--name {name}: is for a single drive, but {counted(len(found), 'drive')} are given"
        )
    before, failed = len(library.entries()), list[str]()
    for path in found:
        try:
            _add(library, path, name, copy, force, told)
        except LanenetError as error:
            failed.append(str(error))
    entries = library.entries()
    if len(found) > 1:
        added = len(entries) - before
        there = len(found) - added - len(failed)
        console.say(f"{counted(added, 'drive')} added, {there} there already, {len(failed)} not added")
        console.show_problems(failed)
    if failed:
        raise LanenetError(f"{counted(len(failed), 'drive')} not added, the first: {failed[0]}")
    if all(entry.lane_width_cm is not None for entry in entries):
        console.next_command("label-all", "--library", file, "--out", "runs/labelled")


@app.command(name="list", epilog="Example: lanenet drives list --track hall")
def list_drives(
    file: _File = DEFAULT_LIBRARY,
    car: Annotated[str | None, typer.Option(help="Only drives of this car.")] = None,
    track: Annotated[str | None, typer.Option(help="Only drives of this track.")] = None,
    json: _Json = False,
) -> None:
    """List the drives, with what is known of them and with which they share frames."""
    library = Library.open(file)
    relations = library.all_relations()
    entries = [
        entry
        for entry in library.entries()
        if (car is None or entry.car == car) and (track is None or entry.track == track)
    ]
    if json:
        console.say(json_text([_as_dict(library, entry, relations) for entry in entries]).rstrip())
        return
    _show_table(file, entries, relations)
    tracks = {entry.track for entry in entries if entry.track}
    frames, seconds = sum(entry.frames for entry in entries), sum(entry.duration_s for entry in entries)
    console.show_lines(
        [
            f"{counted(len(entries), 'drive')} on {counted(len(tracks), 'named track')}, "
            f"{counted(frames, 'frame')}, {console.duration(seconds)}"
        ]
    )


@app.command(epilog="Example: lanenet drives show my_tub --check")
def show(
    names: _Names,
    file: _File = DEFAULT_LIBRARY,
    check: Annotated[
        bool, typer.Option("--check", help="Read the files again: are they what was added?")
    ] = False,
    json: _Json = False,
) -> None:
    """Show all that is known of a drive, what it shares with others, and whether its files are there."""
    library = Library.open(file)
    relations = library.all_relations()
    entries = [library.get(name) for name in names]
    if json:
        console.say(json_text([_as_dict(library, entry, relations) for entry in entries]).rstrip())
    failed: list[str] = []
    for entry in entries:
        found = "are there" if library.path_of(entry).exists() else "are gone"
        try:
            if check:
                library.check(entry.name)
                found = "are there, and are what was added"
        except LanenetError as error:
            failed.append(str(error))
            found = str(error)
        if not json:
            _show_entry(library, entry, found)
    if failed:
        raise LanenetError(
            f"{counted(len(failed), 'drive')} not as they were added, the first: {failed[0]}"
            if len(entries) > 1
            else failed[0]
        )


@app.command(name="set", epilog="Example: lanenet drives set my_tub other_tub --track hall")
def set_told(
    names: _Names,
    file: _File = DEFAULT_LIBRARY,
    car: _Car = None,
    camera: _Camera = None,
    track: _Track = None,
    licence: _Licence = None,
    notes: _Notes = None,
    lane_width: _LaneWidth = None,
) -> None:
    """Change what the library was told of drives; an empty text takes it back."""
    library = Library.open(file)
    told = _told(library, car, camera, track, licence, notes, lane_width)
    if not told:
        raise ConfigError("expected something to set, as in --track hall")
    for entry in [library.get(name) for name in names]:
        library.update(entry.name, **told)
        console.say(f"{entry.name}: {', '.join(f'{key} {value}' for key, value in told.items())}")


@app.command(epilog="Example: lanenet drives remove old_tub")
def remove(
    names: _Names,
    file: _File = DEFAULT_LIBRARY,
    files: Annotated[
        bool,
        typer.Option("--files", help="Also remove the files of drives that were added with --copy."),
    ] = False,
) -> None:
    """Take drives out of the library; drives that are elsewhere stay where they are."""
    library = Library.open(file)
    for entry in [library.get(name) for name in names]:
        library.remove(entry.name, files=files)
        gone = "with its copy" if files else f"its files stay in {library.path_of(entry)}"
        console.say(f"{entry.name}: removed from {file}, {gone}")


def _told(
    library: Library,
    car: str | None,
    camera: str | None,
    track: str | None,
    licence: str | None,
    notes: str | None,
    lane_width: float | None,
) -> dict[str, Any]:
    """Return what options say of drives, without those that are not given."""
    told = {
        "car": car,
        "camera": None if camera is None else _camera_text(library, camera),
        "track": track,
        "licence": licence,
        "notes": notes,
        "lane_width_cm": lane_width,
    }
    return {key: value for key, value in told.items() if value is not None}


def _camera_text(library: Library, text: str) -> str:
    """Return a camera as the library keeps it: a path from its folder, where it is one; else a name.

    Raises:
        ConfigError: If it looks like a file and is none.
    """
    path = Path(text)
    if text and path.exists():
        full = path.resolve()
        return str(full.relative_to(library.folder) if full.is_relative_to(library.folder) else full)
    if path.suffix in (".yaml", ".yml") or len(path.parts) > 1:
        raise ConfigError(f"--camera {text}: no such file, expected a camera YAML, a map, or a name")
    return text


def _drives_of(library: Library, sources: list[Path]) -> list[Path]:
    """Return the drives that paths name: each is one, or a folder of some.

    Raises:
        LanenetError: If a path is no drive and holds none.
    """
    from lanenet.data.drives import drives_in, find_format, formats_text, meant_instead

    found: list[Path] = []
    for source in sources:
        # What training and mapping leave are videos in folders of theirs, and copies are the library's own.
        inside = [source] if find_format(source) is not None else sorted(drives_in(source, _DEPTH))
        inside = [path for path in inside if not path.resolve().is_relative_to(library.copies)]
        inside = [path for path in inside if not (path.parent / "map.yaml").is_file()]
        if not inside:
            what = "no drive, and holds none" if source.exists() else "no such drive or folder"
            meant = "" if source.exists() else meant_instead(source)
            raise ConfigError(f"{source}: {what}; expected {formats_text()}, or a folder of them{meant}")
        found += inside
    return list(dict.fromkeys(found))


def _add(
    library: Library, path: Path, name: str | None, copy: bool, force: bool, told: dict[str, Any]
) -> None:
    """Add a drive and say what it is to the others.

    Raises:
        LanenetError: If it cannot be added, or was to get a name of its own and is there.
    """
    here = next((e for e in library.entries() if library.path_of(e).resolve() == path.resolve()), None)
    if here is not None and not force:
        library.check(here.name)
        console.say(f"{path}: is in the library as {here.name}")
        if any(told.values()):
            console.show_problems(
                [f"{here.name}: what was said of it is not changed; use lanenet drives set"]
            )
        return
    try:
        with console.progress_bar(f"read {path.name}") as progress:
            entry = library.add(path, name=name, copy=copy, force=force, progress=progress, **told)
    except SameRecordingError as error:
        if name is not None:
            raise
        console.say(f"{error}; not added again")
        there = library.path_of(library.get(error.name))
        if not there.exists():
            moved = f"{there} is gone: lanenet drives remove {error.name}, then add {path} again"
            console.show_problems([moved])
        return
    how = "copied" if entry.copied else "by reference"
    console.say(
        f"{entry.name}: added {how}, {entry.kind}, {counted(entry.frames, 'frame')}, "
        f"{console.duration(entry.duration_s)}"
    )
    console.show_problems(library.relation_sentences(entry.name))


def _show_table(file: Path, entries: list[Entry], relations: dict[str, list[tuple[str, Overlap]]]) -> None:
    """Print a row per drive; a column in which nothing is known of any is left out."""
    rows = [
        {
            "drive": entry.name,
            "track": entry.track,
            "car": entry.car,
            "kind": f"{entry.kind}, copied" if entry.copied else entry.kind,
            "shares frames with": ", ".join(sorted({other for other, _ in relations.get(entry.name, [])})),
            "lane, cm": "" if entry.lane_width_cm is None else f"{entry.lane_width_cm:g}",
            "frames": str(entry.frames),
            "min": f"{entry.duration_s / 60.0:.1f}",
        }
        for entry in entries
    ]
    if not rows:
        return
    columns = [column for column in rows[0] if any(row[column] for row in rows)]
    texts = len(columns) - sum(column in ("lane, cm", "frames", "min") for column in columns)
    console.show_table(str(file), columns, [[row[column] for column in columns] for row in rows], texts)


def _show_entry(library: Library, entry: Entry, found: str) -> None:
    """Print all about a drive, a line each."""
    told = {
        "source": f"{library.path_of(entry)} ({'a copy' if entry.copied else 'by reference'})",
        "its files": found,
        "kind": entry.kind,
        "frames": f"{entry.frames}, {console.duration(entry.duration_s)}",
        "car": entry.car,
        "camera": entry.camera,
        "track": entry.track,
        "licence": entry.licence,
        "lane width": "" if entry.lane_width_cm is None else f"{entry.lane_width_cm:g} cm",
        "notes": entry.notes,
        "added": entry.added_at,
        "checksum": entry.checksum,
    }
    console.say(entry.name)
    console.show_lines([f"{key:12s}{value or 'not known'}" for key, value in told.items()])
    console.show_lines(library.relation_sentences(entry.name) or ["shares frames with no other drive"])


def _as_dict(
    library: Library, entry: Entry, relations: dict[str, list[tuple[str, Overlap]]]
) -> dict[str, Any]:
    """Return all about a drive, for programs."""
    shared = [{"drive": other, **asdict(overlap)} for other, overlap in relations.get(entry.name, [])]
    path = library.path_of(entry)
    return {
        **asdict(entry),
        "source": entry.source.as_posix(),
        "path": str(path),
        "there": path.exists(),
        "relations": shared,
    }
