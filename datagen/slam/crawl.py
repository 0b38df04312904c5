"""A segment from pictures to closed poses; where the car crawls, by key frames, and the others put back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from datagen.map_settings import MapSettings
from datagen.slam.bundle import adjust
from datagen.slam.calibrate import mapping_range
from datagen.slam.filter import Trajectory
from datagen.slam.key_frames import commands_between, key_frames, key_pairs, poses_between, values_between
from datagen.slam.loop_pairs import loop_pairs, side_by_side
from datagen.slam.mapper import CommandedMotion, commands_of, fit_steering
from datagen.slam.posegraph import borne_out
from datagen.slam.scans import Progress, scans_of
from datagen.slam.seen import road_edges, see_drive
from datagen.slam.segment import SolvedSegment, solve_frames
from lanenet.data.drive import Drive
from lanenet.geometry.camera import Camera


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
        true = borne_out(poses, revisits, height)
        pairs += loop_pairs(true, len(drive)) + side_by_side(poses, height, settings.revisits)
    bundle = adjust(
        road.edges, poses, camera, settings.bundle, rng, (), pairs,
        values_between(solved.bundle.tilt, keys, ways), expected=commands.relative_ways, keep=road.keep,
        recorded=commands.speed_known,
    )  # fmt: skip
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
