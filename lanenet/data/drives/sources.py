"""Where frames to detect on come from: a photo, a folder of photos, or a recorded drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.drives import open_drive
from lanenet.data.drives.recording import read_image
from lanenet.errors import DriveFormatError
from lanenet.geometry.camera import Camera

PHOTO_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm")
#: Photos have no times; in a video they are shown at this rate.
PHOTO_RATE_HZ = 1.0
#: Rate of a drive whose times say nothing.
DEFAULT_RATE_HZ = 20.0


@dataclass(frozen=True)
class Source:
    """Frames read on demand.

    Attributes:
        name: The path, as people know it.
        frames: Frame numbers, increasing.
        t_s: Times, [s]; NaN for photos.
        starts: True where a frame does not continue the one before.
        rate_hz: Frames per second, for a video.
        image: Reads frame i (by position); DriveFormatError naming the file if it cannot.
        camera: Camera that came with the frames.
        lane_width_cm: Lane width that came with them.
        problems: What is known to be wrong with the source.
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

    def __len__(self) -> int:
        return len(self.frames)

    def numbered(self, first: int, last: int) -> Source:
        """Return the part whose frame numbers are first to last, both included.

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
            image=lambda i: whole(start + i),
        )


def open_source(path: Path) -> Source:
    """Open a photo, a folder of photos, a video, a drive or a Donkeycar tub.

    Raises:
        DriveFormatError: If there is nothing there that can be read as one of them.
    """
    if not path.exists():
        raise DriveFormatError(f"{path}: no such file or folder")
    if path.is_file():
        return _photos(path, [path]) if _is_photo(path) else _recorded(path)
    if (path / "frames.csv").exists() or (path / "manifest.json").exists():
        return _recorded(path)
    photos = sorted(p for p in path.iterdir() if _is_photo(p))
    if not photos:
        raise DriveFormatError(
            f"{path}: expected a drive (frames.csv), a Donkeycar tub (manifest.json) or photos "
            f"({', '.join(PHOTO_ENDINGS)}), found none of them"
        )
    return _photos(path, photos)


def _is_photo(path: Path) -> bool:
    # macOS leaves "._name.jpg" beside each file that it copies.
    return path.suffix.lower() in PHOTO_ENDINGS and not path.name.startswith(".")


def _photos(path: Path, files: list[Path]) -> Source:
    def image(i: int) -> UInt8[np.ndarray, "h w 3"]:
        return read_image(files[i])

    count = len(files)
    times = np.full(count, np.nan)
    # Photos need not follow one another: each starts afresh.
    return Source(str(path), np.arange(count), times, np.ones(count, bool), PHOTO_RATE_HZ, image)


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
    )
