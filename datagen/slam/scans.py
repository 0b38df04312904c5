"""What the mapper sees of a drive: the edge points of every frame, packed for the numba kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.drive import Drive
from lanenet.perception.birdseye import RoadEdgeExtractor, RoadEdges

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Scans:
    """Edge points of all frames in one array.

    Attributes:
        points_cm: Edge points, frame car, all frames one after the other.
        normals: Unit vectors across the edges, towards the brighter side, frame car.
        weights: Trust in each point: 1 near the car, falling with the road that one pixel spans.
        starts: Index of the first point of each frame, with the total at the end.
    """

    points_cm: Float[np.ndarray, "m 2"]
    normals: Float[np.ndarray, "m 2"]
    weights: Float[np.ndarray, "m"]
    starts: Int[np.ndarray, "n1"]

    def __len__(self) -> int:
        return len(self.starts) - 1

    def frame(self, k: int) -> slice:
        """Return the slice of frame k's points."""
        return slice(int(self.starts[k]), int(self.starts[k + 1]))

    @property
    def frame_of_point(self) -> Int[np.ndarray, "m"]:
        """Frame index of every point."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))


def scan_drive(drive: Drive, extractor: RoadEdgeExtractor, progress: Progress | None = None) -> Scans:
    """Extract the edge points of every frame of a drive."""
    frames: list[RoadEdges] = []
    for k in range(len(drive)):
        frames.append(extractor.extract(drive.image(k)))
        if progress is not None:
            progress(k + 1, len(drive))
    return pack_scans(frames, extractor.camera.mounting.height_cm)


def pack_scans(frames: list[RoadEdges], camera_height_cm: float) -> Scans:
    """Pack per-frame edge points; weights halve where a point is about four camera heights away.

    One pixel spans road in proportion to the squared distance, so that the position of a far edge is worth
    less; the smooth fall keeps far points useful for the heading.
    """
    counts = [len(frame.points_cm) for frame in frames]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    points = np.concatenate([np.empty((0, 2)), *(frame.points_cm for frame in frames)])
    normals = np.concatenate([np.empty((0, 2)), *(frame.normals for frame in frames)])
    distance = np.hypot(points[:, 0], points[:, 1]) / (4.0 * camera_height_cm)
    return Scans(points, normals, 1.0 / (1.0 + distance**4), starts)
