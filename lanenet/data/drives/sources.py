"""Frames for a detector: a photo, a folder of photos, or a drive; and the mask of the car in them."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.drives import (
    PHOTO_ENDINGS,
    Commands,
    drive_above,
    find_format,
    formats_text,
    is_photo,
    meant_instead,
    open_drive,
    refuse_foreign,
)
from lanenet.data.drives.tub import is_old
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.static import find_static, spread_frames
from lanenet.reading import natural_key, read_image

#: Photos have no times; an annotated video shows one per second.
PHOTO_RATE_HZ = 1.0
#: Rate of a drive with a single frame: Donkeycar's default.
DEFAULT_RATE_HZ = 20.0


@dataclass(frozen=True)
class Source:
    """Frames read on demand.

    Attributes:
        name: The path as it was given.
        frames: Frame numbers, increasing.
        t_s: Times, [s]; NaN for photos.
        starts: True where a frame does not continue the one before it.
        rate_hz: Frames per second, for a video.
        image: Reads the image at position i; raises DriveFormatError naming the file.
        camera: Camera that the frames name.
        lane_width_cm: Lane width that they name.
        problems: What is wrong with the source, a sentence each.
        commands: What was commanded; None of photos.
    """

    name: str
    frames: Int[np.ndarray, "n"]
    t_s: Float[np.ndarray, "n"]
    starts: Bool[np.ndarray, "n"]
    rate_hz: float
    image: Callable[[int], UInt8[np.ndarray, "h w 3"]]
    camera: Camera | None = None
    lane_width_cm: float | None = None
    problems: tuple[str, ...] = ()
    commands: Commands | None = None

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def way_to_camera(self) -> str:
        """How to find the camera of these frames: the end of an error."""
        drive = "DRIVE" if np.isnan(self.t_s).any() else shlex.quote(self.name)
        return f"a map finds it: lanenet map {drive} --lane-width CM --out MAP, then --camera MAP"

    def numbered(self, first: int, last: int) -> Source:
        """Return the frames numbered first to last, both included.

        Raises:
            DriveFormatError: If there is none.
        """
        rows = np.flatnonzero((self.frames >= first) & (self.frames <= last))
        if not rows.size:
            raise DriveFormatError(
                f"{self.name}: no frame from {first} to {last}; it has {self.frames[0]} to {self.frames[-1]}"
            )
        whole, start = self.image, int(rows[0])
        return replace(
            self,
            frames=self.frames[rows],
            t_s=self.t_s[rows],
            starts=self.starts[rows],
            commands=None if self.commands is None else self.commands.subset(rows),
            image=lambda i: whole(start + i),
        )


def open_source(path: Path) -> Source:
    """Open a photo, a folder of photos, a video, a drive or a Donkeycar tub.

    Raises:
        DriveFormatError: If there is nothing there that can be read as one of them.
    """
    if not path.exists():
        raise DriveFormatError(f"{path}: no such file or folder")
    if find_format(path) is not None:
        return _recorded(path)
    photos = sorted(path.iterdir(), key=natural_key) if path.is_dir() else [path]
    photos = [photo for photo in photos if is_photo(photo)]
    # Images of a recording are none: they have times, commands and an order.
    if not photos or is_old(path):
        refuse_foreign(path)
        raise DriveFormatError(
            f"{path}: expected {formats_text()}, or photos ({', '.join(PHOTO_ENDINGS)}), found none of them"
            f"{meant_instead(path)}"
        )
    return _photos(path, photos)


def check_size(source: Source, camera: Camera, where: Path) -> None:
    """Refuse a camera for frames of another size, by the first frame that can be read.

    Args:
        source: The frames.
        camera: The camera.
        where: Its file, or what named it.

    Raises:
        CalibrationError: Names both sizes, and how to find the camera.
    """
    for i in range(len(source)):
        with contextlib.suppress(DriveFormatError):
            height, width = source.image(i).shape[:2]
            break
    else:
        return
    if (camera.width, camera.height) != (width, height):
        raise CalibrationError(
            f"{where}: the camera is for {camera.width}x{camera.height} px, the images of {source.name} have "
            f"{width}x{height}: expected the camera that took them, at this size; {source.way_to_camera}"
        )


def _photos(path: Path, files: list[Path]) -> Source:
    def image(i: int) -> UInt8[np.ndarray, "h w 3"]:
        return read_image(files[i], DriveFormatError)

    count = len(files)
    times = np.full(count, np.nan)
    problems: tuple[str, ...] = ()
    if (drive := drive_above(path)) is not None:
        whole = f"to have them in order and with their times, type {shlex.quote(str(drive))}"
        problems = (f"{path}: the images of a drive, each taken by itself; {whole}",)
    # No photo continues the one before it.
    starts = np.ones(count, bool)
    return Source(str(path), np.arange(count), times, starts, PHOTO_RATE_HZ, image, problems=problems)


def _recorded(path: Path) -> Source:
    drive = open_drive(path)
    steps = np.diff(drive.t_s)
    rate = 1.0 / float(np.median(steps)) if steps.size and np.median(steps) > 0.0 else DEFAULT_RATE_HZ
    return Source(
        str(path),
        drive.frames,
        drive.t_s,
        drive.breaks,
        float(np.clip(rate, 1.0, 120.0)),
        drive.image,
        drive.camera,
        drive.lane_width_cm,
        drive.problems,
        drive.commands,
    )


def find_mask(source: Source) -> tuple[UInt8[np.ndarray, "h w"] | None, str]:
    """Find the car itself in a source's frames: what never moves at their bottom.

    Args:
        source: Frames of a moving car; unreadable ones are skipped.

    Returns:
        255 on the car and 0 elsewhere, or None if it was not found; and a message that says which.
    """

    def frames() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for i in spread_frames(len(source)):
            with contextlib.suppress(DriveFormatError):
                yield source.image(i)

    try:
        static = find_static(frames())
    except DriveFormatError as error:
        return None, f"no mask: {error}"
    mask, rows = static.mask, static.rows
    if not rows:
        return None, "no mask: nothing stays in place at the bottom of the frames"
    if static.is_too_high:
        return None, (
            f"no mask: something in the lowest {rows} of {mask.shape[0]} rows never moves, which is too high "
            "for the car; if it is the car, give a PNG of it"
        )
    return mask, f"mask: {np.count_nonzero(mask)} px in the lowest {rows} rows show the car"


def read_mask(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Read a PNG that is black except on the car.

    Args:
        path: The PNG, gray or colour.

    Returns:
        255 where any colour channel is above 0, and 0 elsewhere; transparency is ignored.

    Raises:
        ConfigError: If the file is missing, is no PNG (in a JPEG black is not exactly 0), or masks all.
    """
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: expected 'auto' or a .png that is black except on the car")
    picture = read_image(path, ConfigError, cv2.IMREAD_UNCHANGED)
    if picture.ndim == 3:
        picture = picture[..., :3].max(axis=2)
    if picture.all():
        raise ConfigError(f"{path}: masks the whole image; expected 0 where the road can be seen")
    return np.where(picture > 0, 255, 0).astype(np.uint8)
