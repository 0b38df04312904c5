"""What lies about in numbers: specks, figures printed beside the road, lights mirrored from further away."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from datagen.world.road import Track

_SPECKS_BESIDE_CM = 90.0
_PRINTS_BESIDE_CM = 90.0
_GLINTS_BESIDE_CM = 450.0
_CLEAR_CM = 4.0  # between the outermost lines and what is printed beside the road


def places_beside(
    track: Track, per_m: float, beside_cm: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 2"]:
    """Draw random places within ``beside_cm`` of the centre line, [cm], frame map."""
    n = int(rng.poisson(per_m * track.length_cm / 100.0))
    i = rng.integers(len(track.s_cm), size=n)
    offset_cm = rng.uniform(-beside_cm, beside_cm, n)
    heading = track.heading_rad[i]
    return track.xy_cm[i] + offset_cm[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def specks(
    track: Track, per_m: float, floor_bgr: tuple[float, float, float], rng: np.random.Generator
) -> Float[np.ndarray, "n 9"]:
    """Draw crumbs, chips, drops: small, brighter or darker than the floor; columns of ``Scene.clutter``."""
    places = places_beside(track, per_m, _SPECKS_BESIDE_CM, rng)
    n = len(places)
    angle = rng.uniform(0.0, np.pi, n)
    half_cm = np.stack([0.5 * 0.4 * 8.0 ** rng.random(n), 0.5 * 0.4 * 4.0 ** rng.random(n)], axis=1)
    change = rng.uniform(25.0, 110.0, n) * np.where(rng.random(n) < 0.6, 1.0, -1.0)
    colour = np.clip(np.asarray(floor_bgr) + change[:, None] + rng.uniform(-10.0, 10.0, (n, 3)), 0.0, 255.0)
    return np.column_stack([places, np.cos(angle), np.sin(angle), half_cm, colour])


def prints(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "n 9"]:
    """Draw what is printed on a mat beside its road, or painted there: areas, stripes and rows of strokes.

    All of it stays clear of the outermost lines, so that it can be taken for a line, but hides none.

    Args:
        track: The road.
        per_m: Figures per metre of road, before those that find no room.
        rng: Source of randomness.

    Returns:
        Rectangles, columns of ``Scene.clutter``.
    """
    places = places_beside(track, per_m, _PRINTS_BESIDE_CM, rng)
    rows: list[list[float]] = []
    for place in places:
        # Each figure has a stream of its own: one that finds no room leaves the others as they are.
        rows += _figure(track, place, rng.spawn(1)[0])
    return np.array(rows, dtype=np.float64).reshape(-1, 9)


def _figure(track: Track, place: Float[np.ndarray, "2"], rng: np.random.Generator) -> list[list[float]]:
    angle = float(rng.uniform(0.0, 2.0 * np.pi))
    if rng.random() < 0.5:
        light = rng.uniform(170.0, 235.0)
        colour = np.clip(light + rng.uniform(-12.0, 12.0, 3), 0.0, 255.0)
    else:
        colour = rng.uniform(30.0, 220.0, 3)
    kind = rng.random()
    if kind < 0.4:
        shapes = [(0.0, 0.0, rng.uniform(5.0, 30.0), rng.uniform(4.0, 18.0))]
    elif kind < 0.65:
        shapes = [(0.0, 0.0, rng.uniform(12.0, 40.0), rng.uniform(0.8, 3.0))]
    else:
        count, pitch, long, thick = int(rng.integers(3, 8)), *rng.uniform([3.0, 2.5, 0.4], [8.0, 9.0, 1.6])
        shapes = [
            (pitch * (k - 0.5 * (count - 1)), rng.uniform(-1.0, 1.0), thick, long * rng.uniform(0.5, 1.0))
            for k in range(count)
        ]
    radius_cm = max(float(np.hypot(a, b) + np.hypot(p, q)) for a, b, p, q in shapes)
    if not _is_beside(track, place, radius_cm + _CLEAR_CM):
        return []
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [
        [place[0] + a * c - b * s, place[1] + a * s + b * c, c, s, p, q, *colour] for a, b, p, q in shapes
    ]


def _is_beside(track: Track, place: Float[np.ndarray, "2"], clear_cm: float) -> bool:
    """Whether a place keeps this far from the road, all of its lines and lanes."""
    half_cm = 0.5 * track.lane_width_cm
    lines_cm = [m.offset_cm + 0.5 * side * m.width_cm for m in track.markings for side in (-1.0, 1.0)]
    low, high = min([-half_cm, *lines_cm]), max([half_cm, *lines_cm])
    gap = place - track.xy_cm
    c, s = np.cos(track.heading_rad), np.sin(track.heading_rad)
    ahead, left = c * gap[:, 0] + s * gap[:, 1], c * gap[:, 1] - s * gap[:, 0]
    outside = np.maximum(np.maximum(low - left, left - high), 0.0)
    return bool(np.all(np.hypot(ahead, outside) >= clear_cm))


def glints(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "n 4"]:
    """Draw lights that shine in low over the floor from all over the room; columns of ``Scene.lamps``.

    Lamps overhead are mirrored at the car's feet. Windows, lit walls and lamps far away are mirrored on the
    road ahead, as small spots drawn out towards the camera.
    """
    places = places_beside(track, per_m, _GLINTS_BESIDE_CM, rng)
    n = len(places)
    height_cm = 25.0 * 8.0 ** rng.random(n)
    size_rad = 0.006 * 6.0 ** rng.random(n)
    return np.column_stack([places, height_cm, size_rad])
