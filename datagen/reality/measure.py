"""One drive measured: its frames through the path that training takes, in units of the camera's height."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from datagen.reality.statistics import drive_statistics, edge_statistics
from lanenet.data.drives import Drive
from lanenet.errors import DriveFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.road import PerceptionSettings, RoadTable
from lanenet.perception.edges.static import find_static, spread_frames

#: Assumed height of every camera: real heights are rarely known, and a frame does not show them.
HEIGHT_CM = 20.0
_PERCEPTION, _WINDOW = PerceptionSettings(), BirdseyeWindow()


@dataclass(frozen=True)
class Sampling:
    """How a drive is measured.

    Attributes:
        most: Frames that are measured, evenly over the drive.
        perception: How edges are found.
        window: The network's window.
    """

    most: int
    perception: PerceptionSettings = _PERCEPTION
    window: BirdseyeWindow = _WINDOW


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


def measure_frames(
    name: str,
    read: Callable[[int], UInt8[np.ndarray, "h w *c"]],
    count: int,
    camera: Camera,
    sampling: Sampling,
) -> MeasuredDrive:
    """Measure a drive.

    Args:
        name: Of the drive.
        read: Returns the image of a frame by its place in the drive.
        count: Frames of the drive.
        camera: Its camera; only the direction in which it looks and the lens matter.
        sampling: How to measure it.

    Raises:
        CalibrationError: If the camera sees no road.
        DriveFormatError: If a frame cannot be read.
    """
    camera = at_nominal_height(camera)
    mask = _car_mask(read, count)
    table = RoadTable(camera, sampling.perception.range, mask)
    rows = np.unique(np.linspace(0, count - 1, min(sampling.most, count)).round().astype(int))
    figures = [
        edge_statistics(read(i), table, HEIGHT_CM, sampling.perception, sampling.window)
        for i in rows.tolist()
    ]
    points = [frame.points for frame in figures]
    middle = int(rows[np.argsort(points, kind="stable")[len(points) // 2]])
    return MeasuredDrive(name, drive_statistics(figures), read(middle), camera, mask)


def measure_drive(drive: Drive, camera: Camera, sampling: Sampling) -> MeasuredDrive:
    """Measure a recorded drive, see :func:`measure_frames`.

    Raises:
        DriveFormatError: If its images are not of the camera's size, or cannot be read.
    """
    if (drive.width, drive.height) != (camera.width, camera.height):
        raise DriveFormatError(
            f"{drive.path}: images of {drive.width}x{drive.height} px, but its camera is calibrated for "
            f"{camera.width}x{camera.height}"
        )
    return measure_frames(drive.name, drive.image, len(drive), camera, sampling)


def at_nominal_height(camera: Camera) -> Camera:
    """Return the camera at :data:`HEIGHT_CM`, with the origin of the car's frame below it."""
    old = camera.mounting
    return replace(camera, mounting=Mounting(HEIGHT_CM, old.pitch_down_rad, old.roll_rad, old.yaw_rad))


def _car_mask(
    read: Callable[[int], UInt8[np.ndarray, "h w *c"]], count: int
) -> UInt8[np.ndarray, "h w"] | None:
    """Find the car's own parts, as mapping does."""
    try:
        part = find_static(read(i) for i in spread_frames(count))
    except DriveFormatError:  # too few frames of a moving car
        return None
    return part.mask if part.rows and not part.is_too_high else None
