"""One uninterrupted stretch of a drive: tracked, its loops closed, its laps counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.map_settings import MapSettings
from datagen.slam.calibrate import heading_error_per_lap, mapping_range, next_yaw
from datagen.slam.filter import Trajectory
from datagen.slam.mapper import SteeringFit, commands_of, track
from datagen.slam.places import Revisit, match_places, path_lengths, propose_revisits, thumbnails
from datagen.slam.posegraph import close_loops
from datagen.slam.scans import Progress, Scans, scan_drive
from lanenet.data.drive import Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.birdseye import RoadEdgeExtractor

_YAW_ROUNDS = 3
_YAW_GOOD_ENOUGH_RAD = 0.02  # of heading per lap


@dataclass(frozen=True)
class SolvedSegment:
    """A tracked and closed segment, in the scale of its camera.

    Attributes:
        scans: Edge points per frame.
        trajectory: Open-loop trajectory.
        poses: Rear-axle poses after closing loops, frame map.
        steering: How curvature answers to the command, where it does.
        revisits: Places seen twice.
        residuals: What each revisit misses after closing: ahead, left, heading.
        heading_drift_rad: Heading that the open loop misses per lap; None without a revisit.
    """

    scans: Scans
    trajectory: Trajectory
    poses: Float[np.ndarray, "n 3"]
    steering: SteeringFit | None
    revisits: list[Revisit]
    residuals: Float[np.ndarray, "r 3"]
    heading_drift_rad: float | None

    @property
    def path_cm(self) -> Float[np.ndarray, "n"]:
        """Length of the path up to each frame."""
        return path_lengths(self.poses)

    @property
    def laps(self) -> Int[np.ndarray, "n"]:
        """Lap of each frame, from 0."""
        return count_laps(self.path_cm, self.revisits)


def solve_segment(
    drive: Drive, camera: Camera, settings: MapSettings, rng: np.random.Generator, progress: Progress | None
) -> SolvedSegment:
    """Track one segment and close its loops."""
    height = camera.mounting.height_cm
    perception = settings.perception.model_copy(
        update={"range": mapping_range(height, settings.perception.range)}
    )
    scans = scan_drive(drive, RoadEdgeExtractor(camera, perception))
    if len(scans.points_cm) < 20 * len(scans):
        raise TrackingLostError(
            f"{drive.path}: {len(scans.points_cm) / max(len(scans), 1):.0f} edge points per frame on the "
            "road; mapping needs 20"
        )
    commands = commands_of(drive, camera.wheelbase_cm)
    trajectory, steering = track(scans, commands, camera, settings.filter, settings.motion, rng, progress)
    pairs = propose_revisits(thumbnails(drive), trajectory.poses, height, settings.revisits)
    found = [
        match_places(scans, trajectory.poses, pair, height, camera.wheelbase_cm, settings.revisits, rng)
        for pair in pairs
    ]
    revisits = [revisit for revisit in found if revisit is not None]
    if len(revisits) < settings.revisits.min_revisits:
        revisits = []
    poses, residuals = close_loops(trajectory.poses, revisits, height)
    drift = heading_error_per_lap(trajectory.poses, revisits) if revisits else None
    return SolvedSegment(scans, trajectory, poses, steering, revisits, residuals, drift)


def refine_yaw(
    drive: Drive, camera: Camera, settings: MapSettings, rng: np.random.Generator, progress: Progress | None
) -> Camera:
    """Turn the camera until laps close in heading; without a revisit it stays as it is."""
    # A camera whose yaw is off by a few degrees drifts by a good part of the lap.
    wide = {"max_drift_share": 0.6, "max_turn_drift_rad": 2.5}
    settings = settings.model_copy(update={"revisits": settings.revisits.model_copy(update=wide)})
    tried: list[tuple[float, float]] = []
    best = camera
    for _ in range(_YAW_ROUNDS):
        solved = solve_segment(drive, camera, settings, rng, progress)
        if solved.heading_drift_rad is None:
            return camera
        tried.append((camera.mounting.yaw_rad, solved.heading_drift_rad))
        if abs(solved.heading_drift_rad) <= min(abs(error) for _, error in tried):
            best = camera
        if abs(solved.heading_drift_rad) < _YAW_GOOD_ENOUGH_RAD:
            break
        camera = camera.with_mounting(yaw_rad=next_yaw(tried))
    return best


def count_laps(path_cm: Float[np.ndarray, "n"], revisits: list[Revisit]) -> Int[np.ndarray, "n"]:
    """Number the laps from 0; a lap is as long as the path between one visit of a place and the next."""
    if not revisits:
        return np.zeros(len(path_cm), dtype=np.int64)
    gaps = np.sort([path_cm[r.later] - path_cm[r.earlier] for r in revisits])
    # Later visits may skip laps: the shortest gaps are those of one lap.
    lap_cm = float(np.median(gaps[gaps < 1.4 * np.percentile(gaps, 10)]))
    return (path_cm // lap_cm).astype(np.int64)
