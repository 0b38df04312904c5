"""The surroundings of one drive: the floor's pattern, lamps, clutter, the room, things that stand in it.

Random functions of the frame number: any frame can be asked for at any time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from datagen.world.render.look import LookSettings
from datagen.world.render.objects import Objects, glints, place_objects, places_beside, prints, specks
from datagen.world.render.textures import cracks, floor_pattern, level_starts, noise, pack_levels, stains
from datagen.world.road.track import Track

_ROOM_COLUMNS, _ROOM_ROWS = 512, 64
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
        clutter: Rectangles: x, y, cos and sin of the direction, half length, half width, blue, green, red.
        room: The walls, rows of elevation (0..90 degrees, from the floor up) by columns of azimuth; a fourth
            value fills up the colours.
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


def build_scene(track: Track, look: LookSettings, rng: np.random.Generator) -> Scene:
    """Draw the surroundings; each part has its own child of ``rng``, so that none moves another."""
    # The order is part of the format: a new part of the scene takes a new child at the end.
    texture_rng, joint_rng, lamp_rng, clutter_rng, room_rng, object_rng, shadow_rng = rng.spawn(7)
    speck_rng, print_rng, glint_rng = rng.spawn(3)
    lamps = _lamps(track, look.lamps_per_m, lamp_rng) * [1.0, 1.0, 1.0, look.lamp_size]
    clutter = [
        prints(track, look.prints_per_m, print_rng),
        _clutter(track, look.clutter_per_m, clutter_rng),
        specks(track, look.specks_per_m, look.floor_bgr, speck_rng),
    ]
    texture, wear = _textures(look, texture_rng)
    return Scene(
        texture=texture,
        wear=wear,
        joint_rad=float(joint_rng.uniform(0.0, np.pi)),
        joint_shift_cm=joint_rng.uniform(0.0, 100.0, 2),
        lamps=np.concatenate([lamps, glints(track, look.glints_per_m, glint_rng)]),
        clutter=np.concatenate(clutter),
        room=_room(look.wall_level, room_rng),
        objects=place_objects(track, look, object_rng, shadow_rng),
    )


def _textures(
    look: LookSettings, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "packed"], Float32[np.ndarray, "packed"]]:
    """Pattern of the floor and of the wear; zeros where neither is seen."""
    if look.texture_level == 0.0 and look.line_wear == 0.0:
        nothing = np.zeros(level_starts()[-1], np.float32)
        return nothing, nothing
    kind_rng, stain_rng, crack_rng = rng.spawn(3)
    worn = noise(look.texture_scale_cm, look.texture_stretch, rng)
    wear = pack_levels(worn)
    if look.texture_level == 0.0:
        return wear, wear
    pattern = worn
    if look.floor != "plain":
        pattern = floor_pattern(look.floor, look.texture_scale_cm, look.texture_stretch, kind_rng)
    # The pattern is counted in texture levels.
    if look.stain_level:
        pattern = pattern + look.stain_level / look.texture_level * stains(stain_rng)
    if look.crack_level:
        pattern = pattern - look.crack_level / look.texture_level * cracks(crack_rng)
    return (wear, wear) if pattern is worn else (pack_levels(pattern), wear)


def _lamps(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "lamps 4"]:
    places = places_beside(track, per_m, 150.0, rng)
    height_cm = rng.uniform(150.0, 300.0, len(places))
    size_rad = rng.uniform(0.03, 0.1, len(places))
    return np.concatenate([places, height_cm[:, None], size_rad[:, None]], axis=1)


def _clutter(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "things 9"]:
    places = places_beside(track, per_m, 70.0, rng)
    n = len(places)
    angle = rng.uniform(0.0, np.pi, n)
    strip = rng.random(n) < 0.5
    length = np.where(strip, rng.uniform(4.0, 35.0, n), rng.uniform(2.0, 14.0, n))
    width = np.where(strip, rng.uniform(0.6, 4.0, n), rng.uniform(2.0, 14.0, n))
    colour = _CLUTTER_BGR[rng.integers(len(_CLUTTER_BGR), size=n)] + rng.uniform(-20.0, 20.0, (n, 3))
    shape = np.stack([np.cos(angle), np.sin(angle), 0.5 * length, 0.5 * width], axis=1)
    return np.concatenate([places, shape, np.clip(colour, 0.0, 255.0)], axis=1)


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


_WAVES = 5


class Wander:
    """Smooth, with unit variance: a few sines of random period and phase."""

    def __init__(
        self, count: int, shortest_frames: float, longest_frames: float, rng: np.random.Generator
    ) -> None:
        """Draw ``count`` independent functions whose waves last between so many frames."""
        # Even in the logarithm: slow and quick movements alike.
        exponent = rng.uniform(np.log(shortest_frames), np.log(longest_frames), (count, _WAVES))
        self._pace = 2.0 * np.pi / np.exp(exponent)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (count, _WAVES))

    def at(self, frame: int) -> Float[np.ndarray, "count"]:
        """Return the values at a frame."""
        return np.asarray(np.sqrt(2.0 / _WAVES) * np.sin(self._pace * frame + self._phase).sum(axis=1))


class Steps:
    """Constant for a while, then another value, with unit variance."""

    def __init__(self, count: int, every_frames: float, rng: np.random.Generator) -> None:
        """Draw ``count`` functions that all step at the same frames, every so many."""
        self._count, self._every = count, every_frames
        self._seed, self._phase = int(rng.integers(2**62)), float(rng.random())
        self._last: tuple[int, Float[np.ndarray, "count"]] | None = None  # neighbouring frames share it

    def at(self, frame: int) -> Float[np.ndarray, "count"]:
        """Return the values at a frame."""
        block = int(np.floor(frame / self._every + self._phase))
        if self._last is None or self._last[0] != block:
            self._last = (block, np.random.default_rng((self._seed, block)).standard_normal(self._count))
        return self._last[1]
