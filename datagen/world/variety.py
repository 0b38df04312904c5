"""Drives of many cars on many roads: cameras near a given one, roads of all kinds, other speeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from datagen.world.car.camera import CameraSettings, sees_lane
from datagen.world.car.car import CarSettings
from datagen.world.car.driver import DriverSettings, shortest_excursion_spacing_cm, shortest_lane_change_cm
from datagen.world.road.track_settings import TrackSettings, preset
from datagen.world.world import START_CM, SimulationSettings, World, build_world
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera

#: Draws of camera and road until the camera sees the lane.
_SIGHT_TRIES = 20
#: Largest lateral acceleration in the tightest bend: 60 % of the simulated grip.
_BEND_CM_S2 = 300.0
#: Share of the drives on roads drawn from scratch; the others are on presets.
_DRAWN_SHARE = 0.5
#: Presets of roads that home-made cars are driven on.
_PRESETS = ("donkey_tape", "mat", "garage", "duckietown", "bfmc", "carolo_cup", "paper")
#: Kinds of line between two lanes that are crossed.
_CROSSED = ("dashed", "random")
#: Earliest change of lanes after the start.
_FIRST_CHANGE_CM = 30.0
#: Length of a road with kinks: further than the fastest driver gets in 100 frames.
_KINKED_CM = 1500.0
#: Seeds that are tried for a road.
_TRIES = 8


def camera_like(camera: Camera) -> CameraSettings:
    """Return the settings of a camera with the lens, the image size and the mounting of another.

    The principal point goes to the middle of the image; a pinhole's fifth coefficient is left out.
    """
    centre = np.array([[camera.K[0, 2] + 0.5 * camera.width, camera.K[1, 2]]])
    ray = camera.unproject(centre)[0]
    seen = np.isfinite(ray).all()
    half_rad = math.atan2(math.hypot(ray[0], ray[1]), ray[2]) if seen else camera.max_angle_rad
    k1, k2, k3, k4 = (*map(float, camera.D[:4]), 0.0, 0.0, 0.0, 0.0)[:4]
    return CameraSettings(
        model=camera.model,
        width=camera.width,
        height=camera.height,
        field_of_view_rad=2.0 * half_rad,
        distortion=(k1, k2, k3, k4),
        **asdict(camera.mounting),
    )


def vary_camera(camera: CameraSettings, rng: np.random.Generator) -> CameraSettings:
    """Draw a camera near another, as between two cars built from the same parts.

    Field of view within a tenth, pitch within 4 degrees, roll and yaw within 1.5, height 11 to 25 cm.
    """
    wider, pitch, roll, yaw = rng.uniform(-1.0, 1.0, 4)
    height_cm = float(np.exp(rng.uniform(np.log(11.0), np.log(25.0))))
    return camera.model_copy(
        update={
            "field_of_view_rad": camera.field_of_view_rad * (1.0 + 0.1 * wider),
            "pitch_down_rad": camera.pitch_down_rad + math.radians(4.0) * pitch,
            "roll_rad": camera.roll_rad + math.radians(1.5) * roll,
            "yaw_rad": camera.yaw_rad + math.radians(1.5) * yaw,
            "height_cm": height_cm,
        }
    )


def vary_car(car: CarSettings, rng: np.random.Generator) -> CarSettings:
    """Draw a car's size: a wheelbase of 15 to 27 cm, wheels that turn by 27 to 35 degrees."""
    wheelbase, turn = rng.random(2)
    return car.model_copy(
        update={
            "wheelbase_cm": float(15.0 * 1.8**wheelbase),
            "max_steering_rad": math.radians(27.0 + 8.0 * turn),
        }
    )


def tightest_bend_cm(car: CarSettings) -> float:
    """Return the smallest radius that the middle of the front axle can follow, with a reserve of a tenth."""
    most_rad = car.max_steering_rad * min(1.0, car.steering_gain) - abs(car.steering_trim_rad)
    return 1.1 * car.wheelbase_cm / math.sin(most_rad)


def vary_road(rng: np.random.Generator, tightest_cm: float = 60.0) -> TrackSettings:
    """Draw a kind of road: one of the presets, or tape laid out on a floor.

    Lanes of tape are 30 to 69 cm wide, their lines 1.5 to 5.1 cm, dashes 8 to 30 cm with gaps of 5 to 30 cm.
    The tightest bends have radii of 0.9 to 1.3 lane widths; on one road of four, 30 to 80 % of the pieces are
    corners. Every other road has two lanes. On one of eight the line on the right is dashed too, and on every
    other one up to a sixth of the tape has come off in short sections. See also :func:`_as_laid_at_home`.

    Args:
        rng: Source of randomness.
        tightest_cm: Smallest radius that the car can follow; presets keep their own.
    """
    drawn, number = rng.random(), int(rng.integers(len(_PRESETS)))
    two_lanes, width, tape, gaps, dash, gap, right, worn, tight, cornered, corners = rng.random(11)
    # Drawn for presets too, so that one kind of road does not change the next draw.
    laid_rng = rng.spawn(1)[0]
    if drawn >= _DRAWN_SHARE:
        return preset(_PRESETS[number])
    lane_cm = float(30.0 * 2.3**width)
    dashes = {
        "dash_cm": 8.0 + 22.0 * dash,
        "gap_cm": 5.0 + 25.0 * gap,
        "wear": max(0.0, 0.32 * worn - 0.16),
    }
    road = {
        "lane_width_cm": lane_cm,
        "line_width_cm": float(1.5 * 3.4**tape),
        "min_radius_cm": max(tightest_cm, (0.9 + 0.4 * tight) * lane_cm),
        "corners": 0.3 + 0.5 * corners if cornered < 0.25 else 0.0,
        "interruptions_per_m": 0.2 * gaps,
        "right": {"kind": "dashed" if right < 0.125 else "solid", **dashes},
    }
    left = {"kind": "random", "colour": "random", **dashes}
    road |= {"lanes": 2, "middle": left} if two_lanes < 0.5 else {"left": left}
    return TrackSettings.model_validate(road | _as_laid_at_home(road, laid_rng))


def _as_laid_at_home(road: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Draw what home-made roads have and plain ones lack; returns the keys that change.

    One road of three with one lane is laid in straight sections with kinks, one of six widens in its
    bends. One road of eight has tape up to 8 cm wide, one of three has things painted on it, and on one of
    eight the tape is darker than the floor, or blue or red on a pale one.
    """
    kinked, widens, wide, width, furnished, dark, colour, floor = rng.random(8)
    changes: dict[str, Any] = {}
    if kinked < 1.0 / 3.0 and road.get("lanes") != 2:
        changes |= {"pieces": _kinked_pieces(road["lane_width_cm"], rng), "corners": 0.0}
    elif widens < 1.0 / 6.0 and road.get("lanes") != 2:
        changes["widening"] = float(rng.uniform(0.1, 0.4))
    if wide < 0.125:
        changes["line_width_cm"] = 5.0 + 3.0 * float(width)
    if furnished < 1.0 / 3.0:
        names = ("stop_line", "zebra", "arrow", "junction", "parking")
        rates = rng.uniform(0.0, 0.12, len(names))
        changes["random_furniture"] = {
            f"{name}_per_m": float(rate) for name, rate in zip(names, rates, strict=True)
        }
    if dark < 0.125:
        paint = {"colour": ("black", "black", "blue", "red")[int(4.0 * colour)]}
        pale = 150.0 + 70.0 * float(floor)
        changes["floor_bgr"] = tuple(pale + float(tint) for tint in rng.uniform(-12.0, 12.0, 3))
        for name in ("left", "middle", "right", "far"):
            if name in road or (name == "far" and road.get("lanes") == 2):
                changes[name] = {**road.get(name, {}), **paint}
    return changes


def _kinked_pieces(lane_cm: float, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Draw an open road of straights and kinks of 15 to 75 degrees, which never turns back on itself."""
    pieces: list[dict[str, dict[str, Any]]] = [{"straight": {"length_cm": 150.0}}]
    heading_deg = 0.0
    while sum(piece["straight"]["length_cm"] for piece in pieces if "straight" in piece) < _KINKED_CM:
        angle_deg = float(rng.uniform(15.0, 75.0))
        to_left = heading_deg < 0.0 if abs(heading_deg) > 40.0 else rng.random() < 0.5
        heading_deg += angle_deg if to_left else -angle_deg
        pieces.append({"kink": {"angle_deg": angle_deg, "direction": "left" if to_left else "right"}})
        pieces.append({"straight": {"length_cm": float(rng.uniform(1.5, 4.0)) * lane_cm}})
    return pieces


def vary_driver(simulation: SimulationSettings, rng: np.random.Generator) -> DriverSettings:
    """Draw who drives: 40 to 150 cm/s, off the middle by 8 to 30 % of the lane, every third one further.

    People who drive by hand keep to no line: for a while they have a wheel on a marking, or half of the car
    beside the lane, at most 0.9 lane widths off the middle. If there are, or may be, dashes between two
    lanes, every third driver also changes lanes, first at any place from 30 cm on where half of the change
    is still within the drive. The speed is limited by the tightest bend, and excursions and changes of lane
    by what the car can turn.

    Args:
        simulation: Road, car, and how long the drive is.
        rng: Source of randomness.
    """
    track, tightest_cm = simulation.track, tightest_bend_cm(simulation.car)
    lane_cm = track.lane_width_cm
    fastest_cm_s = min(150.0, math.sqrt(_BEND_CM_S2 * track.tightest_radius_cm))
    speed_cm_s = float(np.exp(rng.uniform(np.log(40.0), np.log(fastest_cm_s))))
    recovers, wander, recover, changes, change, first = rng.random(6)
    recover_cm = lane_cm * (0.2 + 0.4 * recover)
    driver = DriverSettings(
        style="recover" if recovers < 0.35 else "wander",
        speed_cm_s=speed_cm_s,
        wander_cm=lane_cm * (0.08 + 0.22 * wander),
        recover_cm=recover_cm,
        recover_every_cm=max(200.0, shortest_excursion_spacing_cm(recover_cm, tightest_cm)),
    )
    crossed = track.middle is not None and track.middle.kind in _CROSSED
    if not crossed or changes >= 1.0 / 3.0:
        return driver
    change_cm = max(150.0, 3.5 * lane_cm, shortest_lane_change_cm(lane_cm, tightest_cm))
    start_cm = 0.0 if track.closed else START_CM + simulation.car.wheelbase_cm
    distance_cm = simulation.frames / simulation.rate_hz * speed_cm_s
    latest_cm = max(_FIRST_CHANGE_CM, distance_cm - 0.5 * change_cm)
    update = {
        "lane_change_cm": change_cm,
        "change_lanes_every_cm": change_cm * (1.2 + 0.8 * change),
        "first_change_cm": start_cm + _FIRST_CHANGE_CM + first * (latest_cm - _FIRST_CHANGE_CM),
    }
    return driver.model_copy(update={"style": "wander", **update})


def vary_simulation(
    simulation: SimulationSettings,
    sequence: np.random.SeedSequence,
    number: int,
    *,
    cameras: Sequence[CameraSettings] = (),
    road: bool = True,
    driver: bool = True,
) -> SimulationSettings:
    """Draw one of many drives; its seed is the sequence's first number.

    Camera and road are drawn up to 20 times, until the camera sees the lane.

    Args:
        simulation: What all drives share.
        sequence: Seeds everything that is drawn.
        number: Of the drive; the cameras take turns.
        cameras: The drive's camera is drawn near one of these, and the car's size is drawn; none leaves the
            simulation's.
        road: Draw the kind of road.
        driver: Draw how the car is driven.
    """
    camera_rng, road_rng, driver_rng, car_rng = np.random.default_rng(sequence).spawn(4)
    car = vary_car(simulation.car, car_rng) if cameras else simulation.car
    camera, track = simulation.camera, simulation.track
    for _ in range(_SIGHT_TRIES):
        if cameras:
            camera = vary_camera(cameras[number % len(cameras)], camera_rng)
        if road:
            track = vary_road(road_rng, tightest_bend_cm(car))
        if sees_lane(camera, track, car.wheelbase_cm):
            break
    seed = int(sequence.generate_state(1)[0])
    drawn = simulation.model_copy(update={"seed": seed, "camera": camera, "track": track, "car": car})
    if not driver:
        return drawn
    style = vary_driver(drawn, driver_rng)
    if style.change_lanes_every_cm is not None and track.middle is not None:
        # Whoever changes lanes crosses dashes.
        middle = track.middle.model_copy(update={"kind": "dashed"})
        drawn = drawn.model_copy(update={"track": track.model_copy(update={"middle": middle})})
    return drawn.model_copy(update={"driver": style})


def first_world(simulation: SimulationSettings) -> World:
    """Build a drive's world; if no random road is found, that of one of the next seeds.

    Raises:
        ConfigError: If several seeds leave no road.
    """
    for _ in range(_TRIES - 1):
        try:
            return build_world(simulation)
        except ConfigError:
            simulation = simulation.model_copy(update={"seed": simulation.seed + 1})
    return build_world(simulation)
