"""One uninterrupted stretch of a drive: tracked, its loops closed, adjusted, its laps counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.map_settings import MapSettings
from datagen.slam.bundle import CAMERA_NAMES, BundleResult, adjust
from datagen.slam.calibrate import mapping_range
from datagen.slam.filter import Trajectory
from datagen.slam.mapper import SteeringFit, commands_of, track
from datagen.slam.places import (
    Revisit,
    consistent_revisits,
    match_places,
    path_lengths,
    propose_revisits,
    thumbnails,
)
from datagen.slam.posegraph import close_loops
from datagen.slam.scans import Progress, Scans, edges_of_drive, scans_of
from lanenet.data.drive import Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.birdseye import RoadTable

#: What the open loop can tell of the camera; the focal length runs away before the loop is closed.
_OPEN_LOOP = ("pitch", "roll", "yaw", "lever")
#: Where around a revisit more pairs of frames show the same place, in frames.
_BESIDE_REVISIT = range(-12, 13, 4)


@dataclass(frozen=True)
class SolvedSegment:
    """A tracked, closed and adjusted segment, in the scale of its camera.

    Attributes:
        camera: The camera, adjusted where it was not known.
        scans: Edge points per frame, with the camera as it nodded in each.
        trajectory: Open-loop trajectory of the particle filter.
        poses: Rear-axle poses after closing loops, frame map.
        steering: How curvature answers to the command, where it does.
        revisits: Places seen twice.
        residuals: What each revisit misses after closing: ahead, left, heading.
        drift_rad_per_cm: Heading that the open loop missed per length; None without a revisit.
        bundle: The adjustment.
    """

    camera: Camera
    scans: Scans
    trajectory: Trajectory
    poses: Float[np.ndarray, "n 3"]
    steering: SteeringFit | None
    revisits: list[Revisit]
    residuals: Float[np.ndarray, "r 3"]
    drift_rad_per_cm: float | None
    bundle: BundleResult

    @property
    def path_cm(self) -> Float[np.ndarray, "n"]:
        """Length of the path up to each frame."""
        return path_lengths(self.poses)

    @property
    def laps(self) -> Int[np.ndarray, "n"]:
        """Lap of each frame, from 0."""
        return count_laps(self.path_cm, self.revisits)


def solve_segment(
    drive: Drive,
    camera: Camera,
    settings: MapSettings,
    rng: np.random.Generator,
    progress: Progress | None,
    find_camera: bool = False,
) -> SolvedSegment:
    """Track one segment, close its loops, and adjust all of it together.

    Args:
        drive: The segment.
        camera: Its camera, or a coarse guess of it.
        settings: Settings of all stages.
        rng: Source of randomness.
        progress: Called with (done, total).
        find_camera: Adjust the camera too.
    """
    height = camera.mounting.height_cm
    limits = mapping_range(height, settings.perception.range)
    edges = edges_of_drive(drive, settings.perception.edges, RoadTable(camera, limits))
    scans = scans_of(edges, camera, limits)
    if len(scans.points_cm) < 20 * len(scans):
        raise TrackingLostError(
            f"{drive.path}: {len(scans.points_cm) / max(len(scans), 1):.0f} edge points per frame on the "
            "road; mapping needs 20"
        )
    commands = commands_of(drive, camera.wheelbase_cm)
    trajectory, steering = track(scans, commands, camera, settings.filter, settings.motion, rng, progress)
    bundle = adjust(
        edges, trajectory.poses, camera, settings.bundle, rng, free=_OPEN_LOOP if find_camera else ()
    )
    scans = scans_of(edges, bundle.camera, limits, bundle.tilt)
    pairs = propose_revisits(thumbnails(drive), bundle.poses, height, settings.revisits)
    found = [
        match_places(scans, bundle.poses, pair, height, camera.wheelbase_cm, settings.revisits, rng)
        for pair in pairs
    ]
    matched = [revisit for revisit in found if revisit is not None]
    revisits: list[Revisit] = []
    residuals, drift = np.empty((0, 3)), None
    open_bundle = bundle
    for kept, rate in consistent_revisits(bundle.poses, matched, settings.revisits):
        poses, missed = close_loops(open_bundle.poses, kept, height)
        closed = adjust(
            edges,
            poses,
            open_bundle.camera,
            settings.bundle,
            rng,
            free=_OPEN_LOOP if find_camera else (),
            loops=_loops(kept, len(drive)),
            tilt=open_bundle.tilt,
        )
        if not revisits or closed.misfit < bundle.misfit:
            bundle, revisits, residuals, drift = closed, kept, missed, rate
    if revisits and find_camera:
        loops = _loops(revisits, len(drive))
        bundle = adjust(
            edges,
            bundle.poses,
            bundle.camera,
            settings.bundle,
            rng,
            free=CAMERA_NAMES,
            loops=loops,
            tilt=bundle.tilt,
        )
    if revisits:
        scans = scans_of(edges, bundle.camera, limits, bundle.tilt)
    return SolvedSegment(
        bundle.camera,
        scans,
        trajectory,
        bundle.poses,
        steering,
        revisits,
        residuals,
        drift,
        bundle,
    )


def _loops(revisits: list[Revisit], frames: int) -> list[tuple[int, int]]:
    """Pairs of frames around each revisit that show the same place."""
    pairs = [(r.earlier + d, r.later + d) for r in revisits for d in _BESIDE_REVISIT]
    return [(a, b) for a, b in pairs if a >= 0 and b < frames]


def count_laps(path_cm: Float[np.ndarray, "n"], revisits: list[Revisit]) -> Int[np.ndarray, "n"]:
    """Number the laps from 0; a lap is as long as the path between one visit of a place and the next."""
    if not revisits:
        return np.zeros(len(path_cm), dtype=np.int64)
    gaps = np.sort([path_cm[r.later] - path_cm[r.earlier] for r in revisits])
    # Later visits may skip laps: the shortest gaps are those of one lap.
    lap_cm = float(np.median(gaps[gaps < 1.4 * np.percentile(gaps, 10)]))
    return (path_cm // lap_cm).astype(np.int64)
