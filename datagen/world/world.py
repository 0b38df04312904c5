"""What one drive's settings stand for: road, appearance, camera, car and driver."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool
from pydantic import Field

from datagen.world.car.camera import CameraSettings
from datagen.world.car.car import Car, CarSettings, DonkeyCommands, DonkeySettings, draw_donkey
from datagen.world.car.driver import Driver, DriverSettings
from datagen.world.car.recording import Gaps, Levels, recorded_frames
from datagen.world.render.appearance import Appearance, random_appearance
from datagen.world.render.ground import NEAR_CM
from datagen.world.render.renderer import Renderer
from datagen.world.road.build import check_drivable, random_track
from datagen.world.road.track import Track
from datagen.world.road.track_settings import LOOP_CM, TrackSettings
from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera

#: Place of the rear axle along an open road at the start: all wheels are on it, and the label rows as well.
START_CM = 40.0
#: Road beyond the front axle at the end of the drive: as far as lines are drawn.
_SIGHT_CM = NEAR_CM
#: Full lock, at least, over what the tightest bend takes; chosen: some is left for corrections.
_STEERING_RESERVE = 1.2


class SimulationSettings(Settings):
    """One synthetic drive.

    Attributes:
        seed: Of everything random: road, appearance, driver and car each draw from their own child.
        frames: Number of frames that are driven.
        rate_hz: Frames per second.
        camera: The camera.
        track: The road.
        car: The car and its errors.
        driver: How it is driven.
        look: The appearance of the drive.
        random_look: Draw what ``look`` does not set.
        recording: ``commands`` records speed and steering; ``donkeycar`` throttle and angle only.
        gaps: Frames that are driven and not recorded: none, those between ``pulses`` of the throttle, or
            ``pauses``.
        angles: ``bang`` records the angles of a keyboard, -1, 0 and 1, instead of ``all``.
        donkey: What throttle and angle do; recorded in the resolved settings only.
    """

    seed: int = Field(default=0, ge=0)
    frames: int = Field(default=400, ge=1)
    rate_hz: float = Field(default=20.0, gt=0.0)
    camera: CameraSettings = CameraSettings()
    track: TrackSettings = TrackSettings()
    car: CarSettings = CarSettings()
    driver: DriverSettings = DriverSettings()
    look: Appearance = Appearance()
    random_look: bool = True
    recording: Literal["commands", "donkeycar"] = "commands"
    gaps: Gaps = "none"
    angles: Levels = "all"
    donkey: DonkeySettings = DonkeySettings()


@dataclass(frozen=True, eq=False)
class World:
    """A drive that can begin.

    Attributes:
        settings: The drive's settings with length and appearance resolved; they give the same drive.
        track: The road, in the direction in which it is driven.
        camera: The camera on the car.
        driver: At the start.
        car: At the start.
        build_renderer: Makes the renderer, once.
        donkey: Set when throttle and angle are recorded.
        recorded: Which frames are recorded; None for all.
    """

    settings: SimulationSettings
    track: Track
    camera: Camera
    driver: Driver
    car: Car
    build_renderer: Callable[[], Renderer]
    donkey: DonkeyCommands | None = None
    recorded: Bool[np.ndarray, "n"] | None = None

    @functools.cached_property
    def renderer(self) -> Renderer:
        """Draws the frames; built on first use, since poses alone do not need it."""
        return self.build_renderer()


def build_world(settings: SimulationSettings, compress: bool = True) -> World:
    """Draw road, appearance, driver and car.

    Args:
        settings: The drive.
        compress: Whether the renderer applies the camera's JPEG compression.

    Raises:
        ConfigError: If the settings contradict each other, or the road is too short for the drive.
    """
    return assemble_world(resolve_length(settings), compress)


def assemble_world(settings: SimulationSettings, compress: bool = True) -> World:
    """Build a world without checking that its road is long enough for the number of frames.

    Args:
        settings: The drive.
        compress: Whether the renderer applies the camera's JPEG compression.

    Raises:
        ConfigError: If the settings contradict each other.
    """
    # The order is part of the format: a new part of the world takes a new child at the end.
    children = np.random.default_rng(settings.seed).spawn(7)
    track_rng, look_rng, scene_rng, driver_rng, car_rng, donkey_rng, gap_rng = children
    track = _drawn_track(settings, track_rng)
    if settings.driver.change_lanes_every_cm is not None and track.oncoming_cm is None:
        raise ConfigError(
            "driver.change_lanes_every_cm: found a road with one lane, expected one with two (track.lanes: 2)"
        )
    if settings.angles == "bang" and settings.recording != "donkeycar":
        raise ConfigError("angles: found bang for a recording of commands, expected recording: donkeycar")
    look = settings.look
    if settings.track.floor_bgr is not None and "floor_bgr" not in look.model_fields_set:
        look = look.model_copy(update={"floor_bgr": settings.track.floor_bgr})
    if settings.random_look:
        look = random_appearance(look, look_rng, tuple(marking.colour_bgr for marking in track.markings))
    bend_rad = math.atan(settings.car.wheelbase_cm * float(np.max(np.abs(track.curvature_per_cm))))
    needed_rad = min(_STEERING_RESERVE * bend_rad, settings.car.max_steering_rad)
    donkey = draw_donkey(settings.donkey, donkey_rng, needed_rad)
    settings = settings.model_copy(update={"look": look, "random_look": False, "donkey": donkey})
    camera = settings.camera.build(settings.car.wheelbase_cm)
    start_cm = 0.0 if track.closed else START_CM
    driver = Driver(settings.driver, track, start_cm, settings.car, settings.rate_hz, driver_rng)
    car = Car(settings.car, driver.start_pose(), car_rng)
    car.place(car.pose, settings.driver.chosen_speed_cm_s(settings.rate_hz))
    if not compress:
        look = look.model_copy(update={"jpeg_quality": None})
    build_renderer = functools.partial(Renderer, camera, track, look, scene_rng)
    commands = DonkeyCommands(donkey) if settings.recording == "donkeycar" else None
    kept = None if settings.gaps == "none" else recorded_frames(settings.gaps, settings.frames, gap_rng)
    return World(settings, track, camera, driver, car, build_renderer, commands, kept)


def draw_track(settings: SimulationSettings) -> Track:
    """Draw the road alone, the same as in the world of these settings.

    Raises:
        ConfigError: If there is no such road.
    """
    return _drawn_track(settings, np.random.default_rng(settings.seed).spawn(1)[0])


def resolve_length(settings: SimulationSettings) -> SimulationSettings:
    """Return the settings with the length of the road set.

    Raises:
        ConfigError: If an open road is too short for the drive.
    """
    car, driver = settings.car, settings.driver
    per_frame_cm = driver.chosen_speed_cm_s(settings.rate_hz) / settings.rate_hz * car.speed_gain
    # A tenth more, for a car that is faster than commanded for a while, and for the wandering.
    distance_cm = settings.frames * per_frame_cm * (1.1 + car.speed_noise + driver.speed_variation)
    needed_cm = float(np.ceil(START_CM + distance_cm + car.wheelbase_cm + _SIGHT_CM))
    length_cm = settings.track.length_cm
    if length_cm is None:
        length_cm = LOOP_CM if settings.track.closed else needed_cm
    elif length_cm < needed_cm and not settings.track.closed:
        advice = "drive fewer frames" if settings.track.pieces else "leave length_cm out to have it chosen"
        raise ConfigError(
            f"{settings.track.origin}: length_cm {length_cm:g} is too short for {settings.frames} frames of "
            f"{per_frame_cm:.1f} cm, which need {needed_cm:g}; {advice}"
        )
    track = settings.track.model_copy(update={"length_cm": length_cm})
    return settings.model_copy(update={"track": track})


def _drawn_track(settings: SimulationSettings, rng: np.random.Generator) -> Track:
    track = random_track(settings.track, rng)
    car = settings.car
    car_text = (
        f"a car of wheelbase {car.wheelbase_cm:g} cm and {math.degrees(car.max_steering_rad):.0f} degrees"
    )
    min_radius_cm = car.wheelbase_cm / math.tan(car.max_steering_rad)
    backward = settings.driver.direction == "backward"
    if backward:  # on two lanes the other lane is driven, whose bends have other radii
        track = track.reversed()
    check_drivable(track, min_radius_cm, settings.track, car_text, backward)
    return track
