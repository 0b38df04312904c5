"""Open-loop tracking: odometry from the images, then the particle filter about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float

from datagen.slam.commands import SteeringFit, fit_steering
from datagen.slam.filter.dp_slam import Trajectory, run_filter
from datagen.slam.filter.motion import MotionModel
from datagen.slam.odometry.motion_grid import far_turns
from datagen.slam.odometry.odometry import Evidence, Odometry
from datagen.slam.odometry.scans import Progress
from datagen.slam.settings import MotionSettings, SlamSettings
from datagen.slam.view import SegmentView
from lanenet.data.segments import equal_runs
from lanenet.geometry.poses import compose, moved_rigidly, relative_pose


def track(
    view: SegmentView, settings: SlamSettings, rng: np.random.Generator, progress: Progress | None = None
) -> tuple[Trajectory, SteeringFit | None]:
    """Estimate all poses of a segment without closing loops.

    The images alone give each frame's motion first, and from it gain, trim and delay of the steering. The
    steering then predicts what the images leave open, and the filter puts the steps together.

    Args:
        view: What the images of the segment show.
        settings: Settings of all stages.
        rng: Source of randomness.
        progress: Called with (done, total).

    Returns:
        The poses, and how the car answered to the steering; None where that does not explain the path.
    """
    camera, commands, n = view.camera, view.commands, len(view.scans)
    height = camera.mounting.height_cm
    compared = None if progress is None else lambda k, _: progress(k, 2 * n)
    far_rad = far_turns(view.drive, camera)
    evidence = Evidence(view.images, view.typical, compared, far_rad)
    odometry = evidence.motion()
    steering = fit_steering(odometry.poses, commands, height)
    if steering is not None and commands.turn is not None:
        odometry = evidence.motion(steering.curvature_per_cm(commands.turn))
    filtered = None if progress is None else lambda k: progress(n + k, 2 * n)
    return _filter_parts(view, odometry, settings, rng, filtered), steering


def _filter_parts(
    view: SegmentView,
    odometry: Odometry,
    settings: SlamSettings,
    rng: np.random.Generator,
    progress: Callable[[int], None] | None,
) -> Trajectory:
    """Filter each part by itself, in a map of its own, and put it where the odometry guesses it."""
    camera, commands, height = view.camera, view.commands, view.camera.mounting.height_cm
    guessed = odometry.poses
    found: list[Trajectory] = []
    for rows in equal_runs(commands.part):
        steps = Odometry(odometry.steps_cm[rows], odometry.turns_rad[rows])
        motion = motion_about(steps, settings.motion, height, commands.periods[rows])
        done = None if progress is None else lambda k, _, first=int(rows[0]): progress(first + k)
        scans = view.scans.only(rows)
        one = run_filter(scans, motion, settings.filter, height, camera.wheelbase_cm, rng, done)
        start = (
            guessed[0]
            if not found
            else compose(found[-1].poses[-1], relative_pose(guessed[rows[0] - 1], guessed[rows[0]]))
        )
        found.append(replace(one, poses=moved_rigidly(one.poses, one.poses[0], start)))
    return Trajectory(*(np.concatenate([getattr(t, x.name) for t in found]) for x in fields(Trajectory)))


def motion_about(
    odometry: Odometry,
    settings: MotionSettings,
    camera_height_cm: float,
    periods: Float[np.ndarray, "n"],
) -> MotionModel:
    """Motion model of a car that does nearly what the odometry says."""
    s, steps_cm = settings, odometry.steps_cm
    moving = steps_cm > 0.0
    return MotionModel(
        distance_cm=steps_cm,
        curvature_per_cm=np.where(moving, odometry.turns_rad / np.where(moving, steps_cm, 1.0), 0.0),
        factor_start=(1.0, s.factor_walk),
        factor_walk=s.factor_walk,
        factor_pull=s.factor_pull,
        distance_noise=s.distance_noise,
        offset_walk_per_cm=s.offset_walk_heights / camera_height_cm,
        offset_decay=s.offset_decay,
        curvature_noise_per_cm=s.curvature_noise_heights / camera_height_cm,
        max_curvature_per_cm=s.max_curvature_heights / camera_height_cm,
        wider=np.sqrt(periods),
    )
