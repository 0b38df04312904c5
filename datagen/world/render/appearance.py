"""What a synthetic drive looks like: floor, light, camera; none of it changes the ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from datagen.world.render.textures import FloorKind
from datagen.world.road.track import Bgr
from lanenet.config import Settings

#: Least difference between floor and fresh paint, in grey levels; chosen: clear at the loudest noise.
_CONTRAST = 60.0
#: The same for dull paint, and the least factor on the brightness of paint: these include the thin tape
#: of ``garage_tape`` (docs/reality.md).
_DULL_CONTRAST = 45.0
_DULLEST = 0.6


class Appearance(Settings):
    """The appearance of one drive. Every effect is off by default; levels are grey levels, 0..255.

    Attributes:
        floor: What the floor is made of, which decides the kind of its pattern.
        floor_bgr: Mean colour of the floor.
        verge_bgr: Colour beyond the outermost lines, as of a printed mat; None: that of the floor.
        texture_level: Standard deviation of the floor's pattern.
        texture_scale_cm: Size of its finest grains.
        texture_stretch: Ratio of length to width of the grains (wood).
        joint_u_cm: Distance of tile joints or planks in one direction; 0: none.
        joint_v_cm: The same in the other direction.
        joint_level: How much darker the joints are.
        line_brightness: Factor on the colour of the markings.
        line_wear: 0: fresh; 1: about half of the paint is worn off, in patches.
        lamps_per_m: Lamps mirrored in the floor, per metre of road.
        lamp_level: Brightness of their middle.
        lamp_streak: Length of the lamps' images, over that in an even mirror, as on an uneven floor.
        lamp_edge: How hard their border is; 1: softest.
        clutter_per_m: Tape, paper and other things on the floor, per metre of road.
        wall_level: Contrast of the room around; 0: an even wall.
        exposure: Factor on all colours.
        white_balance: Factors on blue, green and red.
        vignetting: Loss of brightness in the corners, 0..1.
        blur_px: Standard deviation of the blur by lens and motion.
        noise_level: Standard deviation of the sensor's noise.
        jpeg_quality: Quality with which the camera compresses; None: not at all.
        objects_per_m: Boxes, cones, walls, people's legs and cars beside the road, per metre of road.
        objects_on_road: Share of them that stand partly on the road, but not in the middle of the lane.
        shadows_per_m: Shadows of people who walk about, per metre of road.
        shadow_depth: Share of the light that shadows take, also those of objects.
        exposure_drift: Standard deviation of the exposure's slow drift, as a logarithm.
        exposure_step: Standard deviation of its steps, as a logarithm.
        white_balance_drift: Standard deviation of the white balance's slow drift, as a logarithm.
        white_balance_step: Standard deviation of its steps.
        drift_frames: About how long exposure and white balance take to change.
        exposure_s: Time that a pixel gathers light, in which the car moves on.
        readout_s: Time from the first row of the image to the last.
        shake_pitch_rad: Standard deviation of the camera's pitch from frame to frame.
        shake_roll_rad: Standard deviation of its roll.
        lamp_size: Factor on the size of the lamps overhead.
        glints_per_m: Windows and lights far around, mirrored in the floor ahead, per metre of road.
        specks_per_m: Crumbs, chips and drops on the floor, per metre of road.
        prints_per_m: Figures printed or painted beside the road, clear of its lines, per metre of road.
        stain_level: How much brighter (or darker, below 0) stains of the floor are; stains and cracks need a
            texture_level above 0.
        crack_level: How much darker cracks of the floor are.
    """

    floor: FloorKind = "plain"
    floor_bgr: Bgr = (70.0, 70.0, 70.0)
    verge_bgr: Bgr | None = None
    texture_level: float = Field(default=0.0, ge=0.0)
    texture_scale_cm: float = Field(default=0.6, gt=0.0)
    texture_stretch: float = Field(default=1.0, ge=1.0)
    joint_u_cm: float = Field(default=0.0, ge=0.0)
    joint_v_cm: float = Field(default=0.0, ge=0.0)
    joint_level: float = Field(default=25.0, ge=0.0)
    line_brightness: float = Field(default=1.0, gt=0.0)
    line_wear: float = Field(default=0.0, ge=0.0, le=1.0)
    lamps_per_m: float = Field(default=0.0, ge=0.0)
    lamp_level: float = Field(default=120.0, ge=0.0)
    lamp_streak: float = Field(default=1.0, ge=1.0, le=10.0)
    lamp_edge: float = Field(default=1.0, ge=1.0, le=20.0)
    clutter_per_m: float = Field(default=0.0, ge=0.0)
    wall_level: float = Field(default=0.0, ge=0.0)
    exposure: float = Field(default=1.0, gt=0.0)
    white_balance: Bgr = (1.0, 1.0, 1.0)
    vignetting: float = Field(default=0.0, ge=0.0, lt=1.0)
    blur_px: float = Field(default=0.0, ge=0.0, le=5.0)
    noise_level: float = Field(default=0.0, ge=0.0)
    jpeg_quality: int | None = Field(default=None, ge=1, le=100)
    objects_per_m: float = Field(default=0.0, ge=0.0)
    objects_on_road: float = Field(default=0.15, ge=0.0, le=1.0)
    shadows_per_m: float = Field(default=0.0, ge=0.0)
    shadow_depth: float = Field(default=0.4, ge=0.0, le=1.0)
    exposure_drift: float = Field(default=0.0, ge=0.0, le=1.0)
    exposure_step: float = Field(default=0.0, ge=0.0, le=1.0)
    white_balance_drift: float = Field(default=0.0, ge=0.0, le=0.5)
    white_balance_step: float = Field(default=0.0, ge=0.0, le=0.5)
    drift_frames: float = Field(default=80.0, ge=2.0)
    exposure_s: float = Field(default=0.0, ge=0.0, le=0.2)
    readout_s: float = Field(default=0.0, ge=0.0, le=0.2)
    shake_pitch_rad: float = Field(default=0.0, ge=0.0, le=0.2)
    shake_roll_rad: float = Field(default=0.0, ge=0.0, le=0.2)
    lamp_size: float = Field(default=1.0, gt=0.0, le=5.0)
    glints_per_m: float = Field(default=0.0, ge=0.0)
    specks_per_m: float = Field(default=0.0, ge=0.0)
    prints_per_m: float = Field(default=0.0, ge=0.0)
    stain_level: float = Field(default=0.0, ge=-100.0, le=100.0)
    crack_level: float = Field(default=0.0, ge=0.0, le=100.0)


def random_appearance(
    fixed: Appearance, rng: np.random.Generator, paint_bgr: tuple[Bgr, ...] = ()
) -> Appearance:
    """Draw the appearance of a drive.

    Args:
        fixed: Values that are set explicitly stay. They are drawn all the same, so that setting one does not
            change another.
        rng: Source of randomness.
        paint_bgr: Colours of the road's markings; where they are dark, the floor is drawn light. Without any,
            the paint is taken to be light.

    Returns:
        An appearance with every value set.
    """
    drawn: dict[str, Any] = {
        **_random_floor(rng),
        "line_brightness": rng.uniform(0.85, 1.08),
        "line_wear": max(0.0, rng.uniform(-0.4, 0.5)),
        "lamps_per_m": max(0.0, rng.uniform(-0.6, 1.4)),
        "lamp_level": rng.uniform(40.0, 190.0),
        "clutter_per_m": max(0.0, rng.uniform(-0.5, 4.0)),
        "wall_level": rng.uniform(10.0, 45.0),
        # Automatic exposure makes dark floors gray.
        "exposure": float(np.exp(rng.uniform(np.log(0.7), np.log(1.45)))),
        "white_balance": tuple(float(v) for v in rng.uniform(0.9, 1.1, 3)),
        "vignetting": rng.uniform(0.0, 0.5),
        "blur_px": rng.uniform(0.0, 1.2),
        # Log-uniform: in good light most cameras show hardly any noise.
        "noise_level": float(np.exp(rng.uniform(np.log(0.4), np.log(7.0)))),
        "jpeg_quality": int(rng.integers(60, 96)),
    }
    # Each group has its own child, so that none changes the draws of another.
    later = rng.spawn(1)[0]
    drawn |= _random_motion(later) | _random_surroundings(later) | _other_floor(later)
    newer = rng.spawn(1)[0]
    drawn |= _random_marks(drawn, newer)
    drawn |= _lightened(drawn, paint_bgr)
    drawn |= _dulled(drawn, paint_bgr, newer)
    kept = {name: getattr(fixed, name) for name in fixed.model_fields_set}
    return Appearance(**{**drawn, **kept})


def _random_motion(rng: np.random.Generator) -> dict[str, Any]:
    """Exposure, read-out, shake and drift, up to those of a cheap camera on an uneven floor."""
    return {
        "exposure_s": float(np.exp(rng.uniform(np.log(0.002), np.log(0.025)))),
        "readout_s": rng.uniform(0.0, 0.03),
        "shake_pitch_rad": rng.uniform(0.0, 0.008),
        "shake_roll_rad": rng.uniform(0.0, 0.006),
        "exposure_drift": rng.uniform(0.0, 0.12),
        "exposure_step": max(0.0, rng.uniform(-0.1, 0.1)),
        "white_balance_drift": rng.uniform(0.0, 0.04),
        "white_balance_step": max(0.0, rng.uniform(-0.03, 0.03)),
        "drift_frames": rng.uniform(40.0, 200.0),
    }


def _random_surroundings(rng: np.random.Generator) -> dict[str, Any]:
    """Things around the road on three drives of four, shadows on every other; how floors mirror lamps."""
    return {
        "objects_per_m": max(0.0, rng.uniform(-0.6, 2.0)),
        "objects_on_road": rng.uniform(0.0, 0.25),
        "shadows_per_m": max(0.0, rng.uniform(-0.4, 0.4)),
        "shadow_depth": rng.uniform(0.15, 0.6),
        "lamp_streak": rng.uniform(1.0, 2.0),
        "lamp_edge": float(np.exp(rng.uniform(0.0, np.log(5.0)))),
    }


def _random_marks(drawn: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Specks, stains and cracks on two floors of five each, lights mirrored far ahead on every other one.

    Mats mostly have something printed beside the road, other floors now and then. Real drives in
    large rooms show several times the clutter of clean ones, see ``docs/reality.md``.
    """
    stain, crack, printed, glint = rng.uniform(-1.0, 1.0, 4)
    specks, size, darker = rng.random(3)
    prints = max(0.0, 0.5 + 1.5 * printed if drawn["floor"] == "mat" else 2.5 * (printed - 0.5))
    return {
        "specks_per_m": max(0.0, 14.0 * specks - 8.0),
        "stain_level": (-1.0 if darker < 0.6 else 1.0) * max(0.0, 35.0 * stain - 5.0),
        "crack_level": max(0.0, 50.0 * crack - 10.0),
        "prints_per_m": prints,
        "glints_per_m": max(0.0, 4.0 * glint),
        "lamp_size": 0.4 + 0.8 * size,
    }


def _dulled(drawn: dict[str, Any], paint_bgr: tuple[Bgr, ...], rng: np.random.Generator) -> dict[str, Any]:
    """Make the paint of every other drive duller, like thin or dirty tape, but never hard to see."""
    dull = max(0.0, rng.uniform(-1.0, 1.0))
    paint = min((colour[1] for colour in paint_bgr), default=225.0)
    least = max(_DULLEST, (drawn["floor_bgr"][1] + _DULL_CONTRAST) / max(paint, 1.0))
    brightness = drawn["line_brightness"]
    # Dark paint or a light floor leaves no room for that.
    return {"line_brightness": brightness - dull * max(0.0, brightness - least)}


def _other_floor(rng: np.random.Generator) -> dict[str, Any]:
    """On two drives of five a carpet, a printed mat or grass; carpet and grass hardly mirror lamps."""
    kind, brightness, tint, texture = rng.random(4)
    hue = rng.uniform(0.75, 1.25, 3)
    verge = rng.uniform(40.0, 180.0, 3)
    if kind < 0.15:  # carpet: any colour
        gray = 40.0 + 85.0 * brightness
        colour = (gray * float(hue[0]), gray * float(hue[1]), gray * float(hue[2]))
        dull = {"lamp_level": 15.0 * (1.0 + tint)}
        return _floor("carpet", colour, 3.0 + 6.0 * texture, 0.4) | dull
    if kind < 0.3:  # printed mat: a gray road on another colour
        gray = 50.0 + 60.0 * brightness
        floor = _floor("mat", (gray, gray, gray * (1.0 + 0.05 * tint)), 1.0 + 4.0 * texture, 1.0)
        return {**floor, "verge_bgr": tuple(float(v) for v in verge)}
    if kind < 0.4:  # artificial grass
        gray = 50.0 + 50.0 * brightness
        colour = (gray * 0.6, gray * 1.25, gray * (0.75 + 0.2 * tint))
        dull = {"lamp_level": 15.0 * (1.0 + tint)}
        return _floor("grass", colour, 5.0 + 8.0 * texture, 0.4) | dull
    return {}


def _lightened(drawn: dict[str, Any], paint_bgr: tuple[Bgr, ...]) -> dict[str, Any]:
    """Make the floor lighter if some of the paint would have too little contrast.

    Dark paint needs a light floor; with dark and light paint on one road, the floor goes in between.
    """
    paints = sorted(float(np.mean(colour)) for colour in paint_bgr)
    floor = float(np.mean(drawn["floor_bgr"]))
    if not paints or min(abs(paint - floor) for paint in paints) >= _CONTRAST:
        return {}
    dark = [paint for paint in paints if paint < 120.0]
    if not dark:
        return {}
    wanted = 190.0 if len(dark) == len(paints) else 0.5 * (dark[-1] + min(p for p in paints if p >= 120.0))
    wanted = max(wanted, dark[-1] + _CONTRAST)
    gains = np.asarray(drawn["floor_bgr"]) / max(floor, 1.0)
    return {"floor_bgr": tuple(float(min(v, 235.0)) for v in wanted * gains)}


def _random_floor(rng: np.random.Generator) -> dict[str, Any]:
    """Asphalt, concrete, wood or tile; always darker than fresh paint."""
    kind = int(rng.integers(4))
    brightness, tint, texture, joints = rng.random(), rng.uniform(-1.0, 1.0), rng.random(), rng.random()
    if kind == 0:  # dark asphalt: coarse grain, no joints
        gray = 35.0 + 45.0 * brightness
        floor = (gray * (1.0 + 0.08 * tint), gray, gray * (1.0 - 0.05 * tint))
        return _floor("asphalt", floor, 4.0 + 9.0 * texture, 0.4)
    if kind == 1:  # gray concrete: soft stains, wide joints on every other floor
        gray = 85.0 + 55.0 * brightness
        joint_cm = 80.0 + 120.0 * joints if joints > 0.5 else 0.0
        floor = (gray, gray, gray * (1.0 + 0.04 * tint))
        return _floor("plain", floor, 3.0 + 7.0 * texture, 1.5, joint_cm=joint_cm)
    if kind == 2:  # wood: long grains, planks
        gray = 75.0 + 55.0 * brightness
        floor = (gray * (0.62 + 0.1 * tint), gray, gray * 1.35)
        return _floor("wood", floor, 3.0 + 7.0 * texture, 0.5, stretch=12.0)
    gray = 115.0 + 40.0 * brightness  # light tile
    tile_cm = 25.0 + 35.0 * joints
    floor = (gray * (1.0 + 0.05 * tint), gray, gray)
    return _floor("tile", floor, 1.0 + 3.0 * texture, 1.0, joint_cm=tile_cm)


def _floor(
    kind: FloorKind, bgr: Bgr, level: float, scale_cm: float, stretch: float = 1.0, joint_cm: float = 0.0
) -> dict[str, Any]:
    return {
        "floor": kind,
        "floor_bgr": bgr,
        "texture_level": level,
        "texture_scale_cm": scale_cm,
        "texture_stretch": stretch,
        "joint_u_cm": joint_cm,
        "joint_v_cm": joint_cm,
        "joint_level": 8.0 + 2.0 * level,
    }
