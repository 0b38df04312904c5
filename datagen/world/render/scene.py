"""The surroundings of one drive: the floor, lamps, what lies about, the room, and things that stand in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from datagen.world.render.appearance import Appearance
from datagen.world.render.objects import Objects, place_objects
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
