"""A car driven by what its pilot sees: draw, look, steer, drive on.

Driving: poses, commands and truth, frame by frame; whoever steers needs images, or does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.car.driver import place_on_track
from datagen.world.car.pilot import LostLane, Pilot, PilotSettings, Sight
from datagen.world.render.sensor import as_jpeg
from datagen.world.world import World
from lanenet.geometry.frames import map_from_car


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


@dataclass(frozen=True, eq=False)
class LoopFrame:
    """One frame of a closed-loop drive.

    Attributes:
        state: The car, and what it is told.
        image_bgr: As drawn; None when the pilot needs no image.
        answered: Whether the pilot had an answer.
        s_cm: Way of the front axle along the road, counted on over the laps.
        offset_cm: Of the front axle's middle from the lane's centre, left positive.
    """

    state: DriveState
    image_bgr: UInt8[np.ndarray, "h w 3"] | None
    answered: bool
    s_cm: float
    offset_cm: float


class ClosedLoop:
    """Drives a world that has just been built; every frame is one call of :meth:`next_frame`.

    Attributes:
        s_cm: Way of the front axle along the road, counted on over the laps.
    """

    def __init__(
        self,
        world: World,
        pilot: Pilot,
        settings: PilotSettings,
        speed_cm_s: float,
        jpeg_quality: int | None = None,
    ) -> None:
        """Set out.

        Args:
            world: Its own driver is not asked.
            pilot: Who steers.
            settings: What happens when the lane is lost.
            speed_cm_s: Commanded speed.
            jpeg_quality: Show the pilot each image as a JPEG of this quality; for a world whose renderer does
                not compress.
        """
        self._world, self._pilot, self._speed_cm_s = world, pilot, speed_cm_s
        self._lost = LostLane(settings, world.settings.rate_hz)
        self._jpeg_quality = jpeg_quality
        self._frame, self._told = 0, (0.0, 0.0)
        self._wheelbase_cm = world.settings.car.wheelbase_cm
        self.s_cm = world.driver.s_cm
        world.car.place(world.car.pose, speed_cm_s)

    def next_frame(self) -> LoopFrame:
        """Look and decide; then let the car drive on until the next frame."""
        world, car, frame = self._world, self._world.car, self._frame
        pose, moving = car.pose, (car.speed_cm_s, car.yaw_rate_rad_s)
        front_cm = map_from_car(np.zeros((1, 2)), pose, self._wheelbase_cm)[0]
        self.s_cm, offset_cm = place_on_track(world.track, front_cm, self.s_cm)
        image = None
        if self._pilot.needs_image:
            image = world.renderer.render(pose, frame, *moving)
        seen = image if image is None or self._jpeg_quality is None else as_jpeg(image, self._jpeg_quality)
        interval_s = 1.0 / world.settings.rate_hz
        t_s = frame * interval_s
        wished_rad = self._pilot.steer(Sight(seen, pose, self.s_cm, t_s, *self._told))
        speed_cm_s, steering_rad = obeyed(world, *self._lost.command(wished_rad, self._speed_cm_s))
        points_cm = world.track.truth(pose, self._wheelbase_cm, self.s_cm)
        self._told = (speed_cm_s, steering_rad)
        state = DriveState(frame, t_s, pose, *moving, points_cm, speed_cm_s, steering_rad)
        car.step(speed_cm_s, steering_rad, interval_s)
        self._frame += 1
        return LoopFrame(state, image, math.isfinite(wished_rad), self.s_cm, offset_cm)

    def put_back(self, ahead_cm: float = 0.0) -> None:
        """Lift the car to the middle of the lane; the pilot starts anew.

        Args:
            ahead_cm: How much further along the road than where it is now.
        """
        self.s_cm += ahead_cm
        self._world.car.place(self._world.driver.pose_at(self.s_cm), self._speed_cm_s)
        self._told = (0.0, 0.0)
        self._pilot.reset()
        self._lost.reset()
