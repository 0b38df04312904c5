"""Synthetic drives: a car driven along a random road, frame by frame, with exact truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from datagen.world.car import Car, CarSettings
from datagen.world.driver import Driver, DriverSettings
from datagen.world.look import LookSettings, random_look
from datagen.world.renderer import Renderer
from datagen.world.rig import CameraSettings
from datagen.world.track import Track, TrackSettings, random_track
from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera

_START_CM = 40.0  # rear axle at the start of an open road
_SIGHT_CM = 250.0  # road beyond the front axle at the end of the drive
_LOOP_CM = 1200.0


class SimulationSettings(Settings):
    """One synthetic drive.

    Attributes:
        seed: Decides everything random: road, look, driver and car each draw from a child of their own.
        frames: Number of frames.
        rate_hz: Frames per second.
        camera: The camera.
        track: The road.
        car: The car and its errors.
        driver: How it is driven.
        look: What the drive looks like.
        random_look: Draw what ``look`` does not name.
    """

    seed: int = Field(default=0, ge=0)
    frames: int = Field(default=400, ge=1)
    rate_hz: float = Field(default=20.0, gt=0.0)
    camera: CameraSettings = CameraSettings()
    track: TrackSettings = TrackSettings()
    car: CarSettings = CarSettings()
    driver: DriverSettings = DriverSettings()
    look: LookSettings = LookSettings()
    random_look: bool = True


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One frame of a synthetic drive.

    Attributes:
        frame: Number, from 0.
        t_s: Time since the start.
        image_bgr: What the camera sees.
        speed_cm_s: Commanded speed from this frame to the next.
        steering_rad: Commanded steering, positive left.
        pose: True rear-axle centre x, y and heading (unwrapped), frame map.
        points_cm: True six points of the label contract, frame car.
    """

    frame: int
    t_s: float
    image_bgr: UInt8[np.ndarray, "h w 3"]
    speed_cm_s: float
    steering_rad: float
    pose: Float[np.ndarray, "3"]
    points_cm: Float[np.ndarray, "6"]


@dataclass(frozen=True, eq=False)
class World:
    """What a drive's settings stand for.

    Attributes:
        settings: The same settings with the road's length and the look resolved; they give the same drive.
        track: The road.
        camera: The camera on the car.
        renderer: Draws the frames.
        driver: At the start.
        car: At the start.
    """

    settings: SimulationSettings
    track: Track
    camera: Camera
    renderer: Renderer
    driver: Driver
    car: Car


def build_world(settings: SimulationSettings) -> World:
    """Draw road, look, driver and car.

    Raises:
        ConfigError: If the settings contradict each other, or the road is too short for the drive.
    """
    # The order is part of the format: a new part of the world takes a new child at the end.
    track_rng, look_rng, scene_rng, driver_rng, car_rng = np.random.default_rng(settings.seed).spawn(5)
    camera = settings.camera.build(settings.car.wheelbase_cm)
    settings = _resolve(settings, look_rng)
    track = random_track(settings.track, track_rng)
    driver = Driver(
        settings.driver,
        track,
        0.0 if track.closed else _START_CM,
        settings.car.max_steering_rad,
        driver_rng,
    )
    car = Car(settings.car, driver.start_pose(), car_rng)
    renderer = Renderer(camera, track, settings.look, scene_rng)
    return World(settings, track, camera, renderer, driver, car)


def drive_frames(settings: SimulationSettings) -> Iterator[SimulatedFrame]:
    """Drive, one frame at a time, in memory.

    Args:
        settings: The drive; the same settings give the same frames.

    Yields:
        Frames with commands and truth.

    Raises:
        ConfigError: See :func:`build_world`.
    """
    yield from frames_of(build_world(settings))


def frames_of(world: World) -> Iterator[SimulatedFrame]:
    """Drive through a world that has just been built; it can be driven through once."""
    settings, car, driver = world.settings, world.car, world.driver
    wheelbase_cm, interval_s = settings.car.wheelbase_cm, 1.0 / settings.rate_hz
    speed_cm_s = settings.driver.speed_cm_s
    for frame in range(settings.frames):
        pose = car.pose
        steering_rad = driver.steer(pose, wheelbase_cm)
        yield SimulatedFrame(
            frame=frame,
            t_s=frame * interval_s,
            image_bgr=world.renderer.render(pose, frame),
            speed_cm_s=speed_cm_s,
            steering_rad=steering_rad,
            pose=pose,
            points_cm=world.track.truth(pose, wheelbase_cm, driver.s_cm),
        )
        car.step(speed_cm_s, steering_rad, interval_s)


def _resolve(settings: SimulationSettings, look_rng: np.random.Generator) -> SimulationSettings:
    """Write out what the seed and the other settings decide: the look and the length of the road."""
    look = random_look(settings.look, look_rng) if settings.random_look else settings.look
    car = settings.car
    per_frame_cm = settings.driver.speed_cm_s / settings.rate_hz * car.speed_gain
    # The car may be faster than it should be for a while; a tenth covers that, and the wandering.
    way_cm = settings.frames * per_frame_cm * (1.1 + car.speed_noise)
    needed_cm = float(np.ceil(_START_CM + way_cm + car.wheelbase_cm + _SIGHT_CM))
    length_cm = settings.track.length_cm
    if length_cm is None:
        length_cm = _LOOP_CM if settings.track.closed else needed_cm
    elif length_cm < needed_cm and not settings.track.closed:
        raise ConfigError(
            f"track: length_cm {length_cm:g} is too short for {settings.frames} frames of "
            f"{per_frame_cm:.1f} cm, which need {needed_cm:g}; leave length_cm out to have it chosen"
        )
    track = settings.track.model_copy(update={"length_cm": length_cm})
    return settings.model_copy(update={"track": track, "look": look, "random_look": False})
