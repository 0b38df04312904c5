"""A recorded drive in memory, and what all drive formats share to read one.

The images are read on demand. A reader of a format returns :class:`RecordedFrames`, from which
:func:`assemble_drive` makes a :class:`Drive`, together with the ``drive.yaml`` in its folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int, Integer, UInt8
from pydantic import Field

from lanenet.config import Settings, check_settings, read_yaml
from lanenet.data.camera_file import read_camera
from lanenet.data.files import write_text
from lanenet.data.tables import ColumnSpec, read_csv
from lanenet.errors import ConfigError, DriveFormatError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import LaneWidthCm
from lanenet.reading import MAX_IMAGE, FolderFiles, decode_image, is_regular, read_bytes

#: A longer pause is a break: even a slow car has left the road that its last frame showed.
MAX_PAUSE_S = 2.0

#: A longer step within a session is a clock that was set, as that of a Raspberry Pi, which has no battery,
#: once it finds a network. Chosen: a day, which no car drives on.
_LEAP_S = 86_400.0

#: Where no step of a clock is left: that of Donkeycar's default rate (DRIVE_LOOP_HZ = 20).
DEFAULT_PERIOD_S = 0.05
#: Share of the steps in which the clock may stand or go back, one in any case: it was set. Chosen.
_SET_SHARE = 0.01

#: What a drive can be on disk.
Kind = Literal["folder", "tub", "video", "bag"]
COMMAND_NAMES: tuple[str, ...] = ("speed_cm_s", "throttle", "steering_rad", "angle", "yaw_rate_rad_s")
DRIVE_FILE = "drive.yaml"
DRIVE_FORMAT = "lanenet-drive/1"


@runtime_checkable
class ImageSource(Protocol):
    """Source of a drive's images."""

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return image ``row``, BGR.

        Raises:
            DriveFormatError: If it cannot be read; names the file.
        """
        ...


@runtime_checkable
class StoredImages(Protocol):
    """Source of images that lie on disk one by one; those of a video do not."""

    def data(self, row: int) -> bytes:
        """Return image ``row`` as it was stored: an image file, or a message of a bag.

        Raises:
            DriveFormatError: If it cannot be read.
        """
        ...


@dataclass(frozen=True, eq=False)
class Commands:
    """The commands that the car got; None for a command that the drive does not hold.

    Attributes:
        speed_cm_s: Commanded speed.
        throttle: Donkeycar's throttle, -1 to 1.
        steering_rad: Steering angle, positive left.
        angle: Donkeycar's angle, -1 (left) to 1 (right).
        yaw_rate_rad_s: Yaw rate, positive left.
    """

    speed_cm_s: Float[np.ndarray, "n"] | None = None
    throttle: Float[np.ndarray, "n"] | None = None
    steering_rad: Float[np.ndarray, "n"] | None = None
    angle: Float[np.ndarray, "n"] | None = None
    yaw_rate_rad_s: Float[np.ndarray, "n"] | None = None

    def subset(self, rows: Integer[np.ndarray, "m"]) -> Commands:
        """Return the commands of some rows."""
        present = {name: getattr(self, name) for name in COMMAND_NAMES}
        return Commands(**{name: None if v is None else v[rows] for name, v in present.items()})


@dataclass(frozen=True, eq=False)
class Drive:
    """One recorded drive.

    Attributes:
        name: Name of the folder or video.
        path: Its place on disk.
        frames: Frame numbers, strictly increasing.
        t_s: Time of each frame, strictly increasing.
        times_trusted: False if ``t_s`` is the frame number times a guessed period.
        commands: Commanded values; NaN in rows that lack one.
        deleted: True where the driver flagged the frame as unfit for learning.
        breaks: True where a frame does not continue the one before it: another session began, or more than
            ``MAX_PAUSE_S`` passed. False for the first. A shorter gap in the times is no break.
        camera: The camera; None if the drive does not name one.
        lane_width_cm: Distance between the middles of the lane's lines; None if unknown.
        problems: What was wrong with the recording, a sentence each.
        width: Image width, [px].
        height: Image height, [px].
        images: Source of the images.
        rows: Row of each frame in ``images``.
        max_steering_rad: Steering angle at Donkeycar's angle -1; None if unknown.
        notes: Free text of the driver.
        licence: Under what the recording may be used; empty if it does not say.
        standing_s: How long the car stood until each frame, in frames that were left out; None for never.
    """

    name: str
    path: Path
    frames: Int[np.ndarray, "n"]
    t_s: Float[np.ndarray, "n"]
    times_trusted: bool
    commands: Commands
    deleted: Bool[np.ndarray, "n"]
    breaks: Bool[np.ndarray, "n"]
    camera: Camera | None
    lane_width_cm: float | None
    problems: tuple[str, ...]
    width: int
    height: int
    images: ImageSource = field(repr=False)
    rows: Int[np.ndarray, "n"] = field(repr=False)
    max_steering_rad: float | None = None
    notes: str = ""
    licence: str = ""
    standing_s: Float[np.ndarray, "n"] | None = None

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def driven_s(self) -> Float[np.ndarray, "n"]:
        """Time of each frame on a clock that stops while the car stands."""
        return self.t_s if self.standing_s is None else self.t_s - self.standing_s

    def image(self, i: int) -> UInt8[np.ndarray, "h w 3"]:
        """Read the image of frame ``frames[i]``, BGR.

        Raises:
            DriveFormatError: If it is missing, corrupt or of another size than the first; names file and
                frame.
        """
        try:
            image = self.images.read(int(self.rows[i]))
        except DriveFormatError as error:
            raise DriveFormatError(f"frame {self.frames[i]}: {error}") from None
        height, width = image.shape[:2]
        if (width, height) != (self.width, self.height):
            raise DriveFormatError(
                f"frame {self.frames[i]} of {self.path}: image of {width}x{height} px, expected "
                f"{self.width}x{self.height} like the first"
            )
        return image

    def numbered(self, first: int, last: int) -> Drive:
        """Return the frames numbered first to last, both included.

        Raises:
            DriveFormatError: If there is none.
        """
        rows = slice(*np.searchsorted(self.frames, (first, last + 1)).tolist())
        if rows.start >= rows.stop:
            raise DriveFormatError(
                f"{self.path}: no frame from {first} to {last}; it has {self.frames[0]} to {self.frames[-1]}"
            )
        return self.subset(rows)

    def subset(self, keep: slice | Bool[np.ndarray, "_"] | Int[np.ndarray, "_"]) -> Drive:
        """Return some frames of the drive.

        Frames left out by a mask make a break. A slice with a step, or ascending row numbers, thin the drive
        out, which makes none.

        Raises:
            DriveFormatError: If nothing is left.
        """
        rows = np.arange(len(self))[keep]
        if len(rows) == 0:
            raise DriveFormatError(f"{self.path}: the selection has no frames")
        segment = np.cumsum(self.breaks)[rows]
        breaks = np.diff(segment, prepend=segment[0]) > 0
        if not isinstance(keep, slice) and keep.dtype == bool:
            breaks |= np.diff(rows, prepend=rows[0] - 1) > 1
            breaks[0] = False
        return replace(
            self,
            frames=self.frames[rows],
            t_s=self.t_s[rows],
            commands=self.commands.subset(rows),
            deleted=self.deleted[rows],
            breaks=breaks,
            rows=self.rows[rows],
            standing_s=None if self.standing_s is None else self.standing_s[rows],
        )


class ImageFiles:
    """Images in files."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Read one image; see :class:`ImageSource`."""
        return decode_image(self.data(row), self.paths[row], DriveFormatError)

    def data(self, row: int) -> bytes:
        """Return the bytes of one file; see :class:`StoredImages`."""
        return read_bytes(self.paths[row], DriveFormatError, MAX_IMAGE)


def named_file(inside: FolderFiles, name: str, where: object, *folders: str) -> Path | None:
    """Return the file that a recording names, under that name or its last part; None if it is not there.

    Recordings name their files as they lay on the computer that made them, perhaps one with Windows.

    Args:
        inside: The files of the drive.
        name: The name.
        where: File, and key or line, in which the name stands.
        *folders: Folders of the drive in which it is looked for; the drive itself comes first.

    Raises:
        DriveFormatError: If a link leads out of the drive, or no file can have such a name.
    """
    pure = PurePosixPath(name.replace("\\", "/"))
    names = [] if pure.is_absolute() or ".." in pure.parts else [str(pure)]
    names += [pure.name] if pure.name not in ("", "..") else []
    places = (f"{folder}/{each}" if folder else each for each in names for folder in ("", *folders))
    files = (inside.file(place, where, DriveFormatError) for place in places)
    return next(filter(is_regular, files), None)


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
        kind: Its name.
        described: What to expect, for error messages, such as "a Donkeycar tub (manifest.json)".
        recognises: Tells whether a path that exists is such a drive; looks at names only.
        read: Reads a drive that was recognised; raises DriveFormatError if it cannot be used.
        files: Patterns of the files that a command must not overwrite: in the drive's folder, or beside a
            drive that is one file, where ``{stem}`` stands for the file's name without its ending.
    """

    kind: Kind
    described: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path], RecordedFrames]
    files: tuple[str, ...] = ()


def assemble_drive(path: Path, recorded: RecordedFrames) -> Drive:
    """Combine what a reader found with the ``drive.yaml`` in the drive's folder.

    Args:
        path: The drive: a folder or a single file.
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
    t_s, problems = _without_leaps(path, r)
    breaks = np.diff(t_s, prepend=t_s[:1]) > MAX_PAUSE_S
    return Drive(
        name=path.resolve().name if path.is_dir() else path.stem,
        path=path,
        frames=r.frames,
        t_s=t_s,
        times_trusted=r.times_trusted,
        commands=r.commands,
        deleted=np.zeros(len(r.frames), dtype=bool) if r.deleted is None else r.deleted,
        breaks=breaks if r.sessions is None else breaks | r.sessions,
        camera=camera,
        lane_width_cm=file.lane_width_cm,
        problems=(*r.problems, *problems),
        width=width,
        height=height,
        images=r.images,
        rows=rows,
        max_steering_rad=file.max_steering_rad,
        notes=file.notes,
        licence=file.licence,
    )


def goes_back_often(frames: Int[np.ndarray, "n"], t_s: Float[np.ndarray, "n"]) -> str | None:
    """Say where times do not increase, if that is too often for a clock that was set; None if it is not."""
    back = np.diff(t_s) <= 0.0
    if back.sum() <= max(1.0, _SET_SHARE * len(back)):
        return None
    return f"do not increase {back.sum()} times, first at frame {frames[1:][back][0]}"


def without_jumps(
    path: Path, frames: Int[np.ndarray, "n"], t_s: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], list[str]]:
    """Put a typical step where the clock stands or goes back; returns the times, and what was wrong."""
    steps_s = np.diff(t_s)
    back = steps_s <= 0.0
    if not back.any():
        return t_s, []
    typical_s = float(np.median(steps_s[~back])) if (~back).any() else DEFAULT_PERIOD_S
    mended_s = t_s[0] + np.concatenate([[0.0], np.cumsum(np.where(back, typical_s, steps_s))])
    return mended_s, [
        f"{path}: the clock goes back or stands {back.sum()} times, first at frame {frames[1:][back][0]}; a "
        "typical step is taken there"
    ]


def _without_leaps(path: Path, recorded: RecordedFrames) -> tuple[Float[np.ndarray, "n"], list[str]]:
    """Put a typical step where the clock was set forward; returns the times, and what was wrong."""
    steps_s = np.diff(recorded.t_s)
    leaps = steps_s > _LEAP_S
    if recorded.sessions is not None:
        leaps &= ~recorded.sessions[1:]
    if not leaps.any():
        return recorded.t_s, []
    typical_s = float(np.median(steps_s[~leaps])) if not leaps.all() else MAX_PAUSE_S
    t_s = recorded.t_s[0] + np.concatenate([[0.0], np.cumsum(np.where(leaps, typical_s, steps_s))])
    first = int(np.flatnonzero(leaps)[0])
    days = steps_s[first] / _LEAP_S
    return t_s, [
        f"{path}: the clock goes forward by a day or more {leaps.sum()} times, first by {days:.1f} days at "
        f"frame {recorded.frames[first + 1]}; it was set, and a typical step is taken there"
    ]


class DriveFile(Settings):
    """What ``drive.yaml`` says about a drive.

    Attributes:
        format: Kind of folder and version.
        camera: Camera file in the folder.
        lane_width_cm: Distance between the middles of the two lines of the driven lane.
        max_steering_rad: Steering angle at Donkeycar's angle -1.
        topics: Of a ROS 2 bag, those of the images and the commands to use; of a tub with several cameras,
            the input of the one to use; all if empty.
        notes: Free text.
        licence: Under what the recording may be used, as in ``CC-BY-4.0``.
    """

    format: Literal["lanenet-drive/1"]
    camera: str | None = None
    lane_width_cm: LaneWidthCm | None = None
    max_steering_rad: float | None = Field(default=None, gt=0.0, lt=0.5 * math.pi)
    topics: tuple[str, ...] = ()
    notes: str = ""
    licence: str = ""


def drive_file_of(drive: Path) -> Path:
    """Return where ``drive.yaml`` is: in a drive's folder; beside a single file as ``<name>.drive.yaml``."""
    return drive / DRIVE_FILE if drive.is_dir() else drive.with_name(f"{drive.stem}.{DRIVE_FILE}")


def read_drive_file(drive: Path) -> tuple[DriveFile, Camera | None]:
    """Read a drive's ``drive.yaml`` and the camera that it names; defaults if there is no such file.

    Raises:
        DriveFormatError: If the file is of an unknown version, or a key is misspelt or out of range.
        CalibrationError: If the camera file cannot be used.
    """
    path = drive_file_of(drive)
    inside = FolderFiles(path.parent)
    inside.file(path.name, drive, DriveFormatError)
    # A link that leads nowhere is there, too.
    if not os.path.lexists(path):
        return DriveFile(format="lanenet-drive/1"), None
    try:
        file = check_settings(DriveFile, read_yaml(path), str(path))
    except ConfigError as error:
        raise DriveFormatError(str(error)) from None
    if file.camera is None:
        return file, None
    return file, read_camera(inside.file(file.camera, f"{path}: key 'camera'", DriveFormatError))


def write_drive_file(folder: Path, file: DriveFile) -> None:
    """Write a folder's ``drive.yaml``, without keys that are empty."""
    kept = {key: value for key, value in file.model_dump().items() if value not in (None, "", ())}
    write_text(folder / DRIVE_FILE, yaml.safe_dump(kept, sort_keys=False, allow_unicode=True))


#: Bounds of what a recording may hold. Chosen: far above any car and clock, so that sums of them stay finite:
#: Unix time in the year 5138, 360 km/h, and 16 turns a second.
MAX_TIME_S, _MAX_SPEED_CM_S, _MAX_YAW_RATE_RAD_S = 1e11, 1e4, 100.0
COMMAND_SPECS: dict[str, ColumnSpec] = {
    "speed_cm_s": ColumnSpec(required=False, low=-_MAX_SPEED_CM_S, high=_MAX_SPEED_CM_S),
    "throttle": ColumnSpec(required=False, low=-1.0, high=1.0),
    # No car steers by a right angle: such a value is in degrees.
    "steering_rad": ColumnSpec(required=False, low=-0.5 * math.pi, high=0.5 * math.pi),
    "angle": ColumnSpec(required=False, low=-1.0, high=1.0),
    "yaw_rate_rad_s": ColumnSpec(required=False, low=-_MAX_YAW_RATE_RAD_S, high=_MAX_YAW_RATE_RAD_S),
}


def read_times(path: Path, **more: ColumnSpec) -> tuple[dict[str, np.ndarray], Commands, list[str]]:
    """Read a table of frames: number, time and commands.

    A last line that was cut off while it was written is left out.

    Args:
        path: The CSV file.
        **more: Further columns that the table must have.

    Returns:
        The columns, the commands among them, and what was wrong with the times.

    Raises:
        DriveFormatError: If a column is missing, a cell is not a number or out of range, frame numbers do
            not increase, or there is no row; names line and column. If times go back more than now and then.
    """
    specs: dict[str, Any] = {
        "frame": ColumnSpec("int", low=0.0, increasing=True),
        "t_s": ColumnSpec(low=-MAX_TIME_S, high=MAX_TIME_S),
        **COMMAND_SPECS,
        **more,
    }
    columns = read_csv(path, specs, skip_torn=True)
    if len(columns["frame"]) == 0:
        raise DriveFormatError(f"{path}: the drive has no frames")
    if (often := goes_back_often(columns["frame"], columns["t_s"])) is not None:
        raise DriveFormatError(f"{path}: column 't_s': times {often}")
    columns["t_s"], problems = without_jumps(path, columns["frame"], columns["t_s"])
    return columns, Commands(**{name: columns.get(name) for name in COMMAND_NAMES}), problems


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
