"""Edges of painted markings beside a path, as the frames of a drive see them."""

from __future__ import annotations

import numpy as np

from datagen.lanes.path import Path, PathEdges

STEP_CM = 1.8
FRAME_CM = 3.0


def arc_path(radius_cm: float | None, length_cm: float = 500.0) -> Path:
    """An open path of constant curvature to the left."""
    s = np.arange(0.0, length_cm, STEP_CM)
    heading = np.zeros_like(s) if radius_cm is None else s / radius_cm
    xy = np.column_stack([s, np.zeros_like(s)])
    if radius_cm is not None:
        xy = radius_cm * np.column_stack([np.sin(heading), 1.0 - np.cos(heading)])
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    return Path(STEP_CM, xy, left, np.arange(0.0, length_cm - 75.0, FRAME_CM))


def ring_path(radius_cm: float, laps: int = 2) -> Path:
    """A closed circle, driven counter-clockwise."""
    count = round(2.0 * np.pi * radius_cm / STEP_CM)
    angle = 2.0 * np.pi * np.arange(count) / count
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    step = 2.0 * np.pi * radius_cm / count
    frames = np.mod(np.arange(0.0, laps * count * step, FRAME_CM), count * step)
    nothing = np.zeros(len(frames))
    return Path(step, radius_cm * out, -out, frames, nothing, nothing == 0.0, closed=True)


def paint(
    rng: np.random.Generator,
    path: Path,
    middle_cm: np.ndarray,
    seen: np.ndarray,
    tape_cm: float = 2.4,
    noise_cm: float = 0.1,
    pass_noise_cm: float = 0.0,
    passes: int = 1,
    borders: tuple[float, ...] = (1.0, -1.0),
) -> PathEdges:
    """Both borders of a marking, seen by twelve frames of some passes; ten frames may err in common."""
    rows = np.repeat(np.flatnonzero(seen), 12)
    frame = (rows * path.step_cm / FRAME_CM).astype(np.int64) + rng.integers(-10, 1, len(rows))
    frame = np.maximum(frame, 0) + 1000 * rng.integers(0, passes, len(rows))
    slope = np.gradient(middle_cm) / path.step_cm
    common = pass_noise_cm * rng.normal(size=frame.max(initial=0) // 10 + 1)
    parts = []
    for border in borders:
        s = np.clip((rows + rng.uniform(-0.4, 0.4, len(rows))) * path.step_cm, 0.0, path.s_cm[-1])
        d = np.interp(s, path.s_cm, middle_cm) + 0.5 * border * tape_cm
        d = d + noise_cm * rng.normal(size=len(rows)) + common[frame // 10]
        side = -border / np.hypot(1.0, slope[rows])
        near = np.full(len(rows), 15.0)
        parts.append((s, d, side, -side * slope[rows], np.ones(len(rows)), near, frame))
    return PathEdges(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def joined(*parts: PathEdges) -> PathEdges:
    """Edges of several markings."""
    names = ("s_cm", "d_cm", "side", "along", "weight", "distance_cm", "frame")
    return PathEdges(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def speckle(rng: np.random.Generator, path: Path, count: int) -> PathEdges:
    """Edges of all directions anywhere."""
    turn = rng.uniform(-np.pi, np.pi, count)
    s, d = rng.uniform(0.0, path.s_cm[-1], count), rng.uniform(-100.0, 100.0, count)
    frame = (s / FRAME_CM).astype(np.int64)
    return PathEdges(s, d, np.cos(turn), np.sin(turn), np.ones(count), np.full(count, 15.0), frame)
