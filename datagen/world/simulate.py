"""Synthetic drives: a car driven along a random road, frame by frame, with exact truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from datagen.world.car import Car, CarSettings
from datagen.world.driver import Driver, DriverSettings
from datagen.world.look import LookSettings, random_look
from datagen.world.renderer import Renderer
from datagen.world.rig import CameraSettings
from datagen.world.track import Track, TrackSettings, random_track
from datagen.world.track_file import write_track
from lanenet.config import Settings, dump_settings
from lanenet.data.drive_writer import DriveWriter
from lanenet.data.files import write_text
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES

_START_CM = 40.0  # rear axle at the start of an open road
_SIGHT_CM = 250.0  # road beyond the front axle at the end of the drive
_LOOP_CM = 1200.0
_FILE_JPEG_QUALITY = 92  # of images on disk, when the camera itself does not compress


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


def simulate_drive(
    settings: SimulationSettings, out: Path, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Drive, and write a drive folder.

    Beside the recording (images, ``frames.csv`` with the commands only, ``drive.yaml``, ``camera.yaml``) the
    folder holds what no real drive has: ``truth.csv`` (pose and six points of each frame), ``track.json``
    (the road) and ``simulation.yaml`` (the resolved settings, which give the same drive again).

    Args:
        settings: The drive; the same settings give the same bytes.
        out: Folder to write; it appears when all is done.
        progress: Called after each frame with the number done and the number in all.

    Returns:
        The folder.

    Raises:
        ConfigError: See :func:`build_world`.
        LanenetError: If the folder exists and is not a drive, or cannot be written.
    """
    # The file is the camera's own JPEG: compressing twice would change the look.
    world = build_world(settings, compress=False)
    quality = world.settings.look.jpeg_quality or _FILE_JPEG_QUALITY
    writer = DriveWriter(
        out,
        camera=world.camera,
        lane_width_cm=world.track.lane_width_cm,
        notes=f"simulated, seed {settings.seed}",
        jpeg_quality=quality,
        camera_method="simulation",
    )
    with writer:
        for done, frame in enumerate(frames_of(world), start=1):
            pose = dict(zip(("x_cm", "y_cm", "heading_rad"), map(float, frame.pose), strict=True))
            points = dict(zip(POINT_NAMES, map(float, frame.points_cm), strict=True))
            writer.add(
                frame.image_bgr,
                frame.t_s,
                truth={**pose, **points},
                speed_cm_s=frame.speed_cm_s,
                steering_rad=frame.steering_rad,
            )
            if progress is not None:
                progress(done, settings.frames)
        write_track(writer.folder / "track.json", world.track)
        write_text(writer.folder / "simulation.yaml", dump_settings(world.settings))
    return out


def build_world(settings: SimulationSettings, compress: bool = True) -> World:
    """Draw road, look, driver and car.

    Args:
        settings: The drive.
        compress: Whether the renderer applies the camera's JPEG compression.

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
    look = settings.look if compress else settings.look.model_copy(update={"jpeg_quality": None})
    renderer = Renderer(camera, track, look, scene_rng)
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
