"""Drives that are hard to map, kind by kind; each is a function of its kind, a seed and its number.

- ``roads``: corners that are all alike, parallel straights of one look, a figure of eight, throttle pulses,
  pauses, kinks, a lane that widens in bends, dark tape, wide tape, and all sorts together.
- ``tiles``: rings of quarter circles and straights, with clean images.
- ``office``: two corridors of one look, along which the car turns round or is carried.
- ``mats``: four lanes and five lines, one lane of which is driven.
- ``floors``: large images of floors of strong texture.
- ``shifted``: cameras whose image centre is far beside the middle.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from datagen.world.car.car import Car
from datagen.world.car.driver import Driver
from datagen.world.render.renderer import Renderer
from datagen.world.road.track import write_track
from datagen.world.simulate import (
    FILE_JPEG_QUALITY,
    DriveState,
    draw_state,
    recorded_command,
    scripted_states,
    simulate_drive,
    true_columns,
)
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import dump_settings
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.files import write_text
from lanenet.geometry.lane import ROWS_CM

TRAPS = ("corners", "straights", "eight", "pulses", "pauses", "kinks", "widening", "dark", "wide", "mixed")
SPEED_CM_S, RATE_HZ, LAPS = 70.0, 20.0, 2.1
#: Rings of tiles: for each side its tiles from corner to corner, and where it turns then.
RINGS = {
    "square": ("2L2L2L2L", "3L3L3L3L", "4L4L4L4L"),
    "rectangle": ("2L3L2L3L", "2L4L2L4L", "3L5L3L5L"),
    "ell": ("3L2L1R1L2L3L", "4L2L2R2L2L4L", "4L2L1R2L3L4L"),
    "tee": ("2L1R1L2L4L2L1R1L", "2L2R1L2L4L2L1R2L", "3L1R1L2L5L2L1R1L"),
    "round": ("1L1L1L1L", "1L2L1L2L", "1L3L1L3L"),
}
TILE_CM, TILE_LANE_CM = (55.0, 65.0), 23.0
TILE_LANES_CM, LENSES_DEG = (23.0, 26.5, 32.0), (110.0, 120.0, 130.0, 140.0, 150.0)

#: Look of a floor on which nothing but the lines tells one place from another.
BARE = dict.fromkeys(
    ("clutter_per_m", "objects_per_m", "prints_per_m", "glints_per_m", "specks_per_m", "shadows_per_m"), 0.0
)


@dataclass(frozen=True)
class Leg:
    """A part of a drive that is recorded by itself.

    Attributes:
        backward: Whether it goes against the order of the road's pieces.
        frames: Number of frames.
        skip_cm: Distance from the end of the leg before to its start, in its own direction.
        pause_s: Time from the last frame of the leg before to its first one.
    """

    backward: bool
    frames: int
    skip_cm: float = 0.0
    pause_s: float = 0.0


@dataclass(frozen=True)
class TrapDrive:
    """A drive and what the mapping is told about it.

    Attributes:
        settings: What is simulated.
        trap: Name of what is hard about it.
        known: Whether the camera is known.
        told: Whose width the mapping is given as that of the lane.
        legs: Parts of the recording; none: it is simulated in one.
    """

    settings: SimulationSettings
    trap: str
    known: bool
    told: Literal["lane", "two lanes"] = "lane"
    legs: tuple[Leg, ...] = ()

    @property
    def told_cm(self) -> float:
        """Lane width that the mapping is given."""
        return self.settings.track.lane_width_cm * (2.0 if self.told == "two lanes" else 1.0)

    def write(self, out: Path) -> None:
        """Simulate the drive."""
        if self.legs:
            write_legs(self.settings, self.legs, out)
        else:
            simulate_drive(self.settings, out)


def beyond_lines(true_cm: Float[np.ndarray, "n 6"]) -> Bool[np.ndarray, "n"]:
    """Frames whose front axle's middle lies beyond a line of their true lane.

    On a road of one lane, map and truth may then count another lane, and both are right.
    """
    return (true_cm[:, 0] > 0.0) | (true_cm[:, len(ROWS_CM)] < 0.0)


def write_legs(settings: SimulationSettings, legs: Sequence[Leg], out: Path) -> None:
    """Simulate the legs of a drive on one road, and write them as one drive, as ``simulate_drive`` does."""
    ways = []
    for direction in ("forward", "backward"):
        driver = settings.driver.model_copy(update={"direction": direction})
        ways.append(build_world(settings.model_copy(update={"driver": driver}), compress=False))
    renderer: Renderer = ways[0].renderer  # one for both ways, so that all lies where it lay
    notes = f"simulated, seed {settings.seed}, {len(legs)} legs"
    width_cm, camera = settings.track.lane_width_cm, ways[0].camera
    quality = ways[0].settings.look.jpeg_quality or FILE_JPEG_QUALITY
    with DriveWriter(out, camera, width_cm, notes, quality, camera_method="simulation") as writer:
        for world, state in leg_states(ways, legs):
            command = recorded_command(world, state)
            writer.add(draw_state(renderer, state), state.t_s, truth=true_columns(state), **command)
        write_track(writer.folder / "track.json", ways[0].track)
        write_text(writer.folder / "simulation.yaml", dump_settings(ways[0].settings))


def leg_states(ways: Sequence[World], legs: Sequence[Leg]) -> Iterator[tuple[World, DriveState]]:
    """Let the driver drive the legs, one after the other; a loop only.

    Args:
        ways: The world forward and backward.
        legs: What is driven.
    """
    settings, length_cm = ways[0].settings, ways[0].track.length_cm
    s_cm, frame, t_s = 0.0, 0, 0.0  # along the pieces
    for number, leg in enumerate(legs):
        rng = np.random.default_rng([settings.seed, number])
        way = ways[leg.backward]
        part = settings.model_copy(update={"frames": leg.frames})
        start_cm = (length_cm - s_cm if leg.backward else s_cm) + leg.skip_cm
        driver = Driver(settings.driver, way.track, start_cm, settings.car, settings.rate_hz, rng)
        car = Car(settings.car, driver.start_pose(), rng)
        car.place(car.pose, settings.driver.chosen_speed_cm_s(settings.rate_hz))
        world = replace(way, settings=part, driver=driver, car=car)
        t_s += leg.pause_s
        for state in scripted_states(world):
            yield world, replace(state, frame=frame + state.frame, t_s=t_s + state.t_s)
        frame, t_s = frame + leg.frames, t_s + (leg.frames - 1) / settings.rate_hz
        s_cm = length_cm - driver.s_cm if leg.backward else driver.s_cm


def loop(corners: int, straights_cm: list[float], radius_cm: float | None) -> dict[str, Any]:
    """Pieces of a loop of like corners, with these straights in turn; kinks if there is no radius."""
    angle_deg = 360.0 / corners
    corner: dict[str, Any] = {"kink": {"angle_deg": angle_deg, "direction": "left"}}
    if radius_cm is not None:
        corner = {"arc": {"radius_cm": radius_cm, "angle_deg": angle_deg, "direction": "left"}}
    pieces: list[dict[str, Any]] = []
    for k in range(corners):
        pieces += [{"straight": {"length_cm": straights_cm[k % len(straights_cm)]}}, corner]
    return {"pieces": pieces}


def eight(radius_cm: float) -> dict[str, Any]:
    """Pieces of a figure of eight that crosses itself at a right angle."""
    half: list[dict[str, Any]] = []
    for direction in ("left", "right"):
        half.append({"straight": {"length_cm": 2.0 * radius_cm}})
        half.append({"arc": {"radius_cm": radius_cm, "angle_deg": 270.0, "direction": direction}})
    return {"pieces": half, "crosses": True}


def road(trap: str, rng: np.random.Generator) -> dict[str, Any]:
    """A road of one lane with a trap."""
    lane_cm, radius_cm = float(rng.uniform(30.0, 50.0)), float(rng.uniform(55.0, 70.0))
    made: dict[str, Any] = {
        "lane_width_cm": lane_cm,
        "line_width_cm": float(rng.uniform(6.0, 9.0) if trap == "wide" else rng.uniform(1.8, 5.0)),
        "min_radius_cm": radius_cm,
        "closed": True,
        "length_cm": float(rng.uniform(750.0, 950.0)),
        "interruptions_per_m": 0.05,
    }
    dashed = {"kind": "dashed" if rng.random() < 0.3 else "solid", "dash_cm": 18.0, "gap_cm": 14.0}
    made |= {"left": dashed, "right": {"kind": "solid"}}
    straight_cm = float(rng.uniform(70.0, 130.0))
    number, long_cm = int(rng.integers(3, 6)), float(rng.uniform(220.0, 280.0))
    if trap in ("corners", "mixed"):
        made |= loop(number, [straight_cm], radius_cm)
    elif trap == "straights":
        made |= loop(4, [long_cm, 0.3 * straight_cm], radius_cm)
    elif trap == "eight":
        made |= eight(1.3 * radius_cm)
    elif trap == "kinks":
        # Kinks of 45, 60 and 90 degrees.
        made |= loop({3: 8, 4: 6, 5: 4}[number], [270.0 - 35.0 * (8 - number), straight_cm], None)
    elif trap == "widening":
        made |= loop(4, [straight_cm, 1.4 * straight_cm], radius_cm) | {
            "widening": float(rng.uniform(0.15, 0.4))
        }
        made["left"] = {"kind": "solid"}
    if "pieces" in made:
        del made["length_cm"]
    if trap == "dark" or (trap == "mixed" and number > 3):
        made["left"], made["right"] = made["left"] | {"colour": "black"}, {"kind": "solid", "colour": "black"}
        made["floor_bgr"] = tuple(float(rng.uniform(150.0, 210.0)) for _ in range(3))
    return made


def usual_camera(rng: np.random.Generator) -> dict[str, Any]:
    """A camera as those of a Donkeycar."""
    return {
        "width": 160, "height": 120,
        "field_of_view_rad": math.radians(float(rng.uniform(110.0, 150.0))),
        "height_cm": float(rng.uniform(14.0, 22.0)),
        "pitch_down_rad": math.radians(float(rng.uniform(13.0, 25.0))),
        "roll_rad": float(rng.normal(0.0, 0.012)), "yaw_rad": float(rng.normal(0.0, 0.02)),
        "distortion": (float(rng.uniform(-0.05, 0.01)), 0.0, 0.0, 0.0),
    }  # fmt: skip


def usual_car(rng: np.random.Generator) -> dict[str, Any]:
    """A car that does not quite steer as it is told."""
    return {
        "wheelbase_cm": float(rng.uniform(16.0, 22.0)),
        "steering_gain": float(rng.uniform(0.85, 1.1)),
        "steering_trim_rad": float(rng.uniform(-0.03, 0.03)),
        "max_steering_rad": 0.6,
    }


def drive_settings(number: int, seed: int) -> tuple[SimulationSettings, str, bool]:
    """Settings of one drive, its trap, and whether the camera is known."""
    rng = np.random.default_rng(seed + number)
    trap = TRAPS[number % len(TRAPS)]
    track = road(trap, rng)
    speed_cm_s = SPEED_CM_S * float(rng.uniform(0.8, 1.2))
    gain = float(rng.uniform(0.85, 1.1))
    gaps = {"pulses": "pulses", "pauses": "pauses", "mixed": ("pulses", "pauses")[number // 10 % 2]}.get(
        trap, "none"
    )
    laps = LAPS * (1.6 if gaps != "none" else 1.0)
    settings = {
        "seed": seed + number,
        "rate_hz": RATE_HZ,
        "camera": usual_camera(rng),
        "track": track,
        "car": usual_car(rng) | {"speed_gain": gain},
        "driver": {
            "speed_cm_s": speed_cm_s,
            "speed_variation": float(rng.uniform(0.0, 0.2)),
            "wander_cm": 0.12 * track["lane_width_cm"],
            "direction": "backward" if rng.random() < 0.5 else "forward",
        },
        "recording": "donkeycar" if gaps != "none" or number % 2 else "commands",
        "gaps": gaps,
        "angles": "bang" if gaps == "pulses" else "all",
    }  # fmt: skip
    return for_laps(settings, laps), trap, number // len(TRAPS) % 2 == 0


def for_laps(settings: dict[str, Any], laps: float) -> SimulationSettings:
    """Complete the settings of a drive by the frames that so many laps take."""
    draft = SimulationSettings.model_validate(settings)
    length_cm, speed_cm_s = draft.track.length_cm or 0.0, draft.driver.speed_cm_s or 0.0
    frames = int(laps * length_cm / (speed_cm_s * draft.car.speed_gain / draft.rate_hz))
    return draft.model_copy(update={"frames": frames})


def ring(sides: str, tile_cm: float, left_cm: float, right_cm: float) -> dict[str, Any]:
    """Pieces of a closed road on square tiles.

    Args:
        sides: One of ``RINGS``.
        tile_cm: Length of a straight.
        left_cm: Radius of the bends to the left.
        right_cm: Radius of those to the right.
    """
    pieces: list[dict[str, Any]] = []
    for tiles, turn in re.findall(r"(\d)([LR])", sides):
        pieces += [{"straight": {"length_cm": tile_cm}}] * (int(tiles) - 1)
        radius_cm, direction = (left_cm, "left") if turn == "L" else (right_cm, "right")
        pieces.append({"arc": {"radius_cm": radius_cm, "angle_deg": 90.0, "direction": direction}})
    return {"pieces": pieces, "closed": True}


def tiles(number: int, seed: int) -> TrapDrive:
    """Make a drive on tiles: 100 of them have each shape with each lens, both rates and numbers of laps."""
    rng = np.random.default_rng([seed, number])
    shape, lens_deg = list(RINGS)[number % 5], LENSES_DEG[(number + number // 20) % 5]
    lane_cm = TILE_LANES_CM[number // 4 % 3]
    scale = lane_cm / TILE_LANE_CM
    tile_cm = float(rng.uniform(*TILE_CM)) * scale
    radius_cm = tile_cm * (float(rng.uniform(0.8, 1.5)) if shape == "round" else 0.5)
    two = bool(rng.random() < 0.5)
    aside_cm = 0.5 * lane_cm if two else 0.0
    track = ring(str(rng.choice(RINGS[shape])), tile_cm, radius_cm + aside_cm, radius_cm - aside_cm)
    inner = {"kind": "dashed", "colour": "yellow", "dash_cm": 5.0 * scale, "gap_cm": 2.5 * scale}
    white = {"kind": "solid"}
    track |= {"lanes": 2, "middle": inner, "far": white} if two else {"left": inner}
    track |= {"right": white, "lane_width_cm": lane_cm, "line_width_cm": float(rng.uniform(2.0, 3.5)) * scale}
    wide = bool(rng.random() < 0.5)
    settings = {
        "seed": int(rng.integers(2**31)),
        "rate_hz": (10.0, 20.0)[number // 2 % 2],
        "camera": {
            "width": 320 if wide else 160, "height": 240 if wide else 120,
            "field_of_view_rad": math.radians(lens_deg),
            "height_cm": float(rng.uniform(9.0, 14.0)),
            "pitch_down_rad": math.radians(float(rng.uniform(13.0, 22.0))),
            "roll_rad": float(rng.normal(0.0, 0.01)), "yaw_rad": float(rng.normal(0.0, 0.01)),
        },
        "track": track | {"interruptions_per_m": 0.0},
        # Short, as such cars are: the bends to the right of two lanes have a radius of 16 to 30 cm.
        "car": {"wheelbase_cm": float(rng.uniform(7.0, 10.0)), "max_steering_rad": 0.9},
        "driver": {
            "speed_cm_s": float(rng.uniform(30.0, 42.0)), "wander_cm": 0.06 * lane_cm, "aim_ahead_cm": 10.0,
            "direction": "backward" if rng.random() < 0.5 else "forward",
        },
        "recording": "donkeycar" if rng.random() < 0.5 else "commands",
        # Without effects, as simulators draw.
        "random_look": False,
        "look": {"floor_bgr": (float(rng.uniform(40.0, 90.0)),) * 3},
    }  # fmt: skip
    return TrapDrive(for_laps(settings, (1.2, 2.0)[number % 2]), shape, False)


def roads(number: int, seed: int) -> TrapDrive:
    """Make one of the first sixty trap drives, or more of their kinds."""
    return TrapDrive(*drive_settings(number, seed))


def corridors(rng: np.random.Generator, bays: bool) -> dict[str, Any]:
    """Pieces of two parallel corridors and the passages between their ends; with bays of equal corners."""
    radius_cm, between_cm = float(rng.uniform(44.0, 52.0)), float(rng.uniform(200.0, 400.0))
    turns: list[tuple[float, str]] = [(float(rng.uniform(600.0, 900.0)), "left")]
    if bays:
        wall_cm, deep_cm, wide_cm = (2.0 * radius_cm + float(rng.uniform(5.0, most)) for most in (60, 30, 60))
        bay = [(deep_cm, "left"), (wide_cm, "left"), (deep_cm, "right")]
        turns = [(wall_cm, "right"), *bay, (wall_cm, "right"), *bay, (wall_cm, "left")]
    pieces: list[dict[str, Any]] = []
    for side_cm, direction in 2 * [*turns, (between_cm, "left")]:
        pieces.append({"straight": {"length_cm": side_cm - 2.0 * radius_cm}})
        pieces.append({"arc": {"radius_cm": radius_cm, "angle_deg": 90.0, "direction": direction}})
    return {"pieces": pieces, "closed": True, "min_radius_cm": radius_cm}


def office(number: int, seed: int) -> TrapDrive:
    """Make a drive along two corridors, three to five times, with turn-rounds; odd ones with bays."""
    rng = np.random.default_rng([seed, number])
    bays = number % 2 == 1
    dashed = {"kind": "dashed" if rng.random() < 0.3 else "solid", "dash_cm": 18.0, "gap_cm": 14.0}
    track = corridors(rng, bays) | {
        "lane_width_cm": float(rng.uniform(30.0, 45.0)), "line_width_cm": float(rng.uniform(1.8, 5.0)),
        "left": dashed, "right": {"kind": "solid"}, "interruptions_per_m": float(rng.choice([0.0, 0.1])),
    }  # fmt: skip
    settings = car_like_people(rng, track) | {"random_look": True, "look": BARE}
    settings["recording"] = "donkeycar" if rng.random() < 0.5 else "commands"
    lap = for_laps(settings, 1.0)
    legs, count = [], int(rng.integers(3, 6))
    whole = int(rng.integers(count))
    for k in range(count):
        # Half of a lap is one corridor with its passage; one leg goes round, so that the map can close.
        frames = int(lap.frames * (rng.uniform(1.1, 1.25) if k == whole else rng.uniform(0.4, 0.75)))
        # It turns round on the spot, or is carried.
        skip_cm = float(rng.uniform(-120.0, 120.0) if rng.random() < 0.4 else rng.uniform(0.0, 40.0))
        pause_s = float(rng.uniform(1.0, 6.0))
        legs.append(Leg(k % 2 == 1, frames, *((skip_cm, pause_s) if k else ())))
    trap = "bays" if bays else "corridors"
    return TrapDrive(lap, trap, number // 2 % 2 == 0, legs=tuple(legs))


def car_like_people(rng: np.random.Generator, track: dict[str, Any]) -> dict[str, Any]:
    """Settings of a drive as of ``roads``, without its recording."""
    return {
        "seed": int(rng.integers(2**31)),
        "rate_hz": RATE_HZ,
        "camera": usual_camera(rng),
        "track": track,
        "car": usual_car(rng) | {"speed_gain": float(rng.uniform(0.85, 1.1))},
        "driver": {
            "speed_cm_s": SPEED_CM_S * float(rng.uniform(0.8, 1.2)),
            "speed_variation": float(rng.uniform(0.0, 0.2)),
            "wander_cm": 0.12 * track["lane_width_cm"],
            "direction": "backward" if rng.random() < 0.5 else "forward",
        },
    }  # fmt: skip


def mats(number: int, seed: int) -> TrapDrive:
    """Make a drive on a mat of four lanes; half of them have pauses, half are told the width of two lanes."""
    rng = np.random.default_rng([seed, number])
    lane_cm = float(rng.uniform(19.0, 24.0))
    # From the right, in the direction of travel; it is mostly the second one.
    driven = int(rng.choice(4, p=(0.1, 0.7, 0.1, 0.1)))
    radius_cm = float(rng.uniform(3.2, 3.8)) * lane_cm  # of the middle of the mat
    border, dashes = {"kind": "solid"}, {"kind": "dashed", "dash_cm": 12.0, "gap_cm": 12.0}
    painted: list[dict[str, Any]] = [border, dashes, border | {"colour": "yellow"}, dashes, border]
    car = car_like_people(rng, {"lane_width_cm": lane_cm})
    along = driven if car["driver"]["direction"] == "forward" else 3 - driven
    aside_cm = (along - 1.5) * lane_cm
    beside = [line | {"at_lanes": k - along - 0.5} for k, line in enumerate(painted)]
    track = ring(
        str(rng.choice(RINGS["rectangle"][:2] + RINGS["ell"][:1])),
        2.0 * radius_cm, radius_cm - aside_cm, radius_cm + aside_cm
    ) | {
        "lane_width_cm": lane_cm, "line_width_cm": float(rng.uniform(1.8, 3.0)), "interruptions_per_m": 0.0,
        "right": painted[along], "left": painted[along + 1],
        "extra_lines": [*beside[:along], *beside[along + 2 :]],
    }  # fmt: skip
    gaps = ("none", "pauses")[number % 2]
    settings = car | {"track": track, "gaps": gaps, "recording": "donkeycar", "look": BARE}
    told: Literal["lane", "two lanes"] = "two lanes" if number // 2 % 2 else "lane"
    drive = for_laps(settings, LAPS * (1.6 if gaps == "pauses" else 1.0))
    return TrapDrive(drive, f"lane{driven + 1}", number // 4 % 2 == 0, told)


def floors(number: int, seed: int) -> TrapDrive:
    """Make a drive of 640 x 480 px over foam mats or carpet, with 34,000 and more edge points a frame."""
    rng = np.random.default_rng([seed, number])
    mat = number % 2 == 1
    gray = float(rng.uniform(70.0, 90.0))
    look = BARE | {
        # The pattern of asphalt stands for that of foam.
        "floor": "asphalt" if mat else "carpet", "texture_scale_cm": 0.3,
        "texture_level": float(rng.uniform(95.0, 115.0) if mat else rng.uniform(85.0, 100.0)),
        "joint_u_cm": 60.0 * mat, "joint_v_cm": 60.0 * mat, "joint_level": 40.0,
        "floor_bgr": (gray * 1.1, gray, gray * 0.9), "exposure": float(rng.uniform(1.0, 1.3)),
        "line_brightness": 1.0, "line_wear": 0.0, "lamp_level": 10.0, "vignetting": 0.2, "blur_px": 0.0,
        "noise_level": 1.5, "exposure_s": 0.003, "stain_level": 0.0, "crack_level": 0.0,
    }  # fmt: skip
    settings = car_like_people(rng, taped_road(rng)) | {"look": look}
    # The floor fills the lower half and more, and its grains are small from there.
    view_deg, pitch_deg = float(rng.uniform(125.0, 150.0)), float(rng.uniform(18.0, 25.0))
    settings["camera"] |= {
        "width": 640, "height": 480,
        "field_of_view_rad": math.radians(view_deg), "pitch_down_rad": math.radians(pitch_deg),
        "height_cm": float(rng.uniform(19.0, 22.0)),
    }  # fmt: skip
    return TrapDrive(for_laps(settings, LAPS), "mat" if mat else "carpet", number // 2 % 2 == 0)


def shifted(number: int, seed: int) -> TrapDrive:
    """Make a drive of 640 x 480 px whose image centre is 40 to 120 px beside the middle."""
    rng = np.random.default_rng([seed, number])
    model = ("fisheye", "pinhole")[number % 2]
    settings = car_like_people(rng, taped_road(rng))
    off_px, way_rad = float(rng.uniform(40.0, 120.0)), float(rng.uniform(-math.pi, math.pi))
    settings["camera"] |= {
        "width": 640, "height": 480, "model": model,
        # More beside than above or below: lines stay in view.
        "off_middle_px": (off_px * math.cos(way_rad), 0.5 * off_px * math.sin(way_rad)),
    }  # fmt: skip
    if model == "pinhole":
        view_rad = math.radians(float(rng.uniform(80.0, 100.0)))
        settings["camera"] |= {"field_of_view_rad": view_rad, "distortion": (0.0, 0.0, 0.0, 0.0)}
    return TrapDrive(for_laps(settings, LAPS), model, False)


def taped_road(rng: np.random.Generator) -> dict[str, Any]:
    """A loop drawn at random with white tape."""
    return {
        "lane_width_cm": float(rng.uniform(30.0, 45.0)), "line_width_cm": float(rng.uniform(2.5, 5.0)),
        "min_radius_cm": float(rng.uniform(55.0, 70.0)), "closed": True,
        "length_cm": float(rng.uniform(750.0, 950.0)), "interruptions_per_m": 0.0,
        "left": {"kind": "solid"}, "right": {"kind": "solid"},
    }  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A kind of drives.

    Attributes:
        make: Makes a drive from its number and a seed.
        drives: How many make a set.
    """

    make: Callable[[int, int], TrapDrive]
    drives: int


KINDS = {
    "roads": Kind(roads, 60),
    "tiles": Kind(tiles, 100),
    "office": Kind(office, 40),
    "mats": Kind(mats, 20),
    "floors": Kind(floors, 20),
    "shifted": Kind(shifted, 20),
}
