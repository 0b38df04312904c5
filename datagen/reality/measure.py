"""One drive measured: its frames through the path that training takes, in units of the camera's height."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from datagen.reality.statistics import FrameFigures, drive_statistics, edge_statistics
from lanenet.data.drives import Drive
from lanenet.errors import DriveFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.road import PerceptionSettings, RoadTable
from lanenet.perception.edges.static import find_static, spread_frames

#: Height at which every camera is taken to be: real heights are rarely known, and a frame does not tell.
HEIGHT_CM = 20.0


@dataclass(frozen=True, eq=False)
class MeasuredDrive:
    """A drive in numbers.

    Attributes:
        name: Of the drive.
        statistics: See :data:`datagen.reality.statistics.STATISTICS`.
        shown: The frame whose number of points is the median one.
        camera: As it was measured, at :data:`HEIGHT_CM`.
        mask: 255 on the car itself; None where it is not in sight.
    """

    name: str
    statistics: dict[str, float]
    shown: UInt8[np.ndarray, "h w *c"]
    camera: Camera
    mask: UInt8[np.ndarray, "h w"] | None


def at_nominal_height(camera: Camera) -> Camera:
    """Return the camera at :data:`HEIGHT_CM`, with the origin of the car's frame below it."""
    mounting = camera.mounting
    return replace(
        camera, mounting=Mounting(HEIGHT_CM, mounting.pitch_down_rad, mounting.roll_rad, mounting.yaw_rad)
    )


def measure_frames(
    name: str,
    read: Callable[[int], UInt8[np.ndarray, "h w *c"]],
    count: int,
    camera: Camera,
    most: int,
    perception: PerceptionSettings | None = None,
    window: BirdseyeWindow | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MeasuredDrive:
    """Measure a drive.

    Args:
        name: Of the drive.
        read: Returns the image of a frame by its place in the drive.
        count: Frames of the drive.
        camera: Its camera; only the direction in which it looks and the lens matter.
        most: Frames to measure, evenly over the drive.
        perception: How edges are found; None takes the defaults.
        window: The network's window; None takes the default.
        progress: Called with (frames done, frames).

    Raises:
        CalibrationError: If the camera sees no road.
        DriveFormatError: If a frame cannot be read.
    """
    perception = PerceptionSettings() if perception is None else perception
    camera = at_nominal_height(camera)
    mask = _car_mask(read, count)
    table = RoadTable(camera, perception.range, mask)
    figures: list[FrameFigures] = []
    rows = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
    for done, i in enumerate(rows.tolist(), start=1):
        figures.append(edge_statistics(read(i), table, HEIGHT_CM, perception, window))
        if progress is not None:
            progress(done, len(rows))
    points = [frame.points for frame in figures]
    middle = int(rows[np.argsort(points, kind="stable")[len(points) // 2]])
    return MeasuredDrive(name, drive_statistics(figures), read(middle), camera, mask)


def measure_drive(
    drive: Drive,
    camera: Camera,
    most: int,
    perception: PerceptionSettings | None = None,
    window: BirdseyeWindow | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MeasuredDrive:
    """Measure a recorded drive, see :func:`measure_frames`.

    Raises:
        DriveFormatError: If its images are not of the camera's size, or cannot be read.
    """
    if (drive.width, drive.height) != (camera.width, camera.height):
        raise DriveFormatError(
            f"{drive.path}: images of {drive.width}x{drive.height} px, but its camera is calibrated for "
            f"{camera.width}x{camera.height}"
        )
    return measure_frames(drive.name, drive.image, len(drive), camera, most, perception, window, progress)


def _car_mask(
    read: Callable[[int], UInt8[np.ndarray, "h w *c"]], count: int
) -> UInt8[np.ndarray, "h w"] | None:
    """Find the car's own parts, as mapping does."""
    try:
        part = find_static(read(i) for i in spread_frames(count))
    except DriveFormatError:  # too few frames of a moving car
        return None
    return part.mask if part.rows and not part.is_too_high else None
