"""What stands and walks around the road: boxes, cones, walls, people's legs, other cars; and shadows.

What lies about in numbers: specks, figures printed beside the road, lights mirrored from further away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.world.render.look import LookSettings
from datagen.world.render.solids import BOX, CONE, CYLINDER, SOLID_COLUMNS
from datagen.world.road.track import Track

_STILL = (0.0, 0.0, 1.0, 0.0)  # swing in x and y, its period and phase, see datagen.world.render.light.moved
_BESIDE_CM = 120.0
_CLEAR_CM = 2.0
_LONGEST_SHADOW_CM = 100.0
_CARDBOARD = ((110.0, 150.0, 185.0), (90.0, 125.0, 160.0), (205.0, 205.0, 205.0), (60.0, 60.0, 65.0))
_CLOTH = ((60.0, 45.0, 40.0), (110.0, 80.0, 50.0), (45.0, 45.0, 45.0), (130.0, 135.0, 140.0))
_PAINTED = ((40.0, 40.0, 190.0), (160.0, 90.0, 30.0), (60.0, 150.0, 60.0), (45.0, 190.0, 220.0), (35.0,) * 3)
_WALLS = ((190.0, 195.0, 200.0), (120.0, 120.0, 125.0), (45.0, 45.0, 150.0), (90.0, 110.0, 140.0))
_ORANGE, _WHITE, _DARK = (40.0, 110.0, 235.0), (230.0, 230.0, 230.0), (30.0, 30.0, 30.0)

Bgr = tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Objects:
    """Things above the floor of one drive, and the shadows on it, frame map.

    Attributes:
        solids: See :data:`datagen.world.render.solids.SOLID_COLUMNS`, then the swing, see
            :func:`datagen.world.render.light.moved`.
        shadows: x, y, cos and sin of the direction, half length, half width, softness, depth, then the swing.
        light: cos and sin of the direction from which the light comes.
    """

    solids: Float[np.ndarray, "n 21"]
    shadows: Float[np.ndarray, "m 12"]
    light: Float[np.ndarray, "2"]


def place_objects(
    track: Track, look: LookSettings, object_rng: np.random.Generator, shadow_rng: np.random.Generator
) -> Objects:
    """Set things up beside the road, and some partly on it, and let shadows wander.

    Nothing stands where the car has to drive: the middle half of the driven lane stays free everywhere.
    """
    azimuth, self_cot = object_rng.uniform(0.0, 2.0 * np.pi), object_rng.uniform(0.4, 2.0)
    light = np.array([np.cos(azimuth), np.sin(azimuth)])
    offsets = [m.offset_cm for m in track.markings]
    half_cm = 0.5 * track.lane_width_cm
    borders = (min([-half_cm, *offsets]), max([half_cm, *offsets]))
    solids: list[list[float]] = []
    for _ in range(object_rng.poisson(look.objects_per_m * track.length_cm / 100.0)):
        # Each object has a stream of its own, so that one that finds no room leaves the others as they are.
        rows = _object(track, borders, look.objects_on_road, object_rng.spawn(1)[0])
        if not any(_overlap(row, other) for row in rows for other in solids):
            solids += rows
    shadows = [_cast(row, light, self_cot, look.shadow_depth) for row in solids]
    for _ in range(shadow_rng.poisson(look.shadows_per_m * track.length_cm / 100.0)):
        shadows += _person_shadow(track, look.shadow_depth, shadow_rng.spawn(1)[0])
    return Objects(
        solids=np.array(solids, dtype=np.float64).reshape(-1, SOLID_COLUMNS + 4),
        shadows=np.array(shadows, dtype=np.float64).reshape(-1, 12),
        light=light,
    )


def _object(
    track: Track, borders: tuple[float, float], on_road: float, rng: np.random.Generator
) -> list[list[float]]:
    """Draw one thing; nothing if there is no room for it where it was to stand."""
    i, side = int(rng.integers(len(track.s_cm))), 1.0 if rng.random() < 0.5 else -1.0
    kind = float(rng.random())
    partly = bool(rng.random() < on_road)
    heading = float(track.heading_rad[i])
    if partly:
        rows = _box(rng, 0.35) if kind < 0.5 else _cone(rng)
    elif kind < 0.35:
        rows = _box(rng, 1.0)
    elif kind < 0.55:
        rows = _cone(rng)
    elif kind < 0.7:
        rows = _wall(rng, heading)
    elif kind < 0.85:
        rows = _legs(rng)
    else:
        rows = _car(rng, heading)
    radius = max(float(np.hypot(row[0], row[1]) + np.hypot(row[4], row[5])) for row in rows)
    swing = max(float(np.hypot(row[-4], row[-3])) for row in rows)
    border = borders[1] if side > 0.0 else -borders[0]
    half_cm = 0.5 * track.lane_width_cm
    if partly:
        offset = border + rng.uniform(-0.2 * half_cm, radius)
        free = 0.5 * half_cm + radius
    elif kind >= 0.55 and kind < 0.7:
        # A wall runs along the road: its thickness counts, not its length.
        offset = border + rng.uniform(15.0, _BESIDE_CM)
        free = half_cm + rows[0][5] + _CLEAR_CM
    else:
        offset = border + radius + swing + rng.uniform(_CLEAR_CM, _BESIDE_CM)
        free = half_cm + radius + swing + _CLEAR_CM
    place = track.xy_cm[i] + side * offset * np.array([-np.sin(heading), np.cos(heading)])
    if not _has_room(track, place, rows, free, borders, partly):
        return []
    return [[row[0] + place[0], row[1] + place[1], *row[2:]] for row in rows]


def _has_room(
    track: Track,
    place: Float[np.ndarray, "2"],
    rows: list[list[float]],
    free_cm: float,
    borders: tuple[float, float],
    partly: bool,
) -> bool:
    """Whether a thing keeps clear of the driven lane, and of the whole road if it is to stand beside it."""
    # A long thing is probed along its length.
    reach = np.linspace(-rows[0][4], rows[0][4], 2 + int(rows[0][4] / 10.0))
    extra_cm = free_cm - 0.5 * track.lane_width_cm
    for probe in place + reach[:, None] * np.array(rows[0][2:4]):
        gap = probe - track.xy_cm
        k = int(np.argmin(np.einsum("ij,ij->i", gap, gap)))
        c, s = np.cos(track.heading_rad[k]), np.sin(track.heading_rad[k])
        ahead, left = float(c * gap[k, 0] + s * gap[k, 1]), float(c * gap[k, 1] - s * gap[k, 0])
        if np.hypot(ahead, left) < free_cm:
            return False
        past_the_end = abs(ahead) > 5.0
        if not partly and not past_the_end and borders[0] - extra_cm < left < borders[1] + extra_cm:
            return False
    return True


def _overlap(one: list[float], other: list[float]) -> bool:
    """Whether the footprints of two solids meet, as rectangles and wherever they swing to."""
    dx, dy = one[0] - other[0], one[1] - other[1]
    swings = math.hypot(one[-4], one[-3]) + math.hypot(other[-4], other[-3])
    # On a long road nearly all are far from each other, and this is all that is looked at.
    if math.hypot(dx, dy) > math.hypot(one[4], one[5]) + math.hypot(other[4], other[5]) + swings:
        return False
    # Rectangles are apart if, seen along a side of one of them, their shadows are.
    for c, s in (one[2:4], other[2:4]):
        for u, v in ((c, s), (-s, c)):
            if abs(u * dx + v * dy) > _half_span(one, u, v) + _half_span(other, u, v) + swings:
                return False
    return True


def _half_span(row: list[float], u: float, v: float) -> float:
    """Half the length of a solid's footprint along a direction of the map."""
    c, s, a, b = row[2:6]
    return abs(a * (c * u + s * v)) + abs(b * (c * v - s * u))


def _row(
    size: tuple[float, float, float, float],
    shape: float,
    colour: Bgr,
    rng: np.random.Generator,
    angle: float = 0.0,
    at: tuple[float, float] = (0.0, 0.0),
    band: tuple[Bgr, float, float] = (_DARK, 0.0, 0.0),
    swing: tuple[float, float, float, float] = _STILL,
) -> list[float]:
    """Numbers of a solid: ``size`` is half length, half width, bottom, top; colours vary a little."""
    tint = np.clip(np.array(colour[:3]) * rng.uniform(0.75, 1.2), 0.0, 255.0)
    return [*at, np.cos(angle), np.sin(angle), *size, shape, *tint, *band[0], band[1], band[2], *swing]


def _pick(colours: tuple[Bgr, ...], rng: np.random.Generator) -> Bgr:
    return colours[int(rng.integers(len(colours)))]


def _box(rng: np.random.Generator, scale: float) -> list[list[float]]:
    a, b, high = (
        rng.uniform(6.0, 28.0) * scale,
        rng.uniform(5.0, 20.0) * scale,
        rng.uniform(6.0, 45.0) * scale,
    )
    middle = rng.uniform(0.3, 0.8) * high
    band = (_pick(_CARDBOARD, rng), middle, middle + rng.uniform(-0.3, 0.25) * high)
    return [_row((a, b, 0.0, high), BOX, _pick(_CARDBOARD, rng), rng, rng.uniform(0.0, np.pi), band=band)]


def _cone(rng: np.random.Generator) -> list[list[float]]:
    high = rng.uniform(8.0, 30.0)
    radius = high * rng.uniform(0.25, 0.4)
    colour = _ORANGE if rng.random() < 0.6 else _pick(_PAINTED, rng)
    band = (_WHITE, 0.35 * high, 0.6 * high) if rng.random() < 0.6 else (_DARK, 0.0, 0.0)
    foot = _row((radius * 1.1, radius * 1.1, 0.0, 0.06 * high), BOX, colour, rng, rng.uniform(0.0, np.pi))
    return [foot, _row((radius, radius, 0.0, high), CONE, colour, rng, band=band)]


def _wall(rng: np.random.Generator, heading: float) -> list[list[float]]:
    size = (rng.uniform(40.0, 150.0), rng.uniform(1.0, 6.0), 0.0, rng.uniform(10.0, 60.0))
    skirting = (_pick(_WALLS, rng), -1.0, rng.uniform(-8.0, 8.0))
    angle = heading + rng.uniform(-0.25, 0.25)
    return [_row(size, BOX, _pick(_WALLS, rng), rng, angle, band=skirting)]


def _legs(rng: np.random.Generator) -> list[list[float]]:
    """Two legs in shoes, standing or walking to and fro."""
    angle, apart = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(7.0, 14.0)
    c, s = np.cos(angle), np.sin(angle)
    walk = rng.uniform(20.0, 80.0) if rng.random() < 0.5 else 0.0
    period, phase = rng.uniform(60.0, 200.0), rng.uniform(0.0, 2.0 * np.pi)
    radius, colour, shoe = rng.uniform(4.5, 8.0), _pick(_CLOTH, rng), _pick((*_CLOTH, _WHITE), rng)
    rows = []
    for side in (-1.0, 1.0):
        swing = (walk * c, walk * s, period, phase + 0.25 * side)
        at = (-side * apart * s, side * apart * c)
        toe = (at[0] + 5.0 * c, at[1] + 5.0 * s)
        rows.append(_row((13.0, 4.5, 0.0, 6.0), BOX, shoe, rng, angle, toe, swing=swing))
        rows.append(_row((radius, radius, 5.0, 90.0), CYLINDER, colour, rng, 0.0, at, swing=swing))
    return rows


def _car(rng: np.random.Generator, heading: float) -> list[list[float]]:
    """A car of our own kind: body on dark wheels, cabin."""
    angle, colour = heading + rng.uniform(-0.4, 0.4), _pick(_PAINTED, rng)
    swing = _STILL
    wheels = _row((15.0, 9.5, 0.0, 5.0), BOX, _DARK, rng, angle, swing=swing)
    body = _row((20.0, 8.5, 3.0, 9.0), BOX, colour, rng, angle, swing=swing)
    cabin = _row((9.0, 7.0, 9.0, 15.0), BOX, colour, rng, angle, band=(_DARK, 10.0, 13.5), swing=swing)
    return [wheels, body, cabin]


def _cast(row: list[float], light: Float[np.ndarray, "2"], cot: float, depth: float) -> list[float]:
    """Shadow of a solid: a strip from its foot away from the light, softer the longer it is."""
    x, y, c, s, half_a, half_b, _, top = row[:8]
    # How wide and how deep the footprint is across and along the light.
    across = abs(half_a * (c * light[1] - s * light[0])) + abs(half_b * (c * light[0] + s * light[1]))
    within = abs(half_a * (c * light[0] + s * light[1])) + abs(half_b * (c * light[1] - s * light[0]))
    if row[8] != BOX:
        across = within = half_a
    if row[8] == CONE:
        across *= 0.6
    length = min(top * cot, _LONGEST_SHADOW_CM)
    middle = np.array([x, y]) - 0.5 * length * light
    soft = 1.5 + 0.12 * length
    return [*middle, *light, 0.5 * length + within, across, soft, depth, *row[-4:]]


def _person_shadow(track: Track, depth: float, rng: np.random.Generator) -> list[list[float]]:
    """Shadow of someone who walks about, out of sight: legs and body in a row."""
    i, offset = int(rng.integers(len(track.s_cm))), rng.uniform(-80.0, 80.0)
    heading = float(track.heading_rad[i])
    place = track.xy_cm[i] + offset * np.array([-np.sin(heading), np.cos(heading)])
    angle, walk_angle = rng.uniform(0.0, 2.0 * np.pi, 2)
    c, s = np.cos(angle), np.sin(angle)
    walk = rng.uniform(0.0, 120.0)
    swing = (
        walk * np.cos(walk_angle),
        walk * np.sin(walk_angle),
        rng.uniform(40.0, 200.0),
        rng.uniform(0.0, 6.3),
    )
    scale, soft, dark = rng.uniform(0.6, 1.3), rng.uniform(2.0, 14.0), depth * rng.uniform(0.6, 1.0)
    rows = []
    # Along the shadow, across it, half length, half width: two legs, body, head.
    for along, across, a, b in ((0, -9, 35, 6), (0, 9, 35, 6), (60, 0, 30, 20), (102, 0, 12, 9)):
        at = place + scale * np.array([along * c - across * s, along * s + across * c])
        rows.append([*at, c, s, scale * a, scale * b, soft, dark, *swing])
    return rows


_SPECKS_BESIDE_CM = 90.0
_PRINTS_BESIDE_CM = 90.0
_GLINTS_BESIDE_CM = 450.0
_SCATTER_CLEAR_CM = 4.0  # between the outermost lines and what is printed beside the road


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
    if not _is_beside(track, place, radius_cm + _SCATTER_CLEAR_CM):
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
