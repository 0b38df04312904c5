"""Frames without a road that are neither plain nor uniform noise: what carpets, leaves, screens and bad
compression look like to a detector. Each generator gives the same frame for the same seed."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import UInt8

Frame = UInt8[np.ndarray, "h w 3"]
Generator = Callable[[np.random.Generator, int, int], Frame]


def blocks(rng: np.random.Generator, height: int, width: int) -> Frame:
    """Random blocks of 8 px."""
    small = rng.integers(0, 256, (-(-height // 8), -(-width // 8), 3), dtype=np.uint8)
    return np.ascontiguousarray(small.repeat(8, axis=0).repeat(8, axis=1)[:height, :width])


def gray_blocks(rng: np.random.Generator, height: int, width: int) -> Frame:
    """Random gray blocks of 16 px."""
    small = rng.integers(0, 256, (-(-height // 16), -(-width // 16), 1), dtype=np.uint8).repeat(3, axis=2)
    return np.ascontiguousarray(small.repeat(16, axis=0).repeat(16, axis=1)[:height, :width])


def blurred_noise(rng: np.random.Generator, height: int, width: int) -> Frame:
    """Noise blurred to grains of some pixels and stretched to full contrast."""
    soft = cv2.GaussianBlur(rng.standard_normal((height, width, 3)), (0, 0), 2.5)
    low, high = soft.min(), soft.max()
    return np.asarray(255.0 * (soft - low) / max(high - low, 1e-9), dtype=np.uint8)


def salt(rng: np.random.Generator, height: int, width: int) -> Frame:
    """Two in a hundred pixels white on mid gray."""
    frame = np.full((height, width, 3), 90, np.uint8)
    frame[rng.random((height, width)) < 0.02] = 255
    return frame


def jpeg_noise(rng: np.random.Generator, height: int, width: int) -> Frame:
    """Uniform noise out of a JPEG of low quality."""
    noise = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    _, data = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 20])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)


def sticks(rng: np.random.Generator, height: int, width: int) -> Frame:
    """Sixty short strokes in all directions, as of leaves or a printed carpet."""
    frame = np.full((height, width, 3), 110, np.uint8)
    for _ in range(60):
        u, v, angle = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, np.pi)
        half = 0.04 * width * np.array([np.cos(angle), np.sin(angle)])
        ends = np.array([[u, v] - half, [u, v] + half]).astype(int)
        colour = tuple(int(c) for c in rng.integers(0, 256, 3))
        cv2.line(frame, tuple(ends[0].tolist()), tuple(ends[1].tolist()), colour, 2)
    return frame


GENERATORS: dict[str, Generator] = {
    f.__name__: f for f in (blocks, gray_blocks, blurred_noise, salt, jpeg_noise, sticks)
}
