"""From light to the image: gains that drift and step, noise, rounding; and the room behind the floor.

What varies from frame to frame is a random function of the frame's number: any frame can be asked for.
"""

from __future__ import annotations

from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.world.render.compiled import NOT_FLOOR, TILE, compiled, compiled_bare

#: Values that are developed together: a multiple of three, so that channels keep their place, of 3 kB in all.
_BLOCK = 3 * 256
#: Sines in a wandering value; chosen: enough that no period is noticed in a drive.
_WAVES = 5


class Wander:
    """Smooth, with unit variance: a few sines of random period and phase."""

    def __init__(
        self, count: int, shortest_frames: float, longest_frames: float, rng: np.random.Generator
    ) -> None:
        """Draw ``count`` independent functions whose waves last between so many frames."""
        # Log-uniform: slow and quick movements alike.
        exponent = rng.uniform(np.log(shortest_frames), np.log(longest_frames), (count, _WAVES))
        self._pace = 2.0 * np.pi / np.exp(exponent)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (count, _WAVES))

    def at(self, frame: int) -> Float[np.ndarray, "count"]:
        """Return the values at a frame."""
        return np.asarray(np.sqrt(2.0 / _WAVES) * np.sin(self._pace * frame + self._phase).sum(axis=1))


class Steps:
    """Constant for a while, then another value, with unit variance."""

    def __init__(self, count: int, every_frames: float, rng: np.random.Generator) -> None:
        """Draw ``count`` functions that all step at the same frames, every ``every_frames``."""
        self._count, self._every = count, every_frames
        self._seed, self._phase = int(rng.integers(2**62)), float(rng.random())
        self._last: tuple[int, Float[np.ndarray, "count"]] | None = None  # neighbouring frames share it

    def at(self, frame: int) -> Float[np.ndarray, "count"]:
        """Return the values at a frame."""
        block = int(np.floor(frame / self._every + self._phase))
        if self._last is None or self._last[0] != block:
            self._last = (block, np.random.default_rng((self._seed, block)).standard_normal(self._count))
        return self._last[1]


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
def paint_room(canvas, ground, view, room, buffers):
    """Paint every pixel that sees the walls.

    Args:
        canvas: Painted in place, except for pixels whose level says that they see the floor.
        ground: The camera's rays.
        view: The frame.
        room: Colours by elevation (0 to 90 degrees) and azimuth, padded to four values.
        buffers: For a row of ``TILE`` pixels: two int32, four float32 and another four float32 per pixel.
    """
    f = np.float32
    rows, columns = room.shape[0], room.shape[1]
    texels = room.reshape(-1)
    cells, weights, colours = buffers
    per_rad, per_elevation = f(columns / (2.0 * np.pi)), f(rows / (0.5 * np.pi))
    up, right, last = f(view.tilt[0]), f(view.tilt[1]), f(rows - 1.001)
    heading, turn = f(view.pose[2] % (2.0 * np.pi)), view.turn_rad
    taps = 1 + min(int(abs(turn) * per_rad), 7)
    share, around, none = f(1.0 / taps), f(columns), f(0.0)
    for start in range(0, canvas.level.shape[0], TILE):
        stop = start + TILE
        seen, light = canvas.level[start:stop], canvas.light[start:stop]
        azimuth, elevation = ground.azimuth_rad[start:stop], ground.elevation_rad[start:stop]
        ahead, aside = ground.toward[0, start:stop], ground.toward[1, start:stop]
        walls = np.uint8(0)
        for j in range(TILE):
            walls |= np.uint8(seen[j] == NOT_FLOOR)
        if walls == 0:
            continue
        colours[:] = none
        for tap in range(taps):
            shift = f(turn * ((tap + 0.5) * share - 0.5))
            # Plain loops: the compiler takes many pixels at a time.
            for j in range(TILE):
                # First order: what is ahead moves by the pitch, what is to the side by the roll.
                row = max(elevation[j] + up * ahead[j] + right * aside[j], none) * per_elevation
                row = min(row, last)
                column = (azimuth[j] + heading + shift) * per_rad + around  # never negative
                wall = seen[j] == NOT_FLOOR
                wall &= abs(azimuth[j]) < around  # not a number where the lens sees nothing
                row, column = row if wall else none, column if wall else none
                r0, c0 = np.int32(row), np.int32(column)
                fr, fc = row - f(r0), column - f(c0)
                c0 = c0 - np.int32(columns) if c0 >= columns else c0
                c0 = c0 - np.int32(columns) if c0 >= columns else c0
                c1 = c0 + np.int32(1)
                c1 = c1 if c1 < columns else np.int32(0)
                line = r0 * np.int32(columns)
                cells[j], cells[TILE + j] = np.int32(line + c0), np.int32(line + c1)
                weights[j], weights[TILE + j] = (f(1.0) - fr) * (f(1.0) - fc), (f(1.0) - fr) * fc
                weights[2 * TILE + j], weights[3 * TILE + j] = fr * (f(1.0) - fc), fr * fc
            for j in range(TILE):
                a, b, c, d = weights[j], weights[TILE + j], weights[2 * TILE + j], weights[3 * TILE + j]
                # Unsigned: no index can be negative as far as the compiler knows.
                p, q, down = np.uint64(4 * cells[j]), np.uint64(4 * cells[TILE + j]), np.uint64(4 * columns)
                for k in range(np.uint64(0), np.uint64(4)):
                    upper = a * texels[p + k] + b * texels[q + k]
                    colours[np.uint64(4 * j) + k] += (
                        upper + c * texels[p + down + k] + d * texels[q + down + k]
                    )
        for j in range(TILE):
            if seen[j] == NOT_FLOOR and np.isfinite(azimuth[j]):
                for k in range(3):
                    light[j, k] = colours[4 * j + k] * share


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
