"""A recorded drive in memory: times, commands, and images that are read on demand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Integer, UInt8

from lanenet.errors import DriveFormatError
from lanenet.geometry.camera import Camera

#: A longer pause is a break: a car at 1 m/s would have lost its last frame from sight.
MAX_PAUSE_S = 1.0

COMMAND_NAMES: tuple[str, ...] = ("speed_cm_s", "throttle", "steering_rad", "angle", "yaw_rate_rad_s")


@runtime_checkable
class ImageSource(Protocol):
    """Source of a drive's images."""

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return image ``row``, BGR.

        Raises:
            DriveFormatError: If it cannot be read; names the file.
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
        breaks: True where a frame does not continue the one before it: frame numbers were skipped, another
            session began, or time jumped. False for the first.
        camera: The camera; None if the drive does not name one.
        lane_width_cm: Distance between the middles of the lane's lines; None if unknown.
        problems: What was wrong with the recording, a sentence each.
        width: Image width, [px].
        height: Image height, [px].
        images: Source of the images.
        rows: Row of each frame in ``images``.
        max_steering_rad: Steering angle at Donkeycar's angle -1; None if unknown.
        notes: Free text of the driver.
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

    def __len__(self) -> int:
        return len(self.frames)

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
        )


class ImageFiles:
    """Images in files."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Read one image; see :class:`ImageSource`."""
        return read_image(self.paths[row])


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file, BGR.

    Raises:
        DriveFormatError: If the file is missing, is not an image, or ends too early: OpenCV fills the rest
            of a truncated JPEG with gray without an error.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise DriveFormatError(f"{path}: no such image") from None
    except OSError as error:
        raise DriveFormatError(f"{path}: cannot be read ({error})") from None
    if not data:
        raise DriveFormatError(f"{path}: the image file is empty")
    try:
        image = None if _truncated(data) else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise DriveFormatError(f"{path}: not a readable image (corrupt or cut off, {len(data)} bytes)")
    return np.asarray(image)


def _truncated(data: bytes) -> bool:
    if data.startswith(b"\xff\xd8"):
        # The end marker must follow the last scan: a thumbnail in the header has an end marker, too.
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:]
    return False
