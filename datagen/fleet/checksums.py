"""Checksums of the drives' files, which are read again only if their size or time changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from datagen.fleet.source import checksum, drive_files
from datagen.fleet.storage import Storage
from datagen.fleet.task import FleetDrive
from datagen.made import key_of
from lanenet.data.files import json_text
from lanenet.errors import LanenetError

#: The checksums of the drives' files, beside the results.
CHECKSUMS_NAME = "checksums.json"


def with_checksums(drives: Iterable[FleetDrive], storage: Storage) -> list[FleetDrive]:
    """Return the drives with the checksums of their files; without one if they are not there or unreadable.

    Files that have the size and time of an earlier run are not read again.
    """
    known = _known(storage)
    checked, found = [], dict[str, list[str]]()
    for drive in drives:
        pair = _pair(drive.source, known)
        if pair is not None:  # else the run says why, and does the others
            found[drive.source] = pair
        checked.append(replace(drive, checksum="" if pair is None else pair[1]))
    if any(known.get(source) != pair for source, pair in found.items()):
        storage.write(CHECKSUMS_NAME, json_text({**known, **found}).encode())
    return checked


def checksums_now(sources: Iterable[str], storage: Storage) -> dict[str, str]:
    """Return the checksums that drives have now; of those that are there, and writing nothing.

    Args:
        sources: Paths or URLs of the drives.
        storage: Where an earlier run kept what it found.
    """
    known = _known(storage)
    pairs = {source: _pair(source, known) for source in sources}
    return {source: pair[1] for source, pair in pairs.items() if pair is not None}


def _known(storage: Storage) -> dict[str, list[str]]:
    """Return what stands for size and time of each drive's files, and their checksum."""
    known = storage.read_known(CHECKSUMS_NAME)
    return {source: pair for source, pair in known.items() if isinstance(pair, list) and len(pair) == 2}


def _pair(source: str, known: dict[str, list[str]]) -> list[str] | None:
    before = known.get(source, ["", ""])
    try:
        stamp = key_of(drive_files(source))
        return before if before[0] == stamp else [stamp, checksum(source)]
    except (LanenetError, OSError):
        return None
