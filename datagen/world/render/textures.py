"""The floor's pattern, by kind of floor: periodic, with unit variance, coarser from level to level."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from datagen.world.render.ground import TEXTURE_CELL_CM, TEXTURE_LEVELS, TEXTURE_SIDE

FloorKind = Literal["plain", "asphalt", "wood", "tile", "carpet", "mat", "grass"]
#: Factor on the pattern in blue, green and red: a floor's spots differ in colour too.
PATTERN_BGR: dict[str, tuple[float, float, float]] = {
    "plain": (1.0, 1.0, 1.0),
    "asphalt": (1.0, 1.0, 1.0),
    "wood": (0.7, 0.95, 1.2),
    "tile": (1.0, 1.0, 0.95),
    "carpet": (1.0, 0.9, 1.1),
    "mat": (1.0, 1.0, 1.0),
    "grass": (0.5, 1.25, 0.8),
}
_CELLS = TEXTURE_SIDE
#: Largest deviation of a pattern, in standard deviations: no single spot is as bright as paint.
_MAX_DEVIATION = 6.0

Cells = Float[np.ndarray, "n n"]


def noise(scale_cm: float, stretch: float, rng: np.random.Generator) -> Cells:
    """Return noise with equal power per octave from the grain size to 50 cm, of unit variance."""
    f = np.fft.fftfreq(_CELLS, TEXTURE_CELL_CM)
    fu, fv = np.meshgrid(f * stretch, f)
    frequency = np.hypot(fu, fv)
    with np.errstate(divide="ignore"):
        amplitude = np.where(frequency > 1.0 / 50.0, 1.0 / np.maximum(frequency, 1e-9), 0.0)
    amplitude *= np.exp(-0.5 * (frequency * scale_cm * 2.0) ** 2)
    cells = np.fft.ifft2(np.fft.fft2(rng.standard_normal((_CELLS, _CELLS))) * amplitude).real
    return np.asarray(cells / cells.std())


def floor_pattern(kind: FloorKind, scale_cm: float, stretch: float, rng: np.random.Generator) -> Cells:
    """Draw the pattern of a floor: zero mean, unit variance, without rare extremes.

    Args:
        kind: What the floor is made of.
        scale_cm: Size of the finest grains of its noise.
        stretch: How much longer than wide the grains are.
        rng: Source of randomness.
    """
    base = noise(scale_cm, stretch, rng)
    if kind == "asphalt":
        base = 0.6 * base + 1.6 * _specks(rng) + _cracks(int(rng.integers(0, 5)), -4.0, rng)
    elif kind == "wood":
        base = 0.7 * base + _planks(rng)
    elif kind == "tile":
        veins = -np.exp(-np.abs(noise(3.0, 1.0, rng)) * 8.0)
        base = 0.5 * base + 1.2 * veins
    elif kind == "carpet":
        base = 0.5 * base + 0.8 * rng.standard_normal(base.shape) + _weave(rng)
    elif kind == "mat":
        base = 0.4 * base + _wrinkles(rng)
    elif kind == "grass":
        base = 0.5 * base + _blades(rng)
    base = base - base.mean()
    return np.clip(base / max(float(base.std()), 1e-9), -_MAX_DEVIATION, _MAX_DEVIATION)


def stains(rng: np.random.Generator) -> Cells:
    """Draw spots with a ragged border, as of oil, water or mended floor: 1 inside, 0 outside."""
    shape = noise(float(rng.uniform(1.5, 5.0)), 1.0, rng) + 0.2 * noise(0.6, 1.0, rng)
    least = np.quantile(shape, rng.uniform(0.8, 0.97))
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip((shape - least) / rng.uniform(0.03, 0.25), -30.0, 30.0))))


def cracks(rng: np.random.Generator) -> Cells:
    """Draw a few cracks that wander over the floor: 1 inside, 0 outside."""
    return np.minimum(_cracks(int(rng.integers(1, 6)), 1.0, rng), 1.0)


def level_starts() -> Int[np.ndarray, "starts"]:
    """Where each level starts in a packed texture, and where the last one ends."""
    sizes = [(_CELLS >> level) ** 2 for level in range(TEXTURE_LEVELS)]
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def pack_levels(pattern: Cells) -> Float32[np.ndarray, "packed"]:
    """Blur a periodic pattern more from level to level, halve the cells each time, and join all levels."""
    f = np.fft.fftfreq(_CELLS, TEXTURE_CELL_CM)
    fu, fv = np.meshgrid(f, f)
    spectrum = np.fft.fft2(pattern)
    levels = []
    for level in range(TEXTURE_LEVELS):
        sigma_cm = 0.4 * TEXTURE_CELL_CM * 2.0**level
        blur = np.exp(-2.0 * (np.pi * sigma_cm) ** 2 * (fu**2 + fv**2))
        levels.append(np.fft.ifft2(spectrum * blur).real[:: 1 << level, :: 1 << level].ravel())
    return np.concatenate(levels).astype(np.float32)


def _specks(rng: np.random.Generator) -> Cells:
    """Single bright and dark stones."""
    cells = rng.standard_normal((_CELLS, _CELLS))
    return np.asarray(np.where(np.abs(cells) > 1.8, np.sign(cells) * 2.0, 0.2 * cells))


def _cracks(count: int, level: float, rng: np.random.Generator) -> Cells:
    """Thin lines that wander over the floor and fork."""
    cells = np.zeros((_CELLS, _CELLS), np.float32)
    for _ in range(count):
        steps = int(rng.integers(60, 200))
        turns = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.22, steps))
        _wrapped_line(cells, _wander(turns, 3.0, rng), level, 1)
    return cells.astype(np.float64)


def _wander(
    turns_rad: Float[np.ndarray, "k"], step: float, rng: np.random.Generator
) -> Float[np.ndarray, "k 2"]:
    """A path from a random cell, by steps in the given directions."""
    steps = step * np.stack([np.cos(turns_rad), np.sin(turns_rad)], axis=1)
    return rng.uniform(0.0, _CELLS, 2) + np.cumsum(steps, axis=0)


def _wrapped_line(
    cells: Float32[np.ndarray, "n n"], path: Float[np.ndarray, "k 2"], level: float, width: int
) -> None:
    """Draw a line that continues at the opposite side where it leaves the pattern."""
    low = np.floor(path.min(axis=0) / _CELLS).astype(int)
    high = np.floor(path.max(axis=0) / _CELLS).astype(int)
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            points = np.rint((path - _CELLS * np.array([i, j])) * 16.0).astype(np.int32)
            cv2.polylines(cells, [points.reshape(-1, 1, 2)], False, level, width, cv2.LINE_8, 4)


def _planks(rng: np.random.Generator) -> Cells:
    """Boards of one width and many lengths, each with its own tone, and dark joints between them."""
    cells = np.zeros((_CELLS, _CELLS))
    rows = int(rng.integers(18, 32))
    edges = np.linspace(0, _CELLS, rows + 1).astype(int)
    for top, bottom in pairwise(edges):
        ends = np.sort(rng.integers(0, _CELLS, int(rng.integers(2, 6))))
        tones = rng.normal(0.0, 0.8, len(ends))
        board = np.searchsorted(ends, np.arange(_CELLS), side="right") % len(ends)
        cells[top:bottom] = tones[board]
        cells[top:bottom, ends] = -2.0
        cells[top] = -2.0
    return cells


def _weave(rng: np.random.Generator) -> Cells:
    """A woven pattern: stripes or diamonds that repeat, on every other carpet."""
    v, u = np.mgrid[0:_CELLS, 0:_CELLS]
    waves = 2 ** int(rng.integers(2, 5))
    phase = 2.0 * np.pi * waves / _CELLS
    wave = np.sin(phase * u) if rng.random() < 0.5 else np.cos(phase * u) + np.cos(phase * v)
    return np.asarray(np.sign(wave) * (rng.uniform(0.4, 1.2) if rng.random() < 0.5 else 0.0))


def _wrinkles(rng: np.random.Generator) -> Cells:
    """Soft folds of a printed mat: long lines, bright on one side and dark on the other."""
    cells = np.zeros((_CELLS, _CELLS), np.float32)
    for _ in range(int(rng.integers(2, 7))):
        angle = rng.uniform(0.0, np.pi)
        path = _wander(angle + np.cumsum(rng.normal(0.0, 0.04, 60)), 6.0, rng)
        _wrapped_line(cells, path, 3.0, 4)
        _wrapped_line(cells, path + 5.0 * np.array([-np.sin(angle), np.cos(angle)]), -3.0, 4)
    # Wrapped, so that the blur of a fold continues at the opposite side.
    framed = cv2.copyMakeBorder(cells, 16, 16, 16, 16, cv2.BORDER_WRAP)
    return cv2.GaussianBlur(framed, (0, 0), 3.0)[16:-16, 16:-16].astype(np.float64)


def _blades(rng: np.random.Generator) -> Cells:
    """Short strokes of all directions and shades."""
    cells = np.zeros((_CELLS, _CELLS), np.float32)
    count = 9000
    start = rng.uniform(0.0, _CELLS, (count, 2))
    angle, length = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(3.0, 10.0, count)
    stroke = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for path, level in zip(
        np.stack([start, start + stroke], axis=1), rng.normal(0.0, 1.5, count), strict=True
    ):
        _wrapped_line(cells, path, float(level), 1)
    return cells.astype(np.float64)
