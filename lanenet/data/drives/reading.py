"""What all drive formats share: what a reader returns, ``drive.yaml``, and tables of times and commands."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int
from pydantic import Field

from lanenet.config import Settings, check_settings, read_yaml
from lanenet.data.camera_file import read_camera
from lanenet.data.drives.recording import COMMAND_NAMES, MAX_PAUSE_S, Commands, Drive, ImageSource
from lanenet.data.files import write_text
from lanenet.data.tables import ColumnSpec, read_csv
from lanenet.errors import ConfigError, DriveFormatError
from lanenet.geometry.camera import Camera

DRIVE_FILE = "drive.yaml"
DRIVE_FORMAT = "lanenet-drive/1"


@dataclass(frozen=True, eq=False)
class RecordedFrames:
    """What a reader of a drive format found.

    Attributes:
        frames: Frame numbers, increasing.
        t_s: Times, increasing.
        commands: Commands of the frames.
        images: Where the images come from.
        problems: What was wrong with the recording, a sentence each.
        rows: Row of each frame in ``images``; None if they are in order.
        times_trusted: False if ``t_s`` is a guess.
        deleted: Frames that the driver flagged as unfit for learning; None for none.
        sessions: True where a session of the recording begins; None for a single one.
    """

    frames: Int[np.ndarray, "n"]
    t_s: Float[np.ndarray, "n"]
    commands: Commands
    images: ImageSource
    problems: tuple[str, ...] = ()
    rows: Int[np.ndarray, "n"] | None = None
    times_trusted: bool = True
    deleted: Bool[np.ndarray, "n"] | None = None
    sessions: Bool[np.ndarray, "n"] | None = None


@dataclass(frozen=True)
class DriveFormat:
    """A way in which drives lie on disk.

    Attributes:
        described: What to expect, for error messages, such as "a Donkeycar tub (manifest.json)".
        recognises: Tells whether a path that exists is such a drive; looks at names only.
        read: Reads a drive that was recognised; raises DriveFormatError if it cannot be used.
        files: Patterns of the files that a command must not overwrite: in the drive's folder, or beside a
            drive that is one file, where ``{stem}`` stands for the file's name without its ending.
    """

    described: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path], RecordedFrames]
    files: tuple[str, ...] = ()


def assemble_drive(path: Path, recorded: RecordedFrames) -> Drive:
    """Combine what a reader found with the ``drive.yaml`` in the drive's folder.

    Args:
        path: The drive: a folder, or a single file, which has no ``drive.yaml``.
        recorded: What the reader found.

    Raises:
        DriveFormatError: If no image can be read, or ``drive.yaml`` or the size of its camera does not fit.
        CalibrationError: If the camera file that ``drive.yaml`` names cannot be used.
    """
    r = recorded
    rows = np.arange(len(r.frames)) if r.rows is None else r.rows
    width, height = _image_size(r.images, rows, path)
    file, camera = read_drive_file(path)
    if camera is not None and (camera.width, camera.height) != (width, height):
        raise DriveFormatError(
            f"{path}: images of {width}x{height} px, but its camera file is for "
            f"{camera.width}x{camera.height} px"
        )
    breaks = _find_breaks(r.frames, r.t_s, r.times_trusted)
    return Drive(
        name=path.resolve().name if path.is_dir() else path.stem,
        path=path,
        frames=r.frames,
        t_s=r.t_s,
        times_trusted=r.times_trusted,
        commands=r.commands,
        deleted=np.zeros(len(r.frames), dtype=bool) if r.deleted is None else r.deleted,
        breaks=breaks if r.sessions is None else breaks | r.sessions,
        camera=camera,
        lane_width_cm=file.lane_width_cm,
        problems=r.problems,
        width=width,
        height=height,
        images=r.images,
        rows=rows,
        max_steering_rad=file.max_steering_rad,
        notes=file.notes,
    )


class DriveFile(Settings):
    """What ``drive.yaml`` says about a drive.

    Attributes:
        format: Kind of folder and version.
        camera: Camera file, relative to the folder.
        lane_width_cm: Distance between the middles of the two lines of the driven lane.
        max_steering_rad: Steering angle at Donkeycar's angle -1.
        notes: Free text.
    """

    format: Literal["lanenet-drive/1"]
    camera: str | None = None
    lane_width_cm: float | None = Field(default=None, gt=0.0)
    max_steering_rad: float | None = Field(default=None, gt=0.0, lt=0.5 * math.pi)
    notes: str = ""


def read_drive_file(folder: Path) -> tuple[DriveFile, Camera | None]:
    """Read a folder's ``drive.yaml`` and the camera that it names; defaults if there is no such file.

    Raises:
        DriveFormatError: If the file is of an unknown version, or a key is misspelt or out of range.
        CalibrationError: If the camera file cannot be used.
    """
    path = folder / DRIVE_FILE
    if not path.exists():
        return DriveFile(format="lanenet-drive/1"), None
    try:
        file = check_settings(DriveFile, read_yaml(path), str(path))
    except ConfigError as error:
        raise DriveFormatError(str(error)) from None
    return file, None if file.camera is None else read_camera(folder / file.camera)


def write_drive_file(folder: Path, file: DriveFile) -> None:
    """Write a folder's ``drive.yaml``, without keys that are empty."""
    kept = {key: value for key, value in file.model_dump().items() if value not in (None, "")}
    write_text(folder / DRIVE_FILE, yaml.safe_dump(kept, sort_keys=False, allow_unicode=True))


_COMMAND_SPECS: dict[str, ColumnSpec] = {
    "speed_cm_s": ColumnSpec(required=False),
    "throttle": ColumnSpec(required=False, low=-1.0, high=1.0),
    # No car steers by a right angle: such a value is in degrees.
    "steering_rad": ColumnSpec(required=False, low=-0.5 * math.pi, high=0.5 * math.pi),
    "angle": ColumnSpec(required=False, low=-1.0, high=1.0),
    "yaw_rate_rad_s": ColumnSpec(required=False),
}


def read_times(path: Path, **more: ColumnSpec) -> tuple[dict[str, np.ndarray], Commands]:
    """Read a table of frames: number, time and commands.

    A last line that was cut off while it was written is left out.

    Args:
        path: The CSV file.
        **more: Further columns that the table must have.

    Returns:
        The columns, and the commands among them.

    Raises:
        DriveFormatError: If a column is missing, a cell is not a number or out of range, frame numbers or
            times do not increase, or there is no row; names line and column.
    """
    specs: dict[str, Any] = {
        "frame": ColumnSpec("int", low=0.0, increasing=True),
        "t_s": ColumnSpec(increasing=True),
        **_COMMAND_SPECS,
        **more,
    }
    columns = read_csv(path, specs, skip_torn=True)
    if len(columns["frame"]) == 0:
        raise DriveFormatError(f"{path}: the drive has no frames")
    return columns, Commands(**{name: columns.get(name) for name in COMMAND_NAMES})


def _image_size(images: ImageSource, rows: Int[np.ndarray, "n"], where: Path) -> tuple[int, int]:
    """Return width and height of the first image that can be read.

    Raises:
        DriveFormatError: If there is none; says what is wrong with the first.
    """
    reason = "no frames"
    for k, row in enumerate(rows):
        try:
            height, width = images.read(int(row)).shape[:2]
        except DriveFormatError as error:
            reason = str(error) if k == 0 else reason
            continue
        return int(width), int(height)
    raise DriveFormatError(f"{where}: none of the {len(rows)} frames has a readable image ({reason})")


def _find_breaks(
    frames: Int[np.ndarray, "n"], t_s: Float[np.ndarray, "n"], times_trusted: bool
) -> Bool[np.ndarray, "n"]:
    """Return True at each frame after a gap in the numbers, or after a pause if times can be trusted.

    A gap is more than the median step of the numbers: a drive may number every second frame.
    """
    breaks = np.zeros(len(frames), dtype=bool)
    if len(frames) > 1:
        steps = np.diff(frames)
        breaks[1:] = steps > max(1.0, float(np.median(steps)))
        if times_trusted:
            breaks[1:] |= np.diff(t_s) > MAX_PAUSE_S
    return breaks
