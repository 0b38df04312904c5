"""Light on the floor: lamps mirrored in it, soft shadows that stand or move."""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float

from datagen.world.render.compiled import (
    AT_X,
    AT_Y,
    COS,
    FLOOR_NUMBERS,
    HALF_LENGTH,
    HALF_WIDTH,
    NOT_FLOOR,
    SIN,
    TILE,
    X,
    Y,
    compiled_bare,
)

#: Further columns of shadows and of mirrored lamps, whose half length and width are those of the glow.
SOFTNESS, DEPTH = 6, 7
GLOW = 6
#: Distance, in widths, at which a lamp's glow ends: there (1 - r^2 / reach^2)^6 is closest to exp(-r^2 / 2).
_LAMP_REACH = 3.46


class Lights(NamedTuple):
    """Light on the floor of one frame.

    Attributes:
        shadows: Place, direction, half size, softness of the border, depth.
        lamps: Mirror images: place, direction, widths along and across, brightness.
        lamp_edge: How hard the lamps' border is, from 1 on.
    """

    shadows: Float[np.ndarray, "s 8"]
    lamps: Float[np.ndarray, "m 7"]
    lamp_edge: float


def moved(rows: Float[np.ndarray, "n k"], frame: int) -> Float[np.ndarray, "n k"]:
    """Return rows as they are at a frame: their last four numbers swing the first two to and fro.

    Args:
        rows: Each starts with x and y, [cm], and ends with the swing in x and y, [cm], its period, [frames],
            and its phase, [rad].
        frame: Number of the frame.
    """
    out = rows.copy()
    swing = np.sin(2.0 * np.pi * frame / rows[:, -2] + rows[:, -1])
    out[:, :2] += swing[:, None] * rows[:, -4:-2]
    return out


def mirror_lamps(
    lamps: Float[np.ndarray, "n 4"],
    eye_cm: Float[np.ndarray, "3"],
    level: float,
    near_cm: float,
    streak: float = 1.0,
) -> Float[np.ndarray, "m 7"]:
    """Find where the floor mirrors the lamps into the camera: they wander along as it moves.

    Args:
        lamps: x, y, height above the floor and angular size, [cm], [rad], frame map.
        eye_cm: Optical centre, frame map.
        level: Brightness of their middle.
        near_cm: Mirror images further away than this are left out.
        streak: How much longer the images are than an even mirror would have them.

    Returns:
        x, y, cos and sin of the view, widths along and across it, level.
    """
    share = eye_cm[2] / (eye_cm[2] + lamps[:, 2])
    towards = (lamps[:, :2] - eye_cm[:2]) * share[:, None]
    distance = np.linalg.norm(towards, axis=1)
    near = distance < near_cm
    towards, distance, size_rad = towards[near], distance[near], lamps[near, 3]
    slant = np.hypot(distance, eye_cm[2])
    direction = towards / np.maximum(distance, 1e-9)[:, None]
    # A round glow in the image is longer on the floor, along the view, the flatter the view.
    along_cm = streak * size_rad * slant**2 / eye_cm[2]
    levels = np.full(len(distance), level / np.sqrt(streak))
    return np.column_stack([eye_cm[:2] + towards, direction, along_cm, size_rad * slant, levels])


@compiled_bare
@no_type_check
def light_tile(canvas, ground, view, top, left, box, numbers, lights, buffer):
    """Darken and brighten every pixel of a tile that sees the floor, in place.

    Args:
        canvas: Painted in place.
        ground: The camera's rays.
        view: The frame.
        top: First row of the tile.
        left: First pixel of its rows.
        box: See :func:`datagen.world.render.ground.bound_tile`.
        numbers: See :func:`datagen.world.render.ground.cast_tile`.
        lights: Shadows and lamps.
        buffer: Two float32 per pixel of a tile.
    """
    f = np.float32
    shadows, lamps = lights.shadows, lights.lamps
    dark, bright = buffer[: TILE * TILE], buffer[TILE * TILE :]
    low_x, low_y, high_x, high_y = box
    middle_x, middle_y = 0.5 * (low_x + high_x), 0.5 * (low_y + high_y)
    half_x, half_y = 0.5 * (high_x - low_x), 0.5 * (high_y - low_y)
    rows = min(TILE, ground.height - top)
    touched = False
    for q in range(shadows.shape[0] + lamps.shape[0]):
        is_shadow = q < shadows.shape[0]
        thing = shadows[q] if is_shadow else lamps[q - shadows.shape[0]]
        c, s = thing[COS], thing[SIN]
        x0, y0 = thing[X] - view.pose[0], thing[Y] - view.pose[1]
        x, y = middle_x - x0, middle_y - y0
        reach_a, reach_b = _LAMP_REACH * thing[HALF_LENGTH], _LAMP_REACH * thing[HALF_WIDTH]
        if is_shadow:
            soft = thing[SOFTNESS]
            reach_a, reach_b = thing[HALF_LENGTH] + 0.5 * soft, thing[HALF_WIDTH] + 0.5 * soft
        if abs(x * c + y * s) > reach_a + half_x * abs(c) + half_y * abs(s):
            continue
        if abs(y * c - x * s) > reach_b + half_x * abs(s) + half_y * abs(c):
            continue
        if not touched:
            dark[:], bright[:] = 0.0, 0.0
            touched = True
        # Plain float32 loops over a row: the compiler takes many pixels at a time.
        x0, y0, c, s = f(x0), f(y0), f(c), f(s)
        if is_shadow:
            reach_a, reach_b, per_soft, depth = f(reach_a), f(reach_b), f(1.0 / soft), f(thing[DEPTH])
            for r in range(rows):
                n, row = numbers[FLOOR_NUMBERS * r :], dark[r * TILE :]
                for k in range(TILE):
                    x, y = n[AT_X + k] - x0, n[AT_Y + k] - y0
                    a = min(max((reach_a - abs(x * c + y * s)) * per_soft, f(0.0)), f(1.0))
                    b = min(max((reach_b - abs(y * c - x * s)) * per_soft, f(0.0)), f(1.0))
                    share = depth * a * a * (f(3.0) - f(2.0) * a) * b * b * (f(3.0) - f(2.0) * b)
                    # Shadows of one light do not add up.
                    row[k] = max(row[k], share)
        else:
            per_a, per_b = f(1.0 / thing[HALF_LENGTH]), f(1.0 / thing[HALF_WIDTH])
            glow, edge = f(thing[GLOW]), f(lights.lamp_edge)
            for r in range(rows):
                n, row = numbers[FLOOR_NUMBERS * r :], bright[r * TILE :]
                for k in range(TILE):
                    x, y = n[AT_X + k] - x0, n[AT_Y + k] - y0
                    a, b = (x * c + y * s) * per_a, (y * c - x * s) * per_b
                    # Close to exp(-r^2 / 2), and it ends.
                    fade = max(f(1.0) - (a * a + b * b) * f(1.0 / _LAMP_REACH**2), f(0.0))
                    fade = fade * fade * fade
                    row[k] += glow * min(edge * fade * fade, f(1.0))
    if not touched:
        return
    for r in range(rows):
        i = (top + r) * ground.stride + left
        seen, colours = canvas.level[i : i + TILE], canvas.light[i : i + TILE]
        shade, glow = dark[r * TILE :], bright[r * TILE :]
        for k in range(TILE):
            if seen[k] != NOT_FLOOR:
                keep, add = f(1.0) - shade[k], glow[k]
                for channel in range(3):
                    colours[k, channel] = colours[k, channel] * keep + add
