"""Cameras derived from others: rescaled, turned towards the same place, or with one number changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lanenet.geometry.camera import Camera


def with_known_scale(camera: Camera, factor: float, wheelbase_cm: float) -> Camera:
    """Scale a camera of nominal height; the lever arm scales, the wheelbase is the car's own."""
    scaled = camera.scaled_lengths(factor)
    lever = scaled.wheelbase_cm + scaled.mounting.ahead_of_front_axle_cm
    kept = replace(scaled, wheelbase_cm=wheelbase_cm)
    return kept.with_mounting(ahead_of_front_axle_cm=lever - wheelbase_cm)


def looking_alike(camera: Camera, like: Camera) -> Camera:
    """Turn a camera so that its image centre shows the place that it shows with another camera.

    Pitch and yaw are found together with a principal point: with another one, some pixels stand for degrees.
    """
    m = like.mounting
    middle = np.array([[0.5 * (like.width - 1), 0.5 * (like.height - 1)]])
    x_cm, y_cm = like.intersect_ground(middle)[0] - [m.right_of_centre_cm, m.ahead_of_front_axle_cm]
    if not np.isfinite(x_cm):
        return camera.with_mounting(pitch_down_rad=m.pitch_down_rad, yaw_rad=m.yaw_rad)
    pitch = float(np.arctan2(m.height_cm, np.hypot(x_cm, y_cm)))
    return camera.with_mounting(pitch_down_rad=pitch, yaw_rad=float(np.arctan2(-x_cm, y_cm)))


def nudged(camera: Camera, name: str, by: float) -> Camera:
    """Return the camera with one of its adjustable numbers changed.

    Args:
        camera: The camera.
        name: One of :data:`datagen.slam.adjustment.adjust.CAMERA_NAMES`.
        by: Change in the adjustment's unit: [rad] for angles, camera heights for the lever, a logarithm for
            the focal length, [px] for the principal point.
    """
    m = camera.mounting
    if name == "pitch":
        return camera.with_mounting(pitch_down_rad=m.pitch_down_rad + by)
    if name == "roll":
        return camera.with_mounting(roll_rad=m.roll_rad + by)
    if name == "yaw":
        return camera.with_mounting(yaw_rad=m.yaw_rad + by)
    if name == "lever":
        return camera.with_mounting(ahead_of_front_axle_cm=m.ahead_of_front_axle_cm + by * m.height_cm)
    K, D = np.array(camera.K, dtype=np.float64), np.array(camera.D, dtype=np.float64)
    if name == "focal":
        K[:2, :2] *= np.exp(by)
    elif name == "k1":
        D[0] += by
    else:
        K[("cx", "cy").index(name), 2] += by
    return replace(camera, K=K, D=D)
