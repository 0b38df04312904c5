"""The surroundings of one drive: the floor, lamps, what lies about, the room, and things that stand in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from datagen.world.render.appearance import Appearance
from datagen.world.render.compiled import COS, HALF_LENGTH, HALF_WIDTH, SIN, X, Y
from datagen.world.render.solids import BOX, CONE, CYLINDER, SHAPE, SOLID_COLUMNS, TOP
from datagen.world.render.textures import cracks, floor_pattern, level_starts, noise, pack_levels, stains
from datagen.world.road.track import Bgr, Track

#: Size of the picture of the walls: a column is 0.7 degrees, about a pixel.
_ROOM_COLUMNS, _ROOM_ROWS = 512, 64
#: How far from the centre line things lie and shine, as far as a camera of that height may see them; chosen.
_LAMPS_BESIDE_CM, _GLINTS_BESIDE_CM = 150.0, 450.0
_CLUTTER_BESIDE_CM, _SPECKS_BESIDE_CM, _PRINTS_BESIDE_CM = 70.0, 90.0, 90.0
#: Between the outermost lines and what is printed beside the road: no print hides a line or joins one.
_CLEAR_CM = 4.0
#: Paper, tape, cable, packaging; chosen.
_CLUTTER_BGR = np.array(
    [
        [225, 225, 225],
        [200, 200, 205],
        [60, 60, 60],
        [30, 30, 35],
        [60, 60, 190],
        [170, 90, 40],
        [90, 160, 190],
    ]
)
#: The last four numbers of a row: swing in x and y, its period and phase, see ``light.moved``.
_STILL = (0.0, 0.0, 1.0, 0.0)
#: How far beside the road's lines things stand at most and at least, and the longest shadow; chosen.
_OBJECTS_BESIDE_CM = 120.0
_OBJECTS_CLEAR_CM = 2.0
_LONGEST_SHADOW_CM = 100.0
# Colours, as things in garages and halls have them; chosen.
_CARDBOARD = ((110.0, 150.0, 185.0), (90.0, 125.0, 160.0), (205.0, 205.0, 205.0), (60.0, 60.0, 65.0))
_CLOTH = ((60.0, 45.0, 40.0), (110.0, 80.0, 50.0), (45.0, 45.0, 45.0), (130.0, 135.0, 140.0))
_PAINTED = (
    (40.0, 40.0, 190.0),
    (160.0, 90.0, 30.0),
    (60.0, 150.0, 60.0),
    (45.0, 190.0, 220.0),
    (35.0, 35.0, 35.0),
)
_WALLS = ((190.0, 195.0, 200.0), (120.0, 120.0, 125.0), (45.0, 45.0, 150.0), (90.0, 110.0, 140.0))
_ORANGE, _WHITE, _DARK = (40.0, 110.0, 235.0), (230.0, 230.0, 230.0), (30.0, 30.0, 30.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """The fixed surroundings of one drive, frame map.

    Attributes:
        texture: The floor's pattern, of unit variance, see :func:`datagen.world.render.textures.pack_levels`.
        wear: The pattern by which paint wears off, in the same way.
        joint_rad: Direction of the floor's joints and grains.
        joint_shift_cm: Where the joints start.
        lamps: x, y, height above the floor, angular size, [cm], [rad].
        clutter: Flat rectangles, see :data:`datagen.world.render.compiled.BLUE`.
        room: The walls, rows of elevation (0..90 degrees, from the floor up) by columns of azimuth; the
            colours are padded to four values.
        objects: Things above the floor, and shadows on it.
    """

    texture: Float32[np.ndarray, "packed"]
    wear: Float32[np.ndarray, "packed"]
    joint_rad: float
    joint_shift_cm: Float[np.ndarray, "2"]
    lamps: Float[np.ndarray, "lamps 4"]
    clutter: Float[np.ndarray, "things 9"]
    room: Float32[np.ndarray, "r c 4"]
    objects: Objects


def build_scene(track: Track, appearance: Appearance, rng: np.random.Generator) -> Scene:
    """Draw the surroundings; each part has its own child of ``rng``, so that none changes another."""
    # The order is part of the format: a new part of the scene takes a new child at the end.
    texture_rng, joint_rng, lamp_rng, clutter_rng, room_rng, object_rng, shadow_rng = rng.spawn(7)
    speck_rng, print_rng, glint_rng = rng.spawn(3)
    lamps = _lamps(track, appearance.lamps_per_m, lamp_rng) * [1.0, 1.0, 1.0, appearance.lamp_size]
    clutter = [
        prints(track, appearance.prints_per_m, print_rng),
        _clutter(track, appearance.clutter_per_m, clutter_rng),
        specks(track, appearance.specks_per_m, appearance.floor_bgr, speck_rng),
    ]
    texture, wear = _textures(appearance, texture_rng)
    return Scene(
        texture=texture,
        wear=wear,
        joint_rad=float(joint_rng.uniform(0.0, np.pi)),
        joint_shift_cm=joint_rng.uniform(0.0, 100.0, 2),
        lamps=np.concatenate([lamps, glints(track, appearance.glints_per_m, glint_rng)]),
        clutter=np.concatenate(clutter),
        room=_room(appearance.wall_level, room_rng),
        objects=place_objects(track, appearance, object_rng, shadow_rng),
    )


def _textures(
    appearance: Appearance, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "packed"], Float32[np.ndarray, "packed"]]:
    """Pattern of the floor and of the wear; zeros where neither is seen."""
    if appearance.texture_level == 0.0 and appearance.line_wear == 0.0:
        return (np.zeros(level_starts()[-1], np.float32),) * 2
    kind_rng, stain_rng, crack_rng = rng.spawn(3)
    worn = noise(appearance.texture_scale_cm, appearance.texture_stretch, rng)
    wear = pack_levels(worn)
    if appearance.texture_level == 0.0:
        return wear, wear
    pattern = worn
    if appearance.floor != "plain":
        pattern = floor_pattern(
            appearance.floor, appearance.texture_scale_cm, appearance.texture_stretch, kind_rng
        )
    # The pattern has the unit of the texture level.
    if appearance.stain_level:
        pattern = pattern + appearance.stain_level / appearance.texture_level * stains(stain_rng)
    if appearance.crack_level:
        pattern = pattern - appearance.crack_level / appearance.texture_level * cracks(crack_rng)
    return (wear, wear) if pattern is worn else (pack_levels(pattern), wear)


def _lamps(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "lamps 4"]:
    places = _places_beside(track, per_m, _LAMPS_BESIDE_CM, rng)
    height_cm = rng.uniform(150.0, 300.0, len(places))
    size_rad = rng.uniform(0.03, 0.1, len(places))
    return np.concatenate([places, height_cm[:, None], size_rad[:, None]], axis=1)


def _clutter(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "things 9"]:
    places = _places_beside(track, per_m, _CLUTTER_BESIDE_CM, rng)
    n = len(places)
    angle = rng.uniform(0.0, np.pi, n)
    strip = rng.random(n) < 0.5
    length = np.where(strip, rng.uniform(4.0, 35.0, n), rng.uniform(2.0, 14.0, n))
    width = np.where(strip, rng.uniform(0.6, 4.0, n), rng.uniform(2.0, 14.0, n))
    colour = _CLUTTER_BGR[rng.integers(len(_CLUTTER_BGR), size=n)] + rng.uniform(-20.0, 20.0, (n, 3))
    shape = np.stack([np.cos(angle), np.sin(angle), 0.5 * length, 0.5 * width], axis=1)
    return np.concatenate([places, shape, np.clip(colour, 0.0, 255.0)], axis=1)


def _places_beside(
    track: Track, per_m: float, beside_cm: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 2"]:
    """Draw random places within ``beside_cm`` of the centre line, [cm], frame map."""
    n = int(rng.poisson(per_m * track.length_cm / 100.0))
    i = rng.integers(len(track.s_cm), size=n)
    return track.beside(i, rng.uniform(-beside_cm, beside_cm, n))


def specks(track: Track, per_m: float, floor_bgr: Bgr, rng: np.random.Generator) -> Float[np.ndarray, "n 9"]:
    """Draw crumbs, chips and drops, brighter or darker than the floor, as rows of ``Scene.clutter``."""
    places = _places_beside(track, per_m, _SPECKS_BESIDE_CM, rng)
    n = len(places)
    angle = rng.uniform(0.0, np.pi, n)
    half_cm = np.stack([0.5 * 0.4 * 8.0 ** rng.random(n), 0.5 * 0.4 * 4.0 ** rng.random(n)], axis=1)
    change = rng.uniform(25.0, 110.0, n) * np.where(rng.random(n) < 0.6, 1.0, -1.0)
    colour = np.clip(np.asarray(floor_bgr) + change[:, None] + rng.uniform(-10.0, 10.0, (n, 3)), 0.0, 255.0)
    return np.column_stack([places, np.cos(angle), np.sin(angle), half_cm, colour])


def prints(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "n 9"]:
    """Draw what is printed on a mat beside its road: areas, stripes and rows of strokes.

    It may be mistaken for a line, but stays clear of the outermost lines and hides none.

    Args:
        track: The road.
        per_m: Figures per metre of road; some of them find no room.
        rng: Source of randomness.

    Returns:
        Rows of ``Scene.clutter``.
    """
    places = _places_beside(track, per_m, _PRINTS_BESIDE_CM, rng)
    # Each figure has a stream of its own: one that finds no room does not change the others.
    rows = [row for place in places for row in _figure(track, place, rng.spawn(1)[0])]
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
    """Draw windows, lit walls and lamps far away, as rows of ``Scene.lamps``.

    Lamps overhead are mirrored at the car's feet; these are mirrored on the road ahead, as small spots drawn
    out towards the camera.
    """
    places = _places_beside(track, per_m, _GLINTS_BESIDE_CM, rng)
    n = len(places)
    height_cm = 25.0 * 8.0 ** rng.random(n)
    size_rad = 0.006 * 6.0 ** rng.random(n)
    return np.column_stack([places, height_cm, size_rad])


def _room(level: float, rng: np.random.Generator) -> Float32[np.ndarray, "r c 4"]:
    """Soft light on the walls, with doors, windows and furniture as upright rectangles."""
    azimuth = np.linspace(0.0, 2.0 * np.pi, _ROOM_COLUMNS, endpoint=False)
    shade = sum(np.cos(k * azimuth + rng.uniform(0.0, 2.0 * np.pi)) / k for k in range(1, 5))
    room = np.zeros((_ROOM_ROWS, _ROOM_COLUMNS, 3), np.float32)
    room += (0.5 * level * np.asarray(shade))[None, :, None]
    room += np.linspace(0.0, level, _ROOM_ROWS)[:, None, None]
    for _ in range(24):
        left, width = int(rng.integers(_ROOM_COLUMNS)), int(rng.integers(6, 60))
        bottom, height = int(rng.integers(0, 16)), int(rng.integers(4, 32))
        columns = (left + np.arange(width)) % _ROOM_COLUMNS
        # Rooms are mostly gray: a shade with a little colour.
        room[bottom : bottom + height, columns] += level * (
            rng.uniform(-1.5, 1.5) + rng.uniform(-0.3, 0.3, 3)
        )
    base = rng.uniform(90.0, 170.0) + rng.uniform(-10.0, 10.0, 3)
    return np.pad(np.clip(base + room, 0.0, 255.0).astype(np.float32), ((0, 0), (0, 0), (0, 1)))


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
        offset = border + rng.uniform(15.0, _OBJECTS_BESIDE_CM)
        free = half_cm + rows[0][HALF_WIDTH] + _OBJECTS_CLEAR_CM
    else:
        offset = border + radius + swing + rng.uniform(_OBJECTS_CLEAR_CM, _OBJECTS_BESIDE_CM)
        free = half_cm + radius + swing + _OBJECTS_CLEAR_CM
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
    across, within = _half_span(row, -light[1], light[0]), _half_span(row, *light)
    if row[SHAPE] != BOX:
        across = within = row[HALF_LENGTH]
    if row[SHAPE] == CONE:
        across *= 0.6
    length = min(row[TOP] * cot, _LONGEST_SHADOW_CM)
    middle = np.array([row[X], row[Y]]) - 0.5 * length * light
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
