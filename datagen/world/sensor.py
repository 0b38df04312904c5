"""From light to the image: gains that drift and step, noise, rounding; and the room behind the floor."""

from __future__ import annotations

from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from datagen.world.compiled import compiled, compiled_bare
from datagen.world.ground import NOT_FLOOR

_BLOCK = 3 * 256  # values; a multiple of three, so that channels keep their place in it


def corner_falloff(height: int, width: int, vignetting: float) -> Float32[np.ndarray, "values"]:
    """Return the factor on each pixel's three values: darker towards the corners."""
    v, u = np.mgrid[0:height, 0:width]
    r2 = (u - 0.5 * (width - 1)) ** 2 + (v - 0.5 * (height - 1)) ** 2
    return np.repeat(1.0 - vignetting * r2.ravel() / r2.max(), 3).astype(np.float32)


def as_jpeg(image_bgr: UInt8[np.ndarray, "h w 3"], quality: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image as it is after compression to a JPEG of this quality, 1..100."""
    _, data = cv2.imencode(".jpg", image_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


@compiled_bare
@no_type_check
def paint_room(out, level, azimuths, elevations, toward, heading, tilt, turn, room, pixel):
    """Paint every pixel that sees the walls.

    Args:
        out: Image as rows of pixels, float32, filled in place.
        level: See :func:`datagen.world.ground.cast_tile`: pixels that see the floor are left out.
        azimuths: Of each pixel's ray, from straight ahead, left positive; NaN where the lens sees nothing.
        elevations: Of each pixel's ray, from the foot of the wall.
        toward: Cosine and sine of the azimuths.
        heading: Of the car.
        tilt: How far the camera shakes up (at the front) and to the right, small angles.
        turn: By how much the car turns during the exposure.
        room: Colours by elevation (0..90 degrees) and azimuth, filled up to four values.
        pixel: Buffer of four values: the compiler takes four at a time, not three.
    """
    f = np.float32
    rows, columns = room.shape[0], room.shape[1]
    texels = room.reshape(-1)
    per_rad, per_elevation = f(columns / (2.0 * np.pi)), f(rows / (0.5 * np.pi))
    up, right, heading, last = f(tilt[0]), f(tilt[1]), f(heading % (2.0 * np.pi)), f(rows - 1.001)
    taps = 1 + min(int(abs(turn) * per_rad), 7)
    share = f(1.0 / taps)
    for i in range(level.shape[0]):
        azimuth = azimuths[i]
        if level[i] != NOT_FLOOR or not np.isfinite(azimuth):
            continue
        # First order: what is ahead moves by the pitch, what is to the side by the roll.
        elevation = elevations[i] + up * toward[0, i] + right * toward[1, i]
        row = min(max(elevation, f(0.0)) * per_elevation, last)
        r0 = int(row)
        fr = row - f(r0)
        blue, green, red, nothing = f(0.0), f(0.0), f(0.0), f(0.0)
        for tap in range(taps):
            shift = f(turn * ((tap + 0.5) * share - 0.5))
            column = (azimuth + heading + shift) * per_rad + f(columns)  # never negative
            c0 = int(column)
            fc = column - f(c0)
            while c0 >= columns:
                c0 -= columns
            c1 = c0 + 1 if c0 + 1 < columns else 0
            a, b = (f(1.0) - fr) * (f(1.0) - fc), (f(1.0) - fr) * fc
            c, d = fr * (f(1.0) - fc), fr * fc
            # Slices, so that no index can be negative as far as the compiler knows.
            p, q = texels[4 * (r0 * columns + c0) :], texels[4 * (r0 * columns + c1) :]
            r, s = texels[4 * ((r0 + 1) * columns + c0) :], texels[4 * ((r0 + 1) * columns + c1) :]
            blue += a * p[0] + b * q[0] + c * r[0] + d * s[0]
            green += a * p[1] + b * q[1] + c * r[1] + d * s[1]
            red += a * p[2] + b * q[2] + c * r[2] + d * s[2]
            nothing += a * p[3] + b * q[3] + c * r[3] + d * s[3]
        pixel[0], pixel[1], pixel[2], pixel[3] = blue * share, green * share, red * share, nothing * share
        out[i, 0], out[i, 1], out[i, 2] = pixel[0], pixel[1], pixel[2]


@compiled
@no_type_check
def develop(light, falloff, gains, noise, noise_level, out):
    """Apply the gains per value and per channel, add noise, round to uint8.

    Args:
        light: The image's values one after the other, three per pixel, float32.
        falloff: Factor on each.
        gains: Factors on blue, green and red.
        noise: One number for each value.
        noise_level: Factor on it.
        out: Filled.
    """
    f = np.float32
    low, high, half, noise_level = f(0.0), f(255.0), f(0.5), f(noise_level)
    block_gains = np.empty(_BLOCK, np.float32)
    for j in range(_BLOCK):
        block_gains[j] = gains[j % 3]
    for start in range(0, light.shape[0], _BLOCK):
        stop = min(start + _BLOCK, light.shape[0])
        a, b, c, d = light[start:stop], falloff[start:stop], noise[start:stop], out[start:stop]
        for j in range(stop - start):
            value = a[j] * b[j] * block_gains[j] + noise_level * c[j] + half
            d[j] = np.uint8(min(max(value, low), high))
