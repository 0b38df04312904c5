"""What stands still in the world beside the road: the floor's pattern, lamps, clutter, the room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from datagen.world.look import LookSettings
from datagen.world.track import Track

TEXTURE_CELL_CM = 0.5
_TEXTURE_CELLS = 512
_TEXTURE_LEVELS = 6
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
        texture: The floor's pattern, [grey levels], blurred more from level to level; it repeats.
        joint_rad: Direction of the floor's joints and grains.
        joint_shift_cm: Where the joints start.
        lamps: x, y, height above the floor, angular size, [cm], [rad].
        clutter: Rectangles: x, y, cos and sin of the direction, half length, half width, blue, green, red.
        room: The walls, rows of elevation (0..90 degrees, from the floor up) by columns of azimuth.
    """

    texture: Float32[np.ndarray, "levels n n"]
    joint_rad: float
    joint_shift_cm: Float[np.ndarray, "2"]
    lamps: Float[np.ndarray, "lamps 4"]
    clutter: Float[np.ndarray, "things 9"]
    room: Float32[np.ndarray, "r c 3"]


def build_scene(track: Track, look: LookSettings, rng: np.random.Generator) -> Scene:
    """Draw the surroundings; each part has its own child of ``rng``, so that none moves another."""
    texture_rng, joint_rng, lamp_rng, clutter_rng, room_rng = rng.spawn(5)
    return Scene(
        texture=_texture(look, texture_rng),
        joint_rad=float(joint_rng.uniform(0.0, np.pi)),
        joint_shift_cm=joint_rng.uniform(0.0, 100.0, 2),
        lamps=_lamps(track, look.lamps_per_m, lamp_rng),
        clutter=_clutter(track, look.clutter_per_m, clutter_rng),
        room=_room(look.wall_level, room_rng),
    )


def _texture(look: LookSettings, rng: np.random.Generator) -> Float32[np.ndarray, "levels n n"]:
    """Noise with equal power per octave from the grain size to 50 cm, filtered by Fourier transform."""
    n = _TEXTURE_CELLS
    if look.texture_level == 0.0 and look.line_wear == 0.0:
        return np.zeros((_TEXTURE_LEVELS, n, n), np.float32)
    f = np.fft.fftfreq(n, TEXTURE_CELL_CM)
    fu, fv = np.meshgrid(f * look.texture_stretch, np.fft.fftfreq(n, TEXTURE_CELL_CM))
    frequency = np.hypot(fu, fv)
    with np.errstate(divide="ignore"):
        amplitude = np.where(frequency > 1.0 / 50.0, 1.0 / np.maximum(frequency, 1e-9), 0.0)
    amplitude *= np.exp(-0.5 * (frequency * look.texture_scale_cm * 2.0) ** 2)
    spectrum = np.fft.fft2(rng.standard_normal((n, n))) * amplitude
    unit = np.fft.ifft2(spectrum).real.std()
    plain_u, plain_v = np.meshgrid(f, f)
    levels = []
    for level in range(_TEXTURE_LEVELS):
        sigma_cm = 0.4 * TEXTURE_CELL_CM * 2.0**level
        blur = np.exp(-2.0 * (np.pi * sigma_cm) ** 2 * (plain_u**2 + plain_v**2))
        levels.append(np.fft.ifft2(spectrum * blur).real / unit)
    return np.asarray(levels, dtype=np.float32)


def _lamps(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "lamps 4"]:
    places = _places(track, per_m, 150.0, rng)
    height_cm = rng.uniform(150.0, 300.0, len(places))
    size_rad = rng.uniform(0.03, 0.1, len(places))
    return np.concatenate([places, height_cm[:, None], size_rad[:, None]], axis=1)


def _clutter(track: Track, per_m: float, rng: np.random.Generator) -> Float[np.ndarray, "things 9"]:
    places = _places(track, per_m, 70.0, rng)
    n = len(places)
    angle = rng.uniform(0.0, np.pi, n)
    strip = rng.random(n) < 0.5
    length = np.where(strip, rng.uniform(4.0, 35.0, n), rng.uniform(2.0, 14.0, n))
    width = np.where(strip, rng.uniform(0.6, 4.0, n), rng.uniform(2.0, 14.0, n))
    colour = _CLUTTER_BGR[rng.integers(len(_CLUTTER_BGR), size=n)] + rng.uniform(-20.0, 20.0, (n, 3))
    shape = np.stack([np.cos(angle), np.sin(angle), 0.5 * length, 0.5 * width], axis=1)
    return np.concatenate([places, shape, np.clip(colour, 0.0, 255.0)], axis=1)


def _places(
    track: Track, per_m: float, beside_cm: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 2"]:
    """Random places within ``beside_cm`` of the centre line, [cm], frame map."""
    n = int(rng.poisson(per_m * track.length_cm / 100.0))
    i = rng.integers(len(track.s_cm), size=n)
    offset_cm = rng.uniform(-beside_cm, beside_cm, n)
    heading = track.heading_rad[i]
    return track.xy_cm[i] + offset_cm[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def _room(level: float, rng: np.random.Generator) -> Float32[np.ndarray, "r c 3"]:
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
    return np.clip(base + room, 0.0, 255.0).astype(np.float32)
