"""What a synthetic drive looks like: floor, light, camera; none of it changes the truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from lanenet.config import Settings


class LookSettings(Settings):
    """The look of one drive. Every effect is off by default; levels are in grey levels, 0..255.

    Attributes:
        floor_bgr: Mean colour of the floor.
        texture_level: Standard deviation of the floor's pattern.
        texture_scale_cm: Size of its finest grains.
        texture_stretch: How much longer than wide the grains are (wood).
        joint_u_cm: Distance of tile joints or planks in one direction; 0: none.
        joint_v_cm: The same in the other direction.
        joint_level: How much darker the joints are.
        line_brightness: Factor on the colour of the markings.
        line_wear: 0: fresh; 1: about half of the paint is worn off, in patches.
        lamps_per_m: Lamps mirrored in the floor, per metre of road.
        lamp_level: Brightness of their middle.
        clutter_per_m: Tape, paper and other things on the floor, per metre of road.
        wall_level: Contrast of the room around; 0: an even wall.
        exposure: Factor on all colours.
        white_balance: Factors on blue, green and red.
        vignetting: Loss of brightness in the corners, 0..1.
        blur_px: Standard deviation of the blur by lens and motion.
        noise_level: Standard deviation of the sensor's noise.
        jpeg_quality: Quality with which the camera compresses; None: not at all.
    """

    floor_bgr: tuple[float, float, float] = (70.0, 70.0, 70.0)
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
    clutter_per_m: float = Field(default=0.0, ge=0.0)
    wall_level: float = Field(default=0.0, ge=0.0)
    exposure: float = Field(default=1.0, gt=0.0)
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vignetting: float = Field(default=0.0, ge=0.0, lt=1.0)
    blur_px: float = Field(default=0.0, ge=0.0, le=5.0)
    noise_level: float = Field(default=0.0, ge=0.0)
    jpeg_quality: int | None = Field(default=None, ge=1, le=100)


def random_look(fixed: LookSettings, rng: np.random.Generator) -> LookSettings:
    """Draw the look of a drive.

    Args:
        fixed: Values that were set in so many words stay; all others are drawn. They are drawn all the same,
            so that fixing one does not move another.
        rng: Source of randomness.

    Returns:
        A look with every value set.
    """
    drawn: dict[str, Any] = {
        **_random_floor(rng),
        "line_brightness": rng.uniform(0.85, 1.08),
        "line_wear": max(0.0, rng.uniform(-0.4, 0.5)),
        "lamps_per_m": max(0.0, rng.uniform(-0.3, 0.7)),
        "lamp_level": rng.uniform(40.0, 190.0),
        "clutter_per_m": max(0.0, rng.uniform(-0.5, 2.5)),
        "wall_level": rng.uniform(10.0, 45.0),
        "exposure": float(np.exp(rng.uniform(np.log(0.7), np.log(1.2)))),
        "white_balance": tuple(float(v) for v in rng.uniform(0.9, 1.1, 3)),
        "vignetting": rng.uniform(0.0, 0.5),
        "blur_px": rng.uniform(0.0, 1.2),
        "noise_level": rng.uniform(0.5, 7.0),
        "jpeg_quality": int(rng.integers(60, 96)),
    }
    kept = {name: getattr(fixed, name) for name in fixed.model_fields_set}
    return LookSettings(**{**drawn, **kept})


def _random_floor(rng: np.random.Generator) -> dict[str, Any]:
    """Asphalt, concrete, wood or tile; always darker than fresh paint."""
    kind = int(rng.integers(4))
    brightness, tint, texture, joints = rng.random(), rng.uniform(-1.0, 1.0), rng.random(), rng.random()
    if kind == 0:  # dark asphalt: coarse grain, no joints
        gray = 35.0 + 45.0 * brightness
        floor = (gray * (1.0 + 0.08 * tint), gray, gray * (1.0 - 0.05 * tint))
        return _floor(floor, 4.0 + 9.0 * texture, 0.4, 1.0, 0.0, 0.0)
    if kind == 1:  # gray concrete: soft stains, wide joints on every other floor
        gray = 85.0 + 55.0 * brightness
        joint_cm = 80.0 + 120.0 * joints if joints > 0.5 else 0.0
        return _floor(
            (gray, gray, gray * (1.0 + 0.04 * tint)), 3.0 + 7.0 * texture, 1.5, 1.0, joint_cm, joint_cm
        )
    if kind == 2:  # wood: long grains, planks
        gray = 75.0 + 55.0 * brightness
        floor = (gray * (0.62 + 0.1 * tint), gray, gray * 1.35)
        return _floor(floor, 3.0 + 7.0 * texture, 0.5, 12.0, 60.0 + 60.0 * texture, 8.0 + 10.0 * joints)
    gray = 115.0 + 40.0 * brightness  # light tile
    tile_cm = 25.0 + 35.0 * joints
    return _floor((gray * (1.0 + 0.05 * tint), gray, gray), 1.0 + 3.0 * texture, 1.0, 1.0, tile_cm, tile_cm)


def _floor(
    bgr: tuple[float, float, float], level: float, scale_cm: float, stretch: float, u_cm: float, v_cm: float
) -> dict[str, Any]:
    return {
        "floor_bgr": bgr,
        "texture_level": level,
        "texture_scale_cm": scale_cm,
        "texture_stretch": stretch,
        "joint_u_cm": u_cm,
        "joint_v_cm": v_cm,
        "joint_level": 8.0 + 2.0 * level,
    }
