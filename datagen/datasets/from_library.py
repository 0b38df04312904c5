"""The recorded drives of a run from a library: all of a track's drives in one part."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from datagen.datasets.settings import ROLES, DataSettings, LibrarySettings, RecordedSettings, Role
from datagen.fleet.checksums import checksums_now
from datagen.fleet.result import INDEX_FORMAT, INDEX_NAME
from datagen.fleet.storage import Storage
from lanenet.data.library import Entry, Library
from lanenet.errors import ConfigError, counted
from lanenet.reading import read_json

#: Names in a message; chosen.
_MOST_NAMED = 5


def with_library(data: DataSettings) -> tuple[DataSettings, list[str]]:
    """Return the settings with the drives of their library listed one by one.

    Args:
        data: Settings of a run; without a library they stay as they are.

    Returns:
        The settings without a library, and lines that say which track is in which part.

    Raises:
        LibraryError: If the library cannot be read.
        ConfigError: If a drive lacks its track or lane width, or there are too few tracks; names them.
    """
    chosen = data.library
    if chosen is None:
        return data, []
    library = Library.open(chosen.file)
    entries = library.entries()
    _refuse_unknown(chosen.file, "track", "--track NAME", [e.name for e in entries if not e.track])
    lacking = [e.name for e in entries if e.lane_width_cm is None]
    _refuse_unknown(chosen.file, "lane width", "--lane-width CM", lacking)
    paths = {entry.name: library.path_of(entry) for entry in entries}
    lines: list[str] = []
    if chosen.labelled is not None:
        paths, lines = _labelled(chosen.labelled, paths)
        entries = [entry for entry in entries if entry.name in paths]
    part_of = parts_of_tracks({entry.track for entry in entries}, chosen)
    often = {"counts_as": chosen.counts_as, "weight": chosen.weight}
    drives = [
        _recorded(
            library, entry, paths[entry.name], part_of[entry.track], finished=bool(chosen.labelled)
        ).model_copy(update=often)
        for entry in entries
    ]
    for role in ROLES:
        tracks = sorted(track for track, part in part_of.items() if part == role)
        count = sum(drive.split == role for drive in drives)
        if count:
            lines.append(f"{role}: {counted(count, 'drive')} of the tracks {', '.join(tracks)}")
    # Checked again, since a drive may be listed by hand, too.
    listed = {"library": None, "known_drives": chosen.file, "drives": (*data.drives, *drives)}
    return DataSettings(**{**dict(data), **listed}), lines


def parts_of_tracks(tracks: Iterable[str], settings: LibrarySettings) -> dict[str, Role]:
    """Return the part of each track: as the settings say, the others drawn by their names and the seed.

    A track keeps its place in the draw when others come and go, so that at most those at the borders between
    the parts change theirs.

    Raises:
        ConfigError: If a track that is to be in a part is not there, or a part would be empty.
    """
    known = set(tracks)
    if settings.split != "track":
        return dict.fromkeys(known, settings.split)
    named: dict[str, Role] = {
        **dict.fromkeys(settings.validation_tracks, "validation"),
        **dict.fromkeys(settings.test_tracks, "test"),
    }
    missing = sorted(set(named) - known)
    if missing:
        raise ConfigError(
            f"data.library: {settings.file} has no drive of the track {missing[0]!r}, expected one of "
            f"{', '.join(sorted(known))}"
        )
    drawn = sorted(known - set(named), key=lambda track: _draw(settings.seed, track))
    result = dict(named)
    # From both ends, so that the two parts do not move each other.
    if not settings.test_tracks:
        count = math.ceil(settings.test_share * len(known))
        result |= dict.fromkeys(drawn[:count], "test")
        drawn = drawn[count:]
    if not settings.validation_tracks:
        count = len(drawn) - math.ceil(settings.validation_share * len(known))
        result |= dict.fromkeys(drawn[max(0, count) :], "validation")
        drawn = drawn[: max(0, count)]
    result |= dict.fromkeys(drawn, "train")
    empty = [role for role in ROLES if role not in result.values()]
    if empty:
        raise ConfigError(
            f"data.library: {settings.file} has drives of {counted(len(known), 'track')}, which leave none "
            f"for {' and '.join(empty)}; expected a track or more for each of train, validation and test"
        )
    return result


def _draw(seed: int, track: str) -> bytes:
    return hashlib.sha256(f"{seed}/{track}".encode()).digest()


def _recorded(library: Library, entry: Entry, path: Path, part: Role, *, finished: bool) -> RecordedSettings:
    # The camera may also be just a name.
    camera = library.folder / entry.camera if entry.camera and not finished else None
    return RecordedSettings.model_validate(
        {
            "path": path,
            "lane_width_cm": entry.lane_width_cm,
            "camera": camera if camera is not None and camera.exists() else None,
            "split": part,
            "name": entry.name,
            "track": entry.track,
            "licence": entry.licence,
            "car": entry.car,
        }
    )


def _labelled(folder: Path, sources: dict[str, Path]) -> tuple[dict[str, Path], list[str]]:
    """Return the maps that ``label-all`` made of drives, and which drives have none.

    Args:
        folder: Its results.
        sources: Where each drive lies: a name may be that of another drive by now, of another track.

    Raises:
        ConfigError: If the folder is not one of ``label-all``.
    """
    index: Any = read_json(folder / INDEX_NAME, ConfigError)
    if not isinstance(index, dict) or index.get("format") != INDEX_FORMAT:
        raise ConfigError(f"{folder / INDEX_NAME}: expected what lanenet label-all writes ({INDEX_FORMAT})")
    made = {drive["name"]: drive for drive in index["drives"]}
    now = checksums_now([str(source.resolve()) for source in sources.values()], Storage(str(folder)))
    paths, lines = dict[str, Path](), list[str]()
    for name, source in sources.items():
        found = made.get(name)
        if found is None:
            lines.append(f"left out: {name}: not labelled yet")
        elif found["source"] != str(source.resolve()):
            lines.append(
                f"left out: {name}: labelled from {found['source']}, but is {source}; label it again"
            )
        elif now.get(found["source"], found["checksum"]) != found["checksum"]:
            lines.append(f"left out: {name}: its files have changed since it was labelled; label it again")
        elif not found["labels"]:
            lines.append(f"left out: {name}: {found['reason']}")
        else:
            paths[name] = folder / found["map"]
    return paths, lines


def _refuse_unknown(file: Path, what: str, option: str, names: list[str]) -> None:
    if names:
        more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
        raise ConfigError(
            f"data.library: {file}: {counted(len(names), 'drive')} without a {what}: "
            f"{', '.join(names[:_MOST_NAMED])}{more}; type lanenet drives set {names[0]} {option}"
        )
