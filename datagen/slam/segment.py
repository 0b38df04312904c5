"""One segment of a drive, from images to adjusted poses: observe, track, close loops, adjust.

A slow car is tracked by keyframes; the frames between them are placed and adjusted afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.slam.adjustment.adjust import BundleEstimate, BundleResult, adjust
from datagen.slam.commands import CommandedMotion, SteeringFit, commands_of, fit_steering
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.keyframes import (
    choose_keyframes,
    commands_between,
    keyframe_pairs,
    poses_between,
    values_between,
)
from datagen.slam.loops.consistency import consistent_revisits, with_supported, without_contradicted
from datagen.slam.loops.pose_graph import close_loops, inlier_revisits, loop_pairs, neighbouring_laps
from datagen.slam.loops.revisits import Revisit, match_places, propose_revisits, thumbnails
from datagen.slam.odometry.scans import Progress, Scans
from datagen.slam.settings import SlamSettings
from datagen.slam.track import track
from datagen.slam.view import RoadView, SegmentView, view_road, view_segment
from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import path_lengths

#: Camera parameters that are observable without a loop closure. The focal length is not: before the loop was
#: closed it diverged on two of three real drives.
_OPEN_LOOP = ("pitch", "roll", "yaw", "lever")
#: Median residuals of revisits after closure along and across the road, in camera heights, and misfit of the
#: frames relative to before, at most. True closures leave 0.08 and 0.03 heights on the real drives; places
#: that only look alike, as on an open road, leave more.
MAX_MISSED, MAX_MISFIT = (0.6, 0.3), 1.1
#: The camera is adjusted until its focal length moves by less than this share, or so often. Chosen: a tenth
#: of the uncertainty of the focal length on a good drive (2 to 3 %).
_SETTLED, _MAX_CAMERA_ROUNDS = 0.003, 6
#: Gaps between two visits up to so many times the shortest tenth of them are those of one lap.
_ONE_LAP = 1.4


@dataclass(frozen=True)
class SolvedSegment:
    """A tracked, closed and adjusted segment, in the scale of its camera.

    Attributes:
        rows: Its frames, as positions in the drive.
        camera: The camera, adjusted where it was not known.
        scans: Edge points per frame, with the camera tilted as it was in each.
        trajectory: Open-loop trajectory of the particle filter; of a slow car that of the keyframes, with the
            other frames placed between.
        open_poses: Rear-axle poses, adjusted, before loops were closed.
        poses: The same after closing loops, frame map.
        steering: How curvature answers to the command, where it does.
        revisits: Loop closures.
        drift_rad_per_cm: Heading drift of the open loop per length; None without a revisit.
        bundle: The adjustment.
        breaks: Frames that do not follow the one before them; None for an uninterrupted segment.
        keys: Keyframes by which a slow car was tracked; None where every frame is one.
    """

    rows: Int[np.ndarray, "n"]
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
        """Length of the path up to each frame; what lies across a break does not count."""
        steps = np.diff(path_lengths(self.poses), prepend=0.0)
        return np.cumsum(np.where(self.break_flags, 0.0, steps))

    @property
    def laps(self) -> Int[np.ndarray, "n"]:
        """Lap of each frame, from 0."""
        return count_laps(self.path_cm, self.uninterrupted_revisits)

    @property
    def break_flags(self) -> Bool[np.ndarray, "n"]:
        """The breaks as one flag per frame in any case, a copy."""
        return np.zeros(len(self.poses), dtype=bool) if self.breaks is None else self.breaks.copy()

    @property
    def uninterrupted_revisits(self) -> list[Revisit]:
        """Revisits between whose visits the drive was recorded without a break."""
        part = np.cumsum(self.break_flags)
        return [r for r in self.revisits if part[r.earlier] == part[r.later]]


def count_laps(path_cm: Float[np.ndarray, "n"], revisits: list[Revisit]) -> Int[np.ndarray, "n"]:
    """Number the laps from 0; a lap is as long as the path between two visits of a place."""
    if not revisits:
        return np.zeros(len(path_cm), dtype=np.int64)
    gaps = np.sort([path_cm[r.later] - path_cm[r.earlier] for r in revisits])
    # Later visits may skip laps.
    lap_cm = float(np.median(gaps[gaps < _ONE_LAP * np.percentile(gaps, 10)]))
    return (path_cm // lap_cm).astype(np.int64)


@dataclass(frozen=True)
class SegmentSolver:
    """Solves segments: what all of them share.

    Attributes:
        settings: Settings of all stages.
        rng: Source of randomness; every solution draws from it.
        progress: Called with (done, total) while a segment is tracked.
    """

    settings: SlamSettings
    rng: np.random.Generator
    progress: Progress | None = None

    def solve(
        self,
        drive: Drive,
        camera: Camera,
        find_camera: bool = False,
        prior_camera: Camera | None = None,
        commands: CommandedMotion | None = None,
    ) -> SolvedSegment:
        """Track one segment, close its loops, and adjust all of it together.

        Args:
            drive: The segment.
            camera: Its camera, or a coarse guess of it.
            find_camera: Adjust the camera too.
            prior_camera: Centre of the camera's priors; None for ``camera``.
            commands: What was commanded; None for what the drive recorded.

        Raises:
            TrackingLostError: If the road shows too few edges.
        """
        if commands is None:
            commands = commands_of(drive, camera.wheelbase_cm)
        view = view_segment(drive, camera, commands, self.settings, self.rng)
        keys = choose_keyframes(view.steps_heights)
        if len(keys) == len(drive):
            return _DenseSegment(view, self, find_camera, prior_camera or camera).solve()
        # The keyframes show the step length better: if the car is still slow, they are thinned again.
        between = commands_between(commands, keys)
        solved = self.solve(drive.subset(keys), camera, find_camera, prior_camera, between)
        return self.place_between(solved, keys, view.steps_heights, drive, commands)

    def place_between(
        self,
        solved: SolvedSegment,
        keys: Int[np.ndarray, "k"],
        steps: Float[np.ndarray, "n"],
        drive: Drive,
        commands: CommandedMotion,
    ) -> SolvedSegment:
        """Place the frames between keyframes on the keyframes' map, and adjust all of them together.

        Args:
            solved: The keyframes' segment.
            keys: The keyframes.
            steps: Rough step length of every frame, in any unit.
            drive: All frames.
            commands: What was commanded in all frames.
        """
        camera, settings = solved.camera, self.settings
        height = camera.mounting.height_cm
        road = view_road(drive, camera, settings, keys)
        poses = poses_between(solved.poses, keys, steps)
        revisits = [
            replace(r, earlier=int(keys[r.earlier]), later=int(keys[r.later])) for r in solved.revisits
        ]
        pairs = keyframe_pairs(keys, settings.bundle.lags)
        if revisits:
            # Revisits that the keyframes' map contradicts would pull again.
            inliers = inlier_revisits(poses, revisits, height)
            pairs += loop_pairs(inliers, len(drive)) + neighbouring_laps(poses, height, settings.revisits)
        start = BundleEstimate(poses, values_between(solved.bundle.tilt, keys, steps), camera)
        bundle = adjust(road.observed(commands), start, settings.bundle, self.rng, (), pairs)
        opened, t = poses_between(solved.open_poses, keys, steps), solved.trajectory
        # The match of a keyframe stands for the frames before it.
        after = np.searchsorted(keys, np.arange(len(drive)))
        return replace(
            solved,
            rows=np.arange(len(drive)),
            scans=road.scans(camera, bundle.tilt),
            trajectory=Trajectory(
                poses_between(t.poses, keys, steps), t.factor[after], t.match[after], t.spread_cm[after]
            ),
            open_poses=opened if revisits else bundle.poses,
            poses=bundle.poses,
            steering=fit_steering(opened, commands, height),
            revisits=revisits,
            bundle=replace(bundle, sigma=solved.bundle.sigma),
            keys=keys,
        )


@dataclass(frozen=True)
class _Closure:
    """Loops that were closed with some revisits: the drift that these found, and the adjusted map."""

    revisits: list[Revisit]
    drift_rad_per_cm: float
    bundle: BundleResult


class _DenseSegment:
    """A segment that is tracked by all of its frames."""

    def __init__(
        self, view: SegmentView, solver: SegmentSolver, find_camera: bool, prior_camera: Camera
    ) -> None:
        self.view, self.solver = view, solver
        self.find_camera = find_camera
        self.adjust = partial(
            adjust, settings=solver.settings.bundle, rng=solver.rng, prior_camera=prior_camera
        )
        self.revisit_settings = solver.settings.revisits
        self.height = view.camera.mounting.height_cm
        self.free = _OPEN_LOOP if find_camera else ()
        self.observed = view.road.observed(view.commands)

    def solve(self) -> SolvedSegment:
        """Take the segment through all stages."""
        view, solver = self.view, self.solver
        trajectory, steering = track(view, solver.settings, solver.rng, solver.progress)
        start = BundleEstimate.level(trajectory.poses, view.camera)
        opened = self.adjust(self.observed, start, free=self.free)
        closure = self.choose_closure(opened, self.find_revisits(opened))
        road, bundle = view.road, opened
        if closure is not None and self.find_camera:
            road, bundle = self.adjust_with_camera(closure)
        elif closure is not None:
            closure = self.without_outliers(opened, closure)
            bundle = closure.bundle
        return SolvedSegment(
            rows=np.arange(len(view.drive)),
            camera=bundle.camera,
            scans=road.scans(bundle.camera, bundle.tilt),
            trajectory=trajectory,
            open_poses=opened.poses,
            poses=bundle.poses,
            steering=steering,
            revisits=[] if closure is None else closure.revisits,
            drift_rad_per_cm=None if closure is None else closure.drift_rad_per_cm,
            bundle=bundle,
        )

    def find_revisits(self, opened: BundleResult) -> list[Revisit]:
        """Propose pairs of frames that look alike, and align each with the map around the earlier one."""
        scans = self.view.road.scans(opened.camera, opened.tilt)
        s, rng = self.revisit_settings, self.solver.rng
        pairs = propose_revisits(thumbnails(self.view.drive), opened.poses, self.height, s)
        wheelbase_cm = self.view.camera.wheelbase_cm
        found = [match_places(scans, opened.poses, p, self.height, wheelbase_cm, s, rng) for p in pairs]
        return [revisit for revisit in found if revisit is not None]

    def choose_closure(self, opened: BundleResult, matched: list[Revisit]) -> _Closure | None:
        """Close the loops with each set of revisits that one drift explains; the lowest misfit wins."""
        best: _Closure | None = None
        s = self.revisit_settings
        for explained, drift in consistent_revisits(opened.poses, matched, s):
            supported = with_supported(opened.poses, explained, matched, self.height, s)
            # Neighbours may support more than the drift explains. Where these do not fit, the explained may.
            groups = [supported, explained] if len(supported) > len(explained) else [supported]
            for group in groups:
                left = without_contradicted(opened.poses, group, self.height)
                closure = self.try_closure(left if len(left) >= s.min_revisits else group, drift, opened)
                if closure is not None:
                    if best is None or closure.bundle.misfit < best.bundle.misfit:
                        best = closure
                    break
        return best

    def try_closure(self, revisits: list[Revisit], drift: float, opened: BundleResult) -> _Closure | None:
        """Close the loops with these revisits; None where they do not meet, or the frames agree less."""
        poses, missed = close_loops(opened.poses, revisits, self.height)
        along, across = np.median(np.abs(missed[:, :2]), axis=0) / self.height
        if not (along < MAX_MISSED[0] and across < MAX_MISSED[1]):
            return None
        loops = loop_pairs(revisits, len(poses))
        closed = self.adjust(self.observed, replace(opened, poses=poses), free=self.free, loops=loops)
        return _Closure(revisits, drift, closed) if closed.misfit < MAX_MISFIT * opened.misfit else None

    def without_outliers(self, opened: BundleResult, closure: _Closure) -> _Closure:
        """Close the loops again without the revisits that the adjusted map contradicts: they still pull."""
        inliers = inlier_revisits(closure.bundle.poses, closure.revisits, self.height)
        if self.revisit_settings.min_revisits <= len(inliers) < len(closure.revisits):
            return self.try_closure(inliers, closure.drift_rad_per_cm, opened) or closure
        return closure

    def adjust_with_camera(self, closure: _Closure) -> tuple[RoadView, BundleResult]:
        """Adjust all of the camera with the poses, in rounds: another camera sees other edges on the road."""
        drive, bundle = self.view.drive, closure.bundle
        for _ in range(_MAX_CAMERA_ROUNDS):
            road = view_road(drive, bundle.camera, self.solver.settings)
            before = bundle.camera.K[0, 0]
            inliers = inlier_revisits(bundle.poses, closure.revisits, self.height)
            loops = loop_pairs(inliers, len(drive))
            loops += neighbouring_laps(bundle.poses, self.height, self.revisit_settings)
            bundle = self.adjust(road.observed(self.view.commands), bundle, loops=loops)
            if abs(bundle.camera.K[0, 0] / before - 1.0) < _SETTLED:
                break
        return road, bundle
