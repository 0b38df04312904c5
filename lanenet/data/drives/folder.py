"""A drive as lanenet keeps it: a folder with ``frames.csv``, images, and perhaps drive.yaml and truth.csv."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field

from lanenet.config import Settings, check_settings, read_yaml
from lanenet.data.camera_file import read_camera
from lanenet.data.drives.recording import (
    COMMAND_NAMES,
    Commands,
    Drive,
    ImageFiles,
    ImageSource,
    find_breaks,
    first_size,
)
from lanenet.data.tables import ColumnSpec, is_torn, read_csv
from lanenet.errors import ConfigError, DriveFormatError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES

FRAMES_FILE = "frames.csv"
DRIVE_FILE = "drive.yaml"
TRUTH_FILE = "truth.csv"
DRIVE_FORMAT = "lanenet-drive/1"

#: Columns of truth.csv beside ``frame``.
TRUTH_NAMES: tuple[str, ...] = ("x_cm", "y_cm", "heading_rad", *POINT_NAMES)

COMMAND_SPECS: dict[str, ColumnSpec] = {
    "speed_cm_s": ColumnSpec(required=False),
    "throttle": ColumnSpec(required=False, low=-1.0, high=1.0),
    # A right angle or more is an angle in degrees.
    "steering_rad": ColumnSpec(required=False, low=-0.5 * math.pi, high=0.5 * math.pi),
    "angle": ColumnSpec(required=False, low=-1.0, high=1.0),
    "yaw_rate_rad_s": ColumnSpec(required=False),
}


class DriveFile(Settings):
    """What ``drive.yaml`` says about a drive.

    Attributes:
        format: Kind of folder and version.
        camera: Camera file, relative to the folder.
        lane_width_cm: Distance between the middles of the two lines of the driven lane.
        max_steering_rad: Steering angle at Donkeycar's angle -1.
        notes: Anything worth knowing.
    """

    format: Literal["lanenet-drive/1"]
    camera: str | None = None
    lane_width_cm: float | None = Field(default=None, gt=0.0)
    max_steering_rad: float | None = Field(default=None, gt=0.0, lt=0.5 * math.pi)
    notes: str = ""


def read_drive_file(folder: Path) -> tuple[DriveFile, Camera | None]:
    """Read a folder's ``drive.yaml`` and the camera that it names; defaults where there is none.

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


def check_camera_size(camera: Camera | None, width: int, height: int, where: Path) -> None:
    """Refuse a camera that was calibrated for another image size.

    Raises:
        DriveFormatError: Naming both sizes.
    """
    if camera is not None and (camera.width, camera.height) != (width, height):
        raise DriveFormatError(
            f"{where}: images of {width}x{height} px, but its camera file is for "
            f"{camera.width}x{camera.height} px"
        )


def read_times(path: Path, with_files: bool) -> tuple[dict[str, np.ndarray], Commands]:
    """Read ``frames.csv``, or the CSV beside a video, which has no ``file``.

    A last line that was cut off while it was written is left out.

    Returns:
        The columns, and the commands among them.

    Raises:
        DriveFormatError: If a column is missing, a cell is not a number or out of range, frame numbers or
            times do not increase, or there is no row; names line and column.
    """
    specs = {
        "frame": ColumnSpec("int", low=0.0, increasing=True),
        "t_s": ColumnSpec(increasing=True),
        **COMMAND_SPECS,
    }
    if with_files:
        specs["file"] = ColumnSpec("text")
    columns = read_csv(path, specs, skip_torn=True)
    if len(columns["frame"]) == 0:
        raise DriveFormatError(f"{path}: the drive has no frames")
    return columns, Commands(**{name: columns.get(name) for name in COMMAND_NAMES})


def drive_of(
    path: Path,
    frames: Int[np.ndarray, "n"],
    t_s: Float[np.ndarray, "n"],
    commands: Commands,
    images: ImageSource,
    problems: list[str],
    *,
    rows: Int[np.ndarray, "n"] | None = None,
    times_trusted: bool = True,
    deleted: Bool[np.ndarray, "n"] | None = None,
    sessions: Bool[np.ndarray, "n"] | None = None,
) -> Drive:
    """Put together what a reader has found, with what a ``drive.yaml`` in the drive's folder says.

    Args:
        path: The drive: a folder, or a video, which has no ``drive.yaml``.
        frames: Frame numbers.
        t_s: Times.
        commands: What the car was told.
        images: Where the images come from.
        problems: What was wrong with the recording.
        rows: Row of each frame in ``images``; None for one after the other.
        times_trusted: Whether the times are those of the frames.
        deleted: Frames not to be learned from; None for none.
        sessions: True where a session of the recording begins; None for a single one.

    Raises:
        DriveFormatError: If no image can be read, or ``drive.yaml`` or its camera's size does not fit.
        CalibrationError: If the camera file that ``drive.yaml`` names cannot be used.
    """
    rows = np.arange(len(frames)) if rows is None else rows
    width, height = first_size(images, rows, path)
    file, camera = read_drive_file(path) if path.is_dir() else (DriveFile(format="lanenet-drive/1"), None)
    check_camera_size(camera, width, height, path)
    breaks = find_breaks(frames, t_s, times_trusted)
    return Drive(
        name=path.resolve().name if path.is_dir() else path.stem,
        path=path,
        frames=frames,
        t_s=t_s,
        times_trusted=times_trusted,
        commands=commands,
        deleted=np.zeros(len(frames), dtype=bool) if deleted is None else deleted,
        breaks=breaks if sessions is None else breaks | sessions,
        camera=camera,
        lane_width_cm=file.lane_width_cm,
        problems=tuple(problems),
        width=width,
        height=height,
        images=images,
        rows=rows,
        max_steering_rad=file.max_steering_rad,
        notes=file.notes,
    )


def open_folder(path: Path) -> Drive:
    """Open a drive folder; images stay on disk.

    Raises:
        DriveFormatError: If ``frames.csv`` or ``drive.yaml`` cannot be used, or no image can be read.
        CalibrationError: If the camera file that it names cannot be used.
    """
    columns, commands = read_times(path / FRAMES_FILE, with_files=True)
    frames, t_s = columns["frame"], columns["t_s"]
    images = ImageFiles([path / name for name in columns["file"].tolist()])
    missing = [i for i, image in enumerate(images.paths) if not image.is_file()]
    problems: list[str] = []
    if is_torn(path / FRAMES_FILE):
        problems.append(f"{path / FRAMES_FILE}: its last line is cut off and left out")
    if missing:
        problems.append(
            f"{path / FRAMES_FILE}: {len(missing)} of {len(frames)} images are missing (first: frame "
            f"{frames[missing[0]]}, {columns['file'][missing[0]]})"
        )
    return drive_of(path, frames, t_s, commands, images, problems)


def read_truth(path: Path) -> dict[str, np.ndarray] | None:
    """Read the ground truth of a drive folder.

    Args:
        path: The drive folder, or the ``truth.csv`` in it.

    Returns:
        ``frame`` (int64), ``x_cm``, ``y_cm`` and ``heading_rad`` of the rear axle in the map, and the six
        label columns, NaN where the truth has no line there. None if the drive has no truth.

    Raises:
        DriveFormatError: If ``truth.csv`` cannot be used; names line and column.
    """
    path = Path(path)
    file = path if path.name == TRUTH_FILE else path / TRUTH_FILE
    if not file.exists():
        return None
    specs = {"frame": ColumnSpec("int", low=0.0, increasing=True)}
    specs |= {name: ColumnSpec(allow_empty=name in POINT_NAMES) for name in TRUTH_NAMES}
    return read_csv(file, specs)
