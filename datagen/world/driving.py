"""A simulated car on its road, frame by frame: driven by its script, or by a pilot who sees the images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.car.driver import place_on_track
from datagen.world.car.pilot import LostLane, Pilot, PilotSettings, Sight
from datagen.world.render.renderer import Renderer
from datagen.world.render.sensor import as_jpeg
from datagen.world.world import World
from lanenet.geometry.frames import map_from_car


@dataclass(frozen=True, eq=False)
class DriveState:
    """The car at the moment of a frame, and its command.

    Attributes:
        frame: Number, from 0.
        t_s: Time since the start.
        pose: True rear-axle centre x, y and heading (unwrapped), frame map.
        true_speed_cm_s: True speed.
        yaw_rate_rad_s: True yaw rate, positive left.
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


def draw_state(renderer: Renderer, state: DriveState) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the frame of a drive at which the car is in this state."""
    return renderer.render(state.pose, state.frame, state.true_speed_cm_s, state.yaw_rate_rad_s)


def scripted_states(world: World) -> Iterator[DriveState]:
    """Let the driver drive through a world that has just been built; once only."""
    car, driver, rate_hz = world.car, world.driver, world.settings.rate_hz
    for frame in range(world.settings.frames):
        t_s = frame / rate_hz
        pose, motion = car.pose, (car.speed_cm_s, car.yaw_rate_rad_s)
        command = transmitted(world, *driver.command(pose, t_s))
        wheelbase_cm = world.settings.car.wheelbase_cm
        points_cm = world.track.truth(pose, wheelbase_cm, driver.s_cm, driver.lane_cm(pose))
        yield DriveState(frame, t_s, pose, *motion, points_cm, *command)
        car.step(*command, 1.0 / rate_hz)


def transmitted(world: World, speed_cm_s: float, steering_rad: float) -> tuple[float, float]:
    """Return what arrives at the car of a command: throttle and angle are limited to -1 to 1."""
    donkey = world.donkey
    if donkey is None:
        return speed_cm_s, steering_rad
    return (
        donkey.speed_cm_s(donkey.throttle(speed_cm_s)),
        donkey.steering_rad(donkey.angle(steering_rad)),
    )


@dataclass(frozen=True, eq=False)
class LoopFrame:
    """One frame of a closed-loop drive.

    Attributes:
        state: The car and its command.
        image_bgr: As drawn; None when the pilot needs no image.
        answered: Whether the pilot had an answer.
        s_cm: Distance of the front axle along the road, counted on over the laps.
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
        s_cm: Distance of the front axle along the road, counted on over the laps.
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
            world: Its own driver does not steer.
            pilot: Who steers.
            settings: What happens when the lane is lost.
            speed_cm_s: Commanded speed.
            jpeg_quality: Show the pilot each image as a JPEG of this quality; for a world whose renderer does
                not compress.
        """
        self._world, self._pilot, self._speed_cm_s = world, pilot, speed_cm_s
        self._lost = LostLane(settings, world.settings.rate_hz)
        self._jpeg_quality = jpeg_quality
        self._frame, self._command = 0, (0.0, 0.0)
        self.s_cm = world.driver.s_cm
        world.car.place(world.car.pose, speed_cm_s)

    def next_frame(self) -> LoopFrame:
        """Draw, let the pilot decide, and let the car drive on until the next frame."""
        world, car, frame = self._world, self._world.car, self._frame
        wheelbase_cm, interval_s = world.settings.car.wheelbase_cm, 1.0 / world.settings.rate_hz
        pose, motion, t_s = car.pose, (car.speed_cm_s, car.yaw_rate_rad_s), frame * interval_s
        front_cm = map_from_car(np.zeros((1, 2)), pose, wheelbase_cm)[0]
        self.s_cm, offset_cm = place_on_track(world.track, front_cm, self.s_cm)
        image = seen = None
        if self._pilot.needs_image:
            image = seen = world.renderer.render(pose, frame, *motion)
            if self._jpeg_quality is not None:
                seen = as_jpeg(image, self._jpeg_quality)
        wanted_rad = self._pilot.steer(Sight(seen, pose, self.s_cm, t_s, *self._command))
        self._command = transmitted(world, *self._lost.command(wanted_rad, self._speed_cm_s))
        points_cm = world.track.truth(pose, wheelbase_cm, self.s_cm)
        state = DriveState(frame, t_s, pose, *motion, points_cm, *self._command)
        car.step(*self._command, interval_s)
        self._frame += 1
        return LoopFrame(state, image, math.isfinite(wanted_rad), self.s_cm, offset_cm)

    def put_back(self, ahead_cm: float = 0.0) -> None:
        """Put the car back in the middle of the lane, ``ahead_cm`` further along; the pilot starts anew."""
        self.s_cm += ahead_cm
        self._world.car.place(self._world.driver.pose_at(self.s_cm), self._speed_cm_s)
        self._command = (0.0, 0.0)
        self._pilot.reset()
        self._lost.reset()
