"""One uninterrupted stretch of a drive: tracked, its loops closed, adjusted, its laps counted.

A segment from pictures to closed poses; where the car crawls, by key frames, and the others put back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleEstimate, BundleResult, Observations, adjust
from datagen.slam.camera.coarse import mapping_range
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.keyframes import commands_between, key_frames, key_pairs, poses_between, values_between
from datagen.slam.loops.consistency import consistent_revisits, with_supported, without_contradicted
from datagen.slam.loops.pose_graph import close_loops, inlier_revisits, loop_pairs, neighbouring_laps
from datagen.slam.loops.revisits import Revisit, match_places, propose_revisits, thumbnails
from datagen.slam.odometry.far_view import far_turns
from datagen.slam.odometry.scans import Progress, Scans, scans_of
from datagen.slam.seen import SeenDrive, road_edges, see_drive
from datagen.slam.track import CommandedMotion, SteeringFit, commands_of, fit_steering, track
from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import path_lengths

#: What the open loop can tell of the camera; the focal length runs away before the loop is closed.
_OPEN_LOOP = ("pitch", "roll", "yaw", "lever")
#: What revisits may miss once closed (medians along and across the road, in camera heights), and how much
#: worse frames may agree than before: places that only look alike, as on an open road, miss more.
MAX_MISSED, MAX_MISFIT = (0.6, 0.3), 1.1
#: The camera is adjusted until its focal length moves by less than this share, or so often.
_SETTLED, _MAX_CAMERA_ROUNDS = 0.003, 6


@dataclass(frozen=True)
class SolvedSegment:
    """A tracked, closed and adjusted segment, in the scale of its camera.

    Attributes:
        camera: The camera, adjusted where it was not known.
        scans: Edge points per frame, with the camera as it nodded in each.
        trajectory: Open-loop trajectory of the particle filter; where the car crawls, that of key frames,
            with the others put between.
        open_poses: Rear-axle poses, adjusted, before loops were closed.
        poses: The same after closing loops, frame map.
        steering: How curvature answers to the command, where it does.
        revisits: Places seen twice.
        drift_rad_per_cm: Heading that the open loop missed per length; None without a revisit.
        bundle: The adjustment.
        breaks: Frames that do not follow the one before them; None for an uninterrupted segment.
        keys: Key frames by which a car that crawls was followed; None where every frame is one.
    """

    camera: Camera
    scans: Scans
    trajectory: Trajectory
    open_poses: Float[np.ndarray, "n 3"]
    poses: Float[np.ndarray, "n 3"]
    steering: SteeringFit | None
    revisits: list[Revisit]
    drift_rad_per_cm: float | None
    bundle: BundleResult
    breaks: Bool[np.ndarray, "n"] | None = None
    keys: Int[np.ndarray, "k"] | None = None

    @property
    def path_cm(self) -> Float[np.ndarray, "n"]:
        """Length of the path up to each frame; what lies between two stretches does not count."""
        steps = np.diff(path_lengths(self.poses), prepend=0.0)
        return np.cumsum(np.where(self.breaks_or_none(), 0.0, steps))

    @property
    def laps(self) -> Int[np.ndarray, "n"]:
        """Lap of each frame, from 0."""
        return count_laps(self.path_cm, self.uninterrupted_revisits())

    def breaks_or_none(self) -> Bool[np.ndarray, "n"]:
        """The breaks, one flag per frame in any case."""
        return np.zeros(len(self.poses), dtype=bool) if self.breaks is None else self.breaks.copy()

    def uninterrupted_revisits(self) -> list[Revisit]:
        """Revisits between whose visits the drive was recorded without a break."""
        stretch = np.cumsum(self.breaks_or_none())
        return [r for r in self.revisits if stretch[r.earlier] == stretch[r.later]]


def solve_frames(
    seen: SeenDrive,
    settings: MapSettings,
    rng: np.random.Generator,
    progress: Progress | None,
    find_camera: bool = False,
    believed: Camera | None = None,
) -> SolvedSegment:
    """Track one segment by all of its frames, close its loops, and adjust all of it together.

    Args:
        seen: The segment; a car that crawls is followed by key frames, see :mod:`datagen.slam.segment`.
        settings: Settings of all stages.
        rng: Source of randomness.
        progress: Called with (done, total).
        find_camera: Adjust the camera too.
        believed: What is believed of the camera, where that is not the camera to start with.
    """
    drive, camera, commands, road = seen.drive, seen.camera, seen.commands, seen.road
    believed = camera if believed is None else believed
    height = camera.mounting.height_cm
    limits = mapping_range(height, settings.perception.range)
    trajectory, steering = track(
        seen.pictures, seen.scans, commands, seen.usual, camera, settings.filter, settings.motion, rng,
        progress, far_turns(drive, camera),
    )  # fmt: skip
    free = _OPEN_LOOP if find_camera else ()
    observed = Observations(road.edges, road.keep, commands.relative_ways, commands.speed_known)
    start = BundleEstimate.level(trajectory.poses, camera)
    opened = adjust(observed, start, settings.bundle, rng, free, prior_camera=believed)
    scans = scans_of(road.edges, opened.camera, limits, opened.tilt)
    pairs = propose_revisits(thumbnails(drive), opened.poses, height, settings.revisits)
    found = [
        match_places(scans, opened.poses, pair, height, camera.wheelbase_cm, settings.revisits, rng)
        for pair in pairs
    ]
    matched = [revisit for revisit in found if revisit is not None]
    closure = _close(observed, opened, matched, settings, rng, free, believed)
    if closure is not None and not find_camera:
        # Pictures that outvote a revisit are still pulled by it.
        true = inlier_revisits(closure.bundle.poses, closure.revisits, height)
        if settings.revisits.min_revisits <= len(true) < len(closure.revisits):
            drift = closure.drift_rad_per_cm
            again = _closed_by(true, drift, observed, opened, settings, rng, free, believed)
            closure = again or closure
    bundle = opened if closure is None else closure.bundle
    if closure is not None and find_camera:
        for _ in range(_MAX_CAMERA_ROUNDS):
            # A camera that has changed sees other edges on the road.
            road = road_edges(drive, bundle.camera, limits, settings)
            observed = replace(observed, edges=road.edges, keep=road.keep)
            before = bundle.camera.K[0, 0]
            true = inlier_revisits(bundle.poses, closure.revisits, height)
            loops = loop_pairs(true, len(drive)) + neighbouring_laps(bundle.poses, height, settings.revisits)
            bundle = adjust(observed, bundle, settings.bundle, rng, loops=loops, prior_camera=believed)
            if abs(bundle.camera.K[0, 0] / before - 1.0) < _SETTLED:
                break
    if closure is not None:
        scans = scans_of(road.edges, bundle.camera, limits, bundle.tilt)
    return SolvedSegment(
        camera=bundle.camera,
        scans=scans,
        trajectory=trajectory,
        open_poses=opened.poses,
        poses=bundle.poses,
        steering=steering,
        revisits=[] if closure is None else closure.revisits,
        drift_rad_per_cm=None if closure is None else closure.drift_rad_per_cm,
        bundle=bundle,
    )


@dataclass(frozen=True)
class _Closure:
    """A way to close the loops: its revisits, the drift that it found, and the map."""

    revisits: list[Revisit]
    drift_rad_per_cm: float
    bundle: BundleResult


def _close(
    observed: Observations,
    opened: BundleResult,
    matched: list[Revisit],
    settings: MapSettings,
    rng: np.random.Generator,
    free: Sequence[str],
    believed: Camera,
) -> _Closure | None:
    """Close the loops in every way that explains the revisits; the map in which frames agree best wins."""
    best: _Closure | None = None
    height = opened.camera.mounting.height_cm
    for explained, drift in consistent_revisits(opened.poses, matched, settings.revisits):
        supported = with_supported(opened.poses, explained, matched, height, settings.revisits)
        # Those that a drift explains are enough where the others do not fit.
        for group in [supported, explained][: 1 + (len(supported) > len(explained))]:
            left = without_contradicted(opened.poses, group, height)
            revisits = left if len(left) >= settings.revisits.min_revisits else group
            closure = _closed_by(revisits, drift, observed, opened, settings, rng, free, believed)
            if closure is not None:
                if best is None or closure.bundle.misfit < best.bundle.misfit:
                    best = closure
                break
    return best


def _closed_by(
    revisits: list[Revisit],
    drift: float,
    observed: Observations,
    opened: BundleResult,
    settings: MapSettings,
    rng: np.random.Generator,
    free: Sequence[str],
    believed: Camera,
) -> _Closure | None:
    """Close the loops with these revisits; None where they do not meet, or frames agree less with them."""
    height = opened.camera.mounting.height_cm
    poses, missed = close_loops(opened.poses, revisits, height)
    along, across = np.median(np.abs(missed[:, :2]), axis=0) / height
    if not (along < MAX_MISSED[0] and across < MAX_MISSED[1]):
        return None
    loops = loop_pairs(revisits, len(poses))
    closed = adjust(observed, replace(opened, poses=poses), settings.bundle, rng, free, loops, believed)
    return _Closure(revisits, drift, closed) if closed.misfit < MAX_MISFIT * opened.misfit else None


def count_laps(path_cm: Float[np.ndarray, "n"], revisits: list[Revisit]) -> Int[np.ndarray, "n"]:
    """Number the laps from 0; a lap is as long as the path between one visit of a place and the next."""
    if not revisits:
        return np.zeros(len(path_cm), dtype=np.int64)
    gaps = np.sort([path_cm[r.later] - path_cm[r.earlier] for r in revisits])
    # Later visits may skip laps: the shortest gaps are those of one lap.
    lap_cm = float(np.median(gaps[gaps < 1.4 * np.percentile(gaps, 10)]))
    return (path_cm // lap_cm).astype(np.int64)


def solve_segment(
    drive: Drive,
    camera: Camera,
    settings: MapSettings,
    rng: np.random.Generator,
    progress: Progress | None,
    find_camera: bool = False,
    believed: Camera | None = None,
) -> SolvedSegment:
    """Track one segment, close its loops, and adjust all of it together.

    Args:
        drive: The segment.
        camera: Its camera, or a coarse guess of it.
        settings: Settings of all stages.
        rng: Source of randomness.
        progress: Called with (done, total).
        find_camera: Adjust the camera too.
        believed: What is believed of the camera, where that is not the camera to start with.

    Raises:
        TrackingLostError: If the road shows too few edges.
    """
    commands = commands_of(drive, camera.wheelbase_cm)
    return _solve(drive, camera, commands, settings, rng, progress, find_camera, believed)


def _solve(
    drive: Drive,
    camera: Camera,
    commands: CommandedMotion,
    settings: MapSettings,
    rng: np.random.Generator,
    progress: Progress | None,
    find_camera: bool,
    believed: Camera | None,
) -> SolvedSegment:
    seen = see_drive(drive, camera, commands, settings, rng)
    ways = seen.usual.step_heights * seen.usual.relative
    keys = key_frames(ways)
    if len(keys) == len(drive):
        return solve_frames(seen, settings, rng, progress, find_camera, believed)
    # Among the key frames the step shows better: if it is still a crawl, they are thinned again.
    solved = _solve(
        drive.subset(keys), camera, commands_between(commands, keys), settings, rng, progress, find_camera,
        believed,
    )  # fmt: skip
    return _with_frames_between(solved, keys, ways, drive, commands, settings, rng)


def _with_frames_between(
    solved: SolvedSegment,
    keys: Int[np.ndarray, "k"],
    ways: Float[np.ndarray, "n"],
    drive: Drive,
    commands: CommandedMotion,
    settings: MapSettings,
    rng: np.random.Generator,
) -> SolvedSegment:
    """Put the frames between key frames onto their map, and adjust all of them together.

    Args:
        solved: The key frames' segment.
        keys: The key frames.
        ways: Way of every frame, in camera heights, about.
        drive: All frames.
        commands: What was commanded in all frames.
        settings: Settings of all stages.
        rng: Source of randomness.
    """
    camera = solved.camera
    height = camera.mounting.height_cm
    limits = mapping_range(height, settings.perception.range)
    road = road_edges(drive, camera, limits, settings, keys)
    poses = poses_between(solved.poses, keys, ways)
    revisits = [replace(r, earlier=int(keys[r.earlier]), later=int(keys[r.later])) for r in solved.revisits]
    pairs = key_pairs(keys, settings.bundle.lags)
    if revisits:
        # Those that the key frames' map contradicts would pull again.
        true = inlier_revisits(poses, revisits, height)
        pairs += loop_pairs(true, len(drive)) + neighbouring_laps(poses, height, settings.revisits)
    observed = Observations(road.edges, road.keep, commands.relative_ways, commands.speed_known)
    start = BundleEstimate(poses, values_between(solved.bundle.tilt, keys, ways), camera)
    bundle = adjust(observed, start, settings.bundle, rng, (), pairs)
    opened, t = poses_between(solved.open_poses, keys, ways), solved.trajectory
    # How well a key frame matched goes for those before it.
    after = np.searchsorted(keys, np.arange(len(drive)))
    return replace(
        solved,
        scans=scans_of(road.edges, camera, limits, bundle.tilt),
        trajectory=Trajectory(
            poses_between(t.poses, keys, ways), t.factor[after], t.match[after], t.spread_cm[after]
        ),
        open_poses=opened if revisits else bundle.poses,
        poses=bundle.poses,
        steering=fit_steering(opened, commands, height),
        revisits=revisits,
        bundle=replace(bundle, sigma=solved.bundle.sigma),
        keys=keys,
    )
