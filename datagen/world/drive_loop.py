"""Driving: poses, commands and truth, frame by frame; whoever steers needs images, or does not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.world.world import World


@dataclass(frozen=True, eq=False)
class DriveState:
    """The car at the moment of a frame, and what it is told then.

    Attributes:
        frame: Number, from 0.
        t_s: Time since the start.
        pose: True rear-axle centre x, y and heading (unwrapped), frame map.
        true_speed_cm_s: True speed.
        yaw_rate_rad_s: True rate of turn, positive left.
        points_cm: True six points of the label contract, frame car.
        speed_cm_s: Commanded speed from this frame to the next.
        steering_rad: Commanded steering, positive left.
    """

    frame: int
    t_s: float
    pose: Float[np.ndarray, "3"]
    true_speed_cm_s: float
    yaw_rate_rad_s: float
    points_cm: Float[np.ndarray, "6"]
    speed_cm_s: float
    steering_rad: float


def scripted_states(world: World) -> Iterator[DriveState]:
    """Let the driver drive through a world that has just been built; it can be driven through once."""
    for frame in range(world.settings.frames):
        t_s = frame / world.settings.rate_hz
        pose, moving = world.car.pose, (world.car.speed_cm_s, world.car.yaw_rate_rad_s)
        speed_cm_s, steering_rad = obeyed(world, *world.driver.command(pose, t_s))
        points_cm = world.track.truth(
            pose, world.settings.car.wheelbase_cm, world.driver.s_cm, world.driver.lane_cm(pose)
        )
        yield DriveState(frame, t_s, pose, *moving, points_cm, speed_cm_s, steering_rad)
        world.car.step(speed_cm_s, steering_rad, 1.0 / world.settings.rate_hz)


def obeyed(world: World, speed_cm_s: float, steering_rad: float) -> tuple[float, float]:
    """What arrives at the car of a command: with throttle and angle, no more than they can say."""
    donkey = world.donkey
    if donkey is None:
        return speed_cm_s, steering_rad
    return (
        donkey.speed_cm_s(donkey.throttle(speed_cm_s)),
        donkey.steering_rad(donkey.angle(steering_rad)),
    )


def recorded_commands(world: World, speed_cm_s: float, steering_rad: float) -> dict[str, float]:
    """Return the columns of a recording for a command: what was told, never what the car did."""
    if world.donkey is None:
        return {"speed_cm_s": speed_cm_s, "steering_rad": steering_rad}
    return {"throttle": world.donkey.throttle(speed_cm_s), "angle": world.donkey.angle(steering_rad)}
