"""Whether drives shared one camera, and how far apart the cameras are that each of them found.

A camera that was found from a drive has a sigma for each of its numbers. Two drives contradict each other
where a number differs by more than both sigmas allow; what that means is said in pixels over the image and
in centimetres on the road.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lanenet.data.maps.folder import read_map
from lanenet.errors import MapFormatError
from lanenet.geometry.camera import Camera
from lanenet.reading import parsing, read_json

#: Sigmas by which a number of two cameras may differ. Chosen: eight numbers of a few pairs of drives exceed
#: three by chance once in fifty pairs, and a camera that was knocked moves by ten.
MOST_SIGMAS = 3.5
#: Numbers that are compared, each with its least sigma, so that given cameras need not be equal to the last
#: digit. Heights may differ by the share that two lane widths measured with a ruler do, 1.2 % each.
_NUMBERS = {
    "focal": 1e-3,
    "cx": 0.1,
    "cy": 0.1,
    "k1": 1e-3,
    "pitch": 1e-3,
    "roll": 1e-3,
    "yaw": 1e-3,
    "lever": 1e-2,
    "height": 0.02,
}
#: Numbers that have the sigma of another.
_KNOWN_BY = {"height": "focal"}
#: Places on the road at which cameras are compared: across and ahead of the front axle, in camera heights.
_ACROSS, _AHEAD = np.linspace(-1.5, 1.5, 7), np.linspace(0.5, 3.5, 7)


@dataclass(frozen=True, eq=False)
class DriveCamera:
    """The camera of a drive.

    Attributes:
        name: Of the drive or its map, for messages.
        camera: The camera, [cm].
        sigma: Standard deviation of each of its numbers, focal length relative; none for a given camera.
    """

    name: str
    camera: Camera
    sigma: dict[str, float]


def read_drive_camera(folder: Path) -> DriveCamera:
    """Read the camera of a map.

    Raises:
        MapFormatError: If the map cannot be read.
    """
    return DriveCamera(str(folder), read_map(folder).camera, camera_sigma(folder))


def camera_sigma(folder: Path) -> dict[str, float]:
    """Return the sigmas of a camera that was found while its drive was mapped; none for a given one.

    Raises:
        MapFormatError: If the map's report cannot be read.
    """
    file = folder / "report.json"
    plain = read_json(file, MapFormatError)
    with parsing(f"{file}: key 'calibration'", MapFormatError):
        found = plain.get("calibration", {}).get("sigma", {})
        return {str(name): float(value) for name, value in found.items()}


@dataclass(frozen=True)
class CameraDifference:
    """How two cameras differ.

    Attributes:
        sigmas: Difference of each number, in sigmas of both cameras together.
        image_px: RMS distance in the image between where both see the same road.
        ground_cm: RMS distance on the road between what both take the same pixels for, out to 3.5 heights.
    """

    sigmas: dict[str, float]
    image_px: float
    ground_cm: float

    @property
    def worst(self) -> str:
        """The number that differs most."""
        return max(self.sigmas, key=lambda name: abs(self.sigmas[name]))

    @property
    def agree(self) -> bool:
        """Whether the cameras may be one."""
        return abs(self.sigmas[self.worst]) <= MOST_SIGMAS

    @property
    def text(self) -> str:
        """The difference in words."""
        what = f"{self.image_px:.1f} px in the image, {self.ground_cm:.1f} cm on the road (RMS)"
        return f"{what}; most in {self.worst}, {abs(self.sigmas[self.worst]):.1f} sigmas"


def same_lens(drives: Sequence[DriveCamera]) -> bool:
    """Whether cameras are of one kind, with images of one size."""
    return len(set(map(lens_of, drives))) == 1


def lens_of(drive: DriveCamera) -> tuple[str, int, int, int]:
    """Return the kind of a camera: its model, the size of its images, and how many numbers distort them."""
    camera = drive.camera
    return camera.model, camera.width, camera.height, len(camera.D)


def difference(first: DriveCamera, second: DriveCamera) -> CameraDifference:
    """Compare the cameras of two drives; they have to be of one kind."""
    return CameraDifference(sigmas_apart(first, second), *_apart(first.camera, second.camera))


def sigmas_apart(first: DriveCamera, second: DriveCamera) -> dict[str, float]:
    """Return the difference of each number of two cameras, in sigmas of both together."""
    return dict(zip(_NUMBERS, pairwise_sigmas([first, second])[0, 1].tolist(), strict=True))


def pairwise_sigmas(drives: Sequence[DriveCamera]) -> Float[np.ndarray, "n n number"]:
    """Return the difference of each number between all pairs of cameras (column's less row's), in sigmas."""
    values = [numbers(one.camera) for one in drives]
    value = np.array([[own[name] for name in _NUMBERS] for own in values])
    # A height that follows from the lane's width is as unsure as the focal length that it was found with.
    sigma = np.array([[one.sigma.get(_KNOWN_BY.get(name, name), 0.0) for name in _NUMBERS] for one in drives])
    variance = sigma[:, None] ** 2 + sigma[None] ** 2 + np.square(list(_NUMBERS.values()))
    result: Float[np.ndarray, "n n number"] = (value[None] - value[:, None]) / np.sqrt(variance)
    return result


def numbers(camera: Camera) -> dict[str, float]:
    """Return a camera's numbers by their names in the adjustment; focal length and height as logarithms."""
    m = camera.mounting
    return {
        "focal": float(np.log(camera.K[0, 0])),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
        "k1": float(camera.D[0]),
        "pitch": m.pitch_down_rad,
        "roll": m.roll_rad,
        "yaw": m.yaw_rad,
        "lever": (m.ahead_of_front_axle_cm + camera.wheelbase_cm) / m.height_cm,
        "height": float(np.log(m.height_cm)),
    }


def _apart(a: Camera, b: Camera) -> tuple[float, float]:
    """RMS distance between two cameras in the image, [px], and on the road, [cm]."""
    x, y = np.meshgrid(_ACROSS, _AHEAD)
    heights: Float[np.ndarray, "m 2"] = np.column_stack([x.ravel(), y.ravel()])
    points = a.mounting.height_cm * heights
    seen = a.project_ground(points)
    inside = ((seen >= 0.0) & (seen <= [a.width - 1, a.height - 1])).all(axis=1)
    points, seen = points[inside], seen[inside]
    in_image = np.linalg.norm(b.project_ground(points) - seen, axis=1)
    on_road = np.linalg.norm(b.intersect_ground(seen) - points, axis=1)
    rms = [
        float(np.sqrt(np.nanmean(apart**2))) if len(apart) else float("nan") for apart in (in_image, on_road)
    ]
    return rms[0], rms[1]
