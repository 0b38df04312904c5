"""What stands and walks around the road: boxes, cones, walls, legs of people, cars; and their shadows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.world.render.appearance import Appearance
from datagen.world.render.compiled import COS, HALF_LENGTH, HALF_WIDTH, SIN, X, Y
from datagen.world.render.solids import BOX, CONE, CYLINDER, SHAPE, SOLID_COLUMNS, TOP
from datagen.world.road.track import Track

#: The last four numbers of a row: swing in x and y, its period and phase, see ``light.moved``.
_STILL = (0.0, 0.0, 1.0, 0.0)
#: How far beside the road's lines things stand at most and at least, and the longest shadow; chosen.
_BESIDE_CM = 120.0
_CLEAR_CM = 2.0
_LONGEST_SHADOW_CM = 100.0
# Colours, as things in garages and halls have them; chosen.
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
        solids: See :data:`datagen.world.render.solids.BOTTOM`; then the swing, see
            :func:`datagen.world.render.light.moved`.
        shadows: See :data:`datagen.world.render.light.SOFTNESS`; then the swing.
        light: cos and sin of the direction from which the light comes.
    """

    solids: Float[np.ndarray, "n 21"]
    shadows: Float[np.ndarray, "m 12"]
    light: Float[np.ndarray, "2"]


def place_objects(
    track: Track, look: Appearance, object_rng: np.random.Generator, shadow_rng: np.random.Generator
) -> Objects:
    """Place things beside the road, some partly on it, and shadows that move.

    Nothing stands where the car has to drive: the middle half of the driven lane stays free everywhere.
    """
    azimuth, self_cot = object_rng.uniform(0.0, 2.0 * np.pi), object_rng.uniform(0.4, 2.0)
    light = np.array([np.cos(azimuth), np.sin(azimuth)])
    offsets = [m.offset_cm for m in track.markings]
    half_cm = 0.5 * track.lane_width_cm
    borders = (min([-half_cm, *offsets]), max([half_cm, *offsets]))
    solids: list[list[float]] = []
    for _ in range(object_rng.poisson(look.objects_per_m * track.length_cm / 100.0)):
        # Each object has a stream of its own: one that finds no room does not change the others.
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
    """Draw one thing; an empty list if there is no room for it at the place that was drawn."""
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
    radius = max(
        float(np.hypot(row[X], row[Y]) + np.hypot(row[HALF_LENGTH], row[HALF_WIDTH])) for row in rows
    )
    swing = max(float(np.hypot(row[-4], row[-3])) for row in rows)
    border = borders[1] if side > 0.0 else -borders[0]
    half_cm = 0.5 * track.lane_width_cm
    if partly:
        offset = border + rng.uniform(-0.2 * half_cm, radius)
        free = 0.5 * half_cm + radius
    elif kind >= 0.55 and kind < 0.7:
        # A wall runs along the road: its thickness counts, not its length.
        offset = border + rng.uniform(15.0, _BESIDE_CM)
        free = half_cm + rows[0][HALF_WIDTH] + _CLEAR_CM
    else:
        offset = border + radius + swing + rng.uniform(_CLEAR_CM, _BESIDE_CM)
        free = half_cm + radius + swing + _CLEAR_CM
    place = track.beside(np.array([i]), side * offset)[0]
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
    """Whether a thing keeps clear of the driven lane, and of the whole road if it stands beside it."""
    # A long thing is probed along its length.
    half_cm = rows[0][HALF_LENGTH]
    reach = np.linspace(-half_cm, half_cm, 2 + int(half_cm / 10.0))
    extra_cm = free_cm - 0.5 * track.lane_width_cm
    for probe in place + reach[:, None] * np.array(rows[0][COS : SIN + 1]):
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
    """Whether the footprints of two solids may meet, as rectangles, wherever both swing."""
    dx, dy = one[X] - other[X], one[Y] - other[Y]
    swings = math.hypot(one[-4], one[-3]) + math.hypot(other[-4], other[-3])
    # On a long road nearly all are far from each other, which this finds quickly.
    reach = sum(math.hypot(row[HALF_LENGTH], row[HALF_WIDTH]) for row in (one, other))
    if math.hypot(dx, dy) > reach + swings:
        return False
    # Rectangles are apart if their projections on a side of one of them are.
    for c, s in (one[COS : SIN + 1], other[COS : SIN + 1]):
        for u, v in ((c, s), (-s, c)):
            if abs(u * dx + v * dy) > _half_span(one, u, v) + _half_span(other, u, v) + swings:
                return False
    return True


def _half_span(row: list[float], u: float, v: float) -> float:
    """Half the length of a solid's footprint along a direction of the map."""
    c, s, a, b = row[COS : HALF_WIDTH + 1]
    return abs(a * (c * u + s * v)) + abs(b * (c * v - s * u))


_Swing = tuple[float, float, float, float]


@dataclass(frozen=True)
class _Solid:
    """A solid beside a place, [cm]: size, colour, and a band of another colour.

    Attributes:
        size: Half length, half width, bottom, top.
        shape: One of ``BOX``, ``CYLINDER``, ``CONE``.
        colour: Nominal colour.
        angle: Direction of its length.
        at: Its middle, from the place.
        band: Colour, bottom and top of the band; none where the top is not above the bottom.
        swing: How it moves.
    """

    size: tuple[float, float, float, float]
    shape: float
    colour: Bgr
    angle: float = 0.0
    at: tuple[float, float] = (0.0, 0.0)
    band: tuple[Bgr, float, float] = (_DARK, 0.0, 0.0)
    swing: _Swing = _STILL

    def row(self, rng: np.random.Generator) -> list[float]:
        """Return its numbers; the brightness varies a little."""
        tint = np.clip(np.array(self.colour[:3]) * rng.uniform(0.75, 1.2), 0.0, 255.0)
        band_bgr, *band = self.band
        direction = np.cos(self.angle), np.sin(self.angle)
        return [*self.at, *direction, *self.size, self.shape, *tint, *band_bgr, *band, *self.swing]


def _pick(colours: tuple[Bgr, ...], rng: np.random.Generator) -> Bgr:
    return colours[int(rng.integers(len(colours)))]


def _box(rng: np.random.Generator, scale: float) -> list[list[float]]:
    a, b = rng.uniform(6.0, 28.0) * scale, rng.uniform(5.0, 20.0) * scale
    high = rng.uniform(6.0, 45.0) * scale
    middle = rng.uniform(0.3, 0.8) * high
    band = (_pick(_CARDBOARD, rng), middle, middle + rng.uniform(-0.3, 0.25) * high)
    colour, angle = _pick(_CARDBOARD, rng), rng.uniform(0.0, np.pi)
    return [_Solid((a, b, 0.0, high), BOX, colour, angle, band=band).row(rng)]


def _cone(rng: np.random.Generator) -> list[list[float]]:
    high = rng.uniform(8.0, 30.0)
    radius = high * rng.uniform(0.25, 0.4)
    colour = _ORANGE if rng.random() < 0.6 else _pick(_PAINTED, rng)
    band = (_WHITE, 0.35 * high, 0.6 * high) if rng.random() < 0.6 else (_DARK, 0.0, 0.0)
    foot = _Solid((radius * 1.1, radius * 1.1, 0.0, 0.06 * high), BOX, colour, rng.uniform(0.0, np.pi))
    return [foot.row(rng), _Solid((radius, radius, 0.0, high), CONE, colour, band=band).row(rng)]


def _wall(rng: np.random.Generator, heading: float) -> list[list[float]]:
    size = (rng.uniform(40.0, 150.0), rng.uniform(1.0, 6.0), 0.0, rng.uniform(10.0, 60.0))
    skirting = (_pick(_WALLS, rng), -1.0, rng.uniform(-8.0, 8.0))
    angle = heading + rng.uniform(-0.25, 0.25)
    return [_Solid(size, BOX, _pick(_WALLS, rng), angle, band=skirting).row(rng)]


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
        rows.append(_Solid((13.0, 4.5, 0.0, 6.0), BOX, shoe, angle, toe, swing=swing).row(rng))
        rows.append(_Solid((radius, radius, 5.0, 90.0), CYLINDER, colour, 0.0, at, swing=swing).row(rng))
    return rows


def _car(rng: np.random.Generator, heading: float) -> list[list[float]]:
    """A car of our own kind: body on dark wheels, cabin."""
    angle, colour = heading + rng.uniform(-0.4, 0.4), _pick(_PAINTED, rng)
    wheels = _Solid((15.0, 9.5, 0.0, 5.0), BOX, _DARK, angle)
    body = _Solid((20.0, 8.5, 3.0, 9.0), BOX, colour, angle)
    cabin = _Solid((9.0, 7.0, 9.0, 15.0), BOX, colour, angle, band=(_DARK, 10.0, 13.5))
    return [wheels.row(rng), body.row(rng), cabin.row(rng)]


def _cast(row: list[float], light: Float[np.ndarray, "2"], cot: float, depth: float) -> list[float]:
    """Shadow of a solid: a strip from its foot away from the light, softer the longer it is."""
    x, y, c, s, half_a, half_b, _, top = row[: TOP + 1]
    # How wide and how deep the footprint is across and along the light.
    across = abs(half_a * (c * light[1] - s * light[0])) + abs(half_b * (c * light[0] + s * light[1]))
    within = abs(half_a * (c * light[0] + s * light[1])) + abs(half_b * (c * light[1] - s * light[0]))
    if row[SHAPE] != BOX:
        across = within = half_a
    if row[SHAPE] == CONE:
        across *= 0.6
    length = min(top * cot, _LONGEST_SHADOW_CM)
    middle = np.array([x, y]) - 0.5 * length * light
    soft = 1.5 + 0.12 * length
    return [*middle, *light, 0.5 * length + within, across, soft, depth, *row[-4:]]


def _person_shadow(track: Track, depth: float, rng: np.random.Generator) -> list[list[float]]:
    """Shadow of someone who walks about, out of the picture: legs, body and head."""
    i, offset = int(rng.integers(len(track.s_cm))), rng.uniform(-80.0, 80.0)
    place = track.beside(np.array([i]), offset)[0]
    angle, walk_angle = rng.uniform(0.0, 2.0 * np.pi, 2)
    c, s = np.cos(angle), np.sin(angle)
    walk = rng.uniform(0.0, 120.0)
    period, phase = rng.uniform(40.0, 200.0), rng.uniform(0.0, 6.3)
    swing = (walk * np.cos(walk_angle), walk * np.sin(walk_angle), period, phase)
    scale, soft, dark = rng.uniform(0.6, 1.3), rng.uniform(2.0, 14.0), depth * rng.uniform(0.6, 1.0)
    rows = []
    # Along the shadow, across it, half length, half width: two legs, body, head.
    for along, across, a, b in ((0, -9, 35, 6), (0, 9, 35, 6), (60, 0, 30, 20), (102, 0, 12, 9)):
        at = place + scale * np.array([along * c - across * s, along * s + across * c])
        rows.append([*at, c, s, scale * a, scale * b, soft, dark, *swing])
    return rows
