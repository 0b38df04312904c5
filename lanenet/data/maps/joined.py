"""Maps of several drives of one track: a folder that holds a map of each drive, in one map frame.

Each is an ordinary map, with its own drive and camera, so that whatever reads a map reads it; they share the
lane lines. ``joined.yaml`` says how each came to lie there.
"""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import Field

from lanenet.config import Settings, check_settings, read_yaml
from lanenet.data.files import write_text
from lanenet.errors import ConfigError, MapFormatError
from lanenet.outputs import restore_output
from lanenet.reading import FolderFiles

FORMAT, JOINED_FILE = "lanenet-joined/1", "joined.yaml"


class JoinedDrive(Settings):
    """One of the drives.

    Attributes:
        map: Folder of its map, inside the joined one.
        made_from: The map that it was joined from, with its full path.
        x_cm, y_cm, turn_rad, scale: How that map was moved onto the first one, before all were adjusted.
        opposite: Whether it was driven in the opposite direction of the first.
    """

    map: str
    made_from: str
    x_cm: float
    y_cm: float
    turn_rad: float
    scale: float = Field(gt=0.0)
    opposite: bool


class JoinedMeta(Settings):
    """What ``joined.yaml`` says.

    Attributes:
        format: Kind and version of the folder.
        shared_camera: Whether all drives have one camera, adjusted together.
        drives: The drives, the first one's map first.
    """

    format: str
    shared_camera: bool
    drives: tuple[JoinedDrive, ...] = Field(min_length=2)


def is_joined(folder: Path) -> bool:
    """Return whether a folder holds joined maps."""
    restore_output(folder)
    return (folder / JOINED_FILE).is_file()


def read_joined(folder: Path) -> JoinedMeta:
    """Read what ``joined.yaml`` says.

    Raises:
        MapFormatError: If it is not there, is of another version, or damaged.
    """
    path = FolderFiles(folder).file(JOINED_FILE, folder, MapFormatError)
    plain = read_yaml(path, MapFormatError)
    if plain.get("format") != FORMAT:
        raise MapFormatError(f"{path}: format is {plain.get('format')!r}, expected {FORMAT!r}")
    try:
        meta = check_settings(JoinedMeta, plain, str(path))
    except ConfigError as error:
        raise MapFormatError(str(error)) from None
    strange = next((one.map for one in meta.drives if Path(one.map).name != one.map), None)
    if strange is not None:
        raise MapFormatError(f"{path}: map {strange!r} is not the name of a folder in it")
    return meta


def write_joined(folder: Path, meta: JoinedMeta) -> None:
    """Write ``joined.yaml`` into an existing folder."""
    write_text(folder / JOINED_FILE, yaml.safe_dump(meta.model_dump(mode="json"), sort_keys=False))


def maps_in(folder: Path) -> list[Path]:
    """Return the maps of a folder: itself, or those of the drives that were joined in it.

    Raises:
        MapFormatError: If it holds joined maps that cannot be read.
    """
    if not is_joined(folder):
        return [folder]
    return [folder / one.map for one in read_joined(folder).drives]
