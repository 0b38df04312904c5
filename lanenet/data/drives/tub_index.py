"""Index of a tub: ``manifest.json``, and which catalogs there are, whatever it says.

Donkeycar writes the manifest's last line anew for every record, so that a power cut tears, empties or
outdates it, while catalogs and images are whole.
"""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from lanenet.data.drives.recording import DRIVE_FORMAT, drive_file_of, named_file, read_drive_file
from lanenet.data.drives.tub_rows import first_row
from lanenet.errors import DriveFormatError, counted
from lanenet.reading import MAX_JSON, FolderFiles, is_regular, natural_key, read_bytes

MANIFEST_FILE = "manifest.json"
#: Names of catalogs that belong to a tub although the manifest does not list them.
CATALOGS = "catalog_*.catalog"
#: Endings of images as Donkeycar and tools for tubs write them.
_IMAGE_ENDINGS = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class TubIndex:
    """What a tub holds.

    Attributes:
        catalogs: Catalogs that are there, in order.
        deleted: Indexes of the rows that the driver deleted.
        image_key: Key of the images in a row.
        problems: What was wrong, a sentence each.
    """

    catalogs: list[Path]
    deleted: set[int]
    image_key: str
    problems: list[str]


@dataclass(frozen=True)
class _Manifest:
    names: list[str]
    deleted: set[int]
    image_keys: list[str]
    problems: list[str]


def read_index(path: Path, inside: FolderFiles) -> TubIndex:
    """Read the manifest of a tub, as far as it is whole, and look which catalogs are there.

    Args:
        path: The tub.
        inside: Its files.

    Raises:
        DriveFormatError: If there is no catalog, a catalog lies elsewhere, or the rows name several images
            and ``drive.yaml`` does not say which to use.
    """
    manifest = _read_manifest(inside.file(MANIFEST_FILE, path, DriveFormatError))
    where = path / MANIFEST_FILE
    key = f"{where}: key 'paths'"
    listed = {name: named_file(inside, name, key) for name in manifest.names}
    absent = [name for name, file in listed.items() if file is None]
    present = dict.fromkeys(file for file in listed.values() if file is not None)
    # The data decide, not the index; links are checked as those of the manifest are.
    found = [inside.file(file.name, path, DriveFormatError) for file in path.glob(CATALOGS)]
    unlisted = sorted((file for file in found if file not in present and is_regular(file)), key=natural_key)
    catalogs = [*present, *unlisted]
    problems = list(manifest.problems)
    if not catalogs:
        lost = f"{', '.join(absent)} are not there" if absent else "the manifest lists no catalog"
        torn = f" ({problems[0]})" if problems else ""
        raise DriveFormatError(f"{where}: the tub is empty: {lost}{torn}")
    if absent:
        problems.append(f"{where}: catalogs listed but not there: {', '.join(absent)}")
    if unlisted and manifest.names:
        names = ", ".join(file.name for file in unlisted)
        problems.append(f"{where}: does not list {names}, read all the same")
    if all(PurePosixPath(file.name).match(CATALOGS) for file in catalogs):
        # Tools list them in the order of text, catalog_10 before catalog_2.
        catalogs.sort(key=lambda file: natural_key(file.name))
    return TubIndex(catalogs, manifest.deleted, _image_key(path, catalogs, manifest.image_keys), problems)


def _read_manifest(path: Path) -> _Manifest:
    """Read the lines of a manifest that are whole."""
    if not is_regular(path):
        return _Manifest([], set(), [], [f"{path}: not there; the catalogs in the folder are read"])
    text = read_bytes(path, DriveFormatError, MAX_JSON).decode("utf-8-sig", errors="replace")
    values: list[Any] = []
    torn: list[tuple[int, str]] = []
    for number, line in enumerate(text.split("\n"), start=1):
        if stripped := line.strip("\0 \t\r\n"):
            try:
                values.append(json.loads(stripped))
            except (ValueError, RecursionError) as error:
                torn.append((number, type(error).__name__))
    catalogs = [value for value in values if isinstance(value, dict) and "paths" in value]
    about = catalogs[-1] if catalogs else {"paths": []}
    problems = []
    # Once each: a catalog that is listed a million times is still one.
    names, deleted = dict[str, None](), set[int]()
    if isinstance(about["paths"], list):
        plain = (str(name).replace("\\", "/") for name in about["paths"])
        # macOS adds a "._name" beside each file that it copies.
        names = dict.fromkeys(name for name in plain if not PurePosixPath(name).name.startswith("._"))
    else:
        problems.append(f"{path}: 'paths' is no list of catalogs; those in the folder are read")
    listed = about.get("deleted_indexes", [])
    # Tools write them as texts or with a decimal point, too.
    indexes = {str(index).removesuffix(".0") for index in listed} if isinstance(listed, list) else {""}
    if all(re.fullmatch("[0-9]{1,18}", index) for index in indexes):
        deleted = set(map(int, indexes))
    else:
        problems.append(
            f"{path}: 'deleted_indexes' is no list of whole numbers; which frames were deleted is not known"
        )
    if not catalogs:
        line = f"line {torn[0][0]} is torn" if torn else "is empty" if not values else "has no torn line"
        problems.append(
            f"{path}: {line}: expected five lines of JSON, the last with the catalogs' 'paths', found "
            f"{counted(len(values), 'whole one')}; the catalogs in the folder are read, and which frames "
            "were deleted is not known"
        )
    elif torn:
        problems.append(f"{path}: line {torn[0][0]} is torn, and left out")
    return _Manifest([*names], deleted, _image_keys(values), problems)


def _image_keys(values: list[Any]) -> list[str]:
    """Return the inputs whose type is an image: the manifest's first line holds names, its second types."""
    if len(values) < 2 or not isinstance(values[0], list) or not isinstance(values[1], list):
        return []
    if len(values[0]) != len(values[1]):
        return []
    return [str(name) for name, kind in zip(values[0], values[1], strict=True) if kind == "image_array"]


def _image_key(path: Path, catalogs: list[Path], known: list[str]) -> str:
    """Return the key of the images to use.

    Raises:
        DriveFormatError: If there are several and ``drive.yaml`` does not name one of them.
    """
    row = next((row for row in map(first_row, catalogs) if row), {})
    # The data decide, not the index.
    keys = [key for key in known if key in row] or [
        key
        for key, value in row.items()
        if isinstance(value, str) and value.lower().endswith(_IMAGE_ENDINGS) and "depth" not in key
    ]
    file, _ = read_drive_file(path)
    where = drive_file_of(path)
    if wanted := file.topics:
        if len(wanted) > 1 or wanted[0] not in keys:
            raise DriveFormatError(
                f"{where}: key 'topics': found {', '.join(wanted)}, expected one of {', '.join(keys)}"
            )
        return wanted[0]
    if len(keys) > 1:
        raise DriveFormatError(
            f"{path}: {len(keys)} inputs of images: {', '.join(keys)}; write into {shlex.quote(str(where))} "
            f"which camera looks ahead: 'format: {DRIVE_FORMAT}' and 'topics: [{keys[0]}]'"
        )
    return keys[0] if keys else "cam/image_array"
