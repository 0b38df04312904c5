"""Open-loop tracking: odometry from the images, then the particle filter about it."""

from __future__ import annotations

import numpy as np

from datagen.slam.commands import SteeringFit, fit_steering
from datagen.slam.filter.dp_slam import Trajectory, run_filter
from datagen.slam.filter.motion import MotionModel
from datagen.slam.odometry.motion_grid import far_turns
from datagen.slam.odometry.odometry import Evidence, Odometry
from datagen.slam.odometry.scans import Progress
from datagen.slam.settings import MotionSettings, SlamSettings
from datagen.slam.view import SegmentView


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
    motion = motion_about(odometry, settings.motion, height)
    filtered = None if progress is None else lambda k, _: progress(n + k, 2 * n)
    trajectory = run_filter(view.scans, motion, settings.filter, height, camera.wheelbase_cm, rng, filtered)
    return trajectory, steering


def motion_about(odometry: Odometry, settings: MotionSettings, camera_height_cm: float) -> MotionModel:
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
    )
