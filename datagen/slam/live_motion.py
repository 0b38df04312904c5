"""How a car may move to its next frame when only its past is known."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from datagen.slam.mapper import CommandedMotion
from datagen.slam.motion import MotionModel

#: Change per frame of the factor on the commands: of a recorded speed, which it nearly is, and, in camera
#: heights, of the usual way where only a throttle is known. A wider walk, or a weaker pull back to what is
#: usual, lets the filter creep: its blurred map likes slow motion.
_KNOWN_WALK, _UNKNOWN_WALK_HEIGHTS, _PULL = 0.005, 0.006, 0.1
_DISTANCE_NOISE = 0.02
#: In camera heights: noise of the curvature, and its bound, so that the heading cannot spin.
_CURVATURE_NOISE_HEIGHTS, _MAX_CURVATURE_HEIGHTS = 0.01, 0.8
#: Walk of the curvature's offset, in camera heights, and share of it that is forgotten per frame: with a
#: prediction from the steering there is little left for it.
_OFFSET_WALK_HEIGHTS, _PREDICTED_OFFSET_WALK_HEIGHTS, _PREDICTED_OFFSET_DECAY = 0.012, 0.004, 0.02


def live_motion(
    commands: CommandedMotion,
    curvature_per_cm: Float[np.ndarray, "n"] | None,
    factor: float,
    height_cm: float,
) -> MotionModel:
    """Return how a car may move that nobody has seen arrive yet.

    Args:
        commands: What was commanded.
        curvature_per_cm: Curvature that the steering predicts; None where it predicts nothing.
        factor: Usual way per unit of the commands, see :class:`datagen.slam.odometry.UsualWay`.
        height_cm: Of the camera.
    """
    predicted = curvature_per_cm is not None
    walk = _PREDICTED_OFFSET_WALK_HEIGHTS if predicted else _OFFSET_WALK_HEIGHTS
    return MotionModel(
        distance_cm=commands.distance_cm,
        curvature_per_cm=np.zeros(len(commands.distance_cm))
        if curvature_per_cm is None
        else curvature_per_cm,
        factor_start=(factor, 0.05 * factor),
        factor_walk=_KNOWN_WALK if commands.speed_known else _UNKNOWN_WALK_HEIGHTS * height_cm,
        factor_pull=_PULL,
        distance_noise=_DISTANCE_NOISE,
        offset_walk_per_cm=walk / height_cm,
        offset_decay=_PREDICTED_OFFSET_DECAY if predicted else 0.0,
        curvature_noise_per_cm=(1.0 if predicted else 2.0) * _CURVATURE_NOISE_HEIGHTS / height_cm,
        max_curvature_per_cm=_MAX_CURVATURE_HEIGHTS / height_cm,
    )
