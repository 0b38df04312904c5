"""Where each pixel's ray meets the floor, frame by frame: shake, rolling shutter and motion included.

The rays are found once per camera. A frame turns them by the shake, carries each image row to where the car
was when that row was read, and meets them with the floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numba import njit

from lanenet.geometry.camera import Camera

NEAR_CM = 250.0  # markings and things on the floor are painted up to here
WALL_CM = 450.0  # the floor ends here
TEXTURE_CELL_CM = 0.5
TEXTURE_LEVELS = 6
TILE = 16  # side of the blocks of pixels that share a list of what lies near, [px]
NOT_FLOOR, FAR = 255, 8  # values of a pixel's level, see cast_rays
_HALF_PX = 0.5


@dataclass(frozen=True, eq=False)
class PixelGround:
    """The rays of a camera's pixels, found once and shared by all drives with that camera.

    Pixels lie row by row, each row filled up to a multiple of ``TILE`` by pixels that see nothing. ``TILE``
    neighbours keep each of their numbers together, so that compiled loops take many pixels at a time.

    Attributes:
        height: Of the image, [px].
        width: Of the image, [px].
        stride: Pixels per row, filled up.
        rays: Unit ray (right, ahead, up) and its change per pixel in u and in v, frame car; NaN where the
            lens sees nothing.
        lowest: Smallest third component of a row's rays.
        eye_cm: Optical centre: right of and ahead of the **rear** axle, above the floor.
        azimuth_rad: Of the rays, from straight ahead, left positive.
        elevation_rad: Of the rays, from the foot of the wall.
        toward: Cosine and sine of the azimuth.
    """

    height: int
    width: int
    stride: int
    rays: Float32[np.ndarray, "blocks 9 16"]
    lowest: Float[np.ndarray, "h"]
    eye_cm: Float[np.ndarray, "3"]
    azimuth_rad: Float32[np.ndarray, "n"]
    elevation_rad: Float32[np.ndarray, "n"]
    toward: Float32[np.ndarray, "2 n"]

    @classmethod
    def of(cls, camera: Camera) -> PixelGround:
        """Find every pixel's ray."""
        height, width = camera.height, camera.width
        stride = -(-width // TILE) * TILE
        v, u = (grid.ravel() for grid in np.mgrid[0:height, 0:stride].astype(np.float64))
        centre = _rays(camera, u, v)
        # The patch that a pixel covers runs between the middles of its sides; at the end of the lens' field
        # only one of them may be seen.
        along_u = _difference(centre, _rays(camera, u - _HALF_PX, v), _rays(camera, u + _HALF_PX, v))
        along_v = _difference(centre, _rays(camera, u, v - _HALF_PX), _rays(camera, u, v + _HALF_PX))
        centre[u >= width] = np.nan
        mounting = camera.mounting
        foot_rad = np.arctan2(mounting.height_cm, WALL_CM)
        elevation = np.arcsin(np.clip(centre[:, 2], -1.0, 1.0)) + foot_rad
        azimuth = np.arctan2(-centre[:, 0], centre[:, 1])
        numbers = np.concatenate([centre, along_u, along_v], axis=1).reshape(-1, TILE, 9)
        up = np.nan_to_num(centre[:, 2].reshape(height, stride), nan=1.0)
        return cls(
            height=height,
            width=width,
            stride=stride,
            rays=numbers.transpose(0, 2, 1).astype(np.float32, order="C"),
            lowest=up.min(axis=1),
            eye_cm=mounting.position_car_cm + [0.0, camera.wheelbase_cm, 0.0],
            azimuth_rad=azimuth.astype(np.float32),
            elevation_rad=elevation.astype(np.float32),
            toward=np.stack([np.cos(azimuth), np.sin(azimuth)]).astype(np.float32),
        )

    @property
    def floor(self) -> Bool[np.ndarray, "h w"]:
        """Which pixels see the floor when the camera does not shake."""
        right, ahead, up = self.rays[:, :3].transpose(1, 0, 2).reshape(3, self.height, self.stride)
        with np.errstate(invalid="ignore", divide="ignore"):
            reach_cm = np.hypot(right, ahead) * self.eye_cm[2] / -up
            return np.asarray((up < -1e-6) & (reach_cm < WALL_CM))[:, : self.width]


@dataclass(frozen=True, eq=False)
class FloorHits:
    """Buffers for what the pixels of a frame see of the floor, filled anew by :func:`cast_rays`.

    Attributes:
        numbers: In blocks like the rays: x and y of the pixel's point of the floor from the rear axle, axes
            of the map, [cm]; what the pixel covers, as change of x and y per pixel in u, in v, and during the
            exposure, [cm].
        level: Level of the floor's texture that fits; plus ``FAR`` beyond the painted part of the floor;
            ``NOT_FLOOR`` where the ray does not meet the floor.
        tiles: Box of floor that each tile of pixels covers, row by row: lowest x and y, highest x and y from
            the rear axle; the lowest exceed the highest where a tile sees no floor.
    """

    numbers: Float32[np.ndarray, "n8"]
    level: UInt8[np.ndarray, "n"]
    tiles: Float[np.ndarray, "tiles 4"]

    @classmethod
    def empty(cls, ground: PixelGround) -> FloorHits:
        """Return buffers for a camera's image."""
        pixels = ground.height * ground.stride
        tiles = -(-ground.height // TILE) * (ground.stride // TILE)
        return cls(
            np.zeros(8 * pixels, np.float32), np.full(pixels, NOT_FLOOR, np.uint8), np.zeros((tiles, 4))
        )


def _rays(camera: Camera, u: Float[np.ndarray, "n"], v: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    return camera.unproject(np.stack([u, v], axis=1)) @ camera.mounting.camera_from_car


def _difference(
    centre: Float[np.ndarray, "n 3"], before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Change of the ray over one pixel, from whichever of its sides are seen."""
    whole = after - before
    half = np.where(np.isfinite(after), after - centre, centre - before) / _HALF_PX
    return np.asarray(np.where(np.isfinite(whole), whole, np.where(np.isfinite(half), half, 0.0)))


@njit(cache=True, error_model="numpy")
@no_type_check
def cast_rays(rays, lowest, width, shake, rows, eye, way, turn, numbers, level):
    """Meet every pixel's ray with the floor.

    Args:
        rays: See :class:`PixelGround`, in one row.
        lowest: See there.
        width: Pixels per row, filled up.
        shake: Rotation of the camera in the frame car.
        rows: For each image row the car when it was read: x and y of its rear axle from the frame's pose, cos
            and sin of its heading.
        eye: Optical centre: right and ahead of the rear axle, height.
        way: How far the car drives during the exposure.
        turn: By how much it turns meanwhile.
        numbers: Filled, see :class:`FloorHits`.
        level: Filled.
    """
    f = np.float32
    near2, wall2, cell2 = f(NEAR_CM * NEAR_CM), f(WALL_CM * WALL_CM), f(TEXTURE_CELL_CM * TEXTURE_CELL_CM)
    s00, s01, s02 = f(shake[0, 0]), f(shake[0, 1]), f(shake[0, 2])
    s10, s11, s12 = f(shake[1, 0]), f(shake[1, 1]), f(shake[1, 2])
    s20, s21, s22 = f(shake[2, 0]), f(shake[2, 1]), f(shake[2, 2])
    eye_right, eye_ahead, height, way, turn = f(eye[0]), f(eye[1]), f(eye[2]), f(way), f(turn)
    tip = np.hypot(shake[2, 0], shake[2, 1])
    for v in range(rows.shape[0]):
        if shake[2, 2] * lowest[v] - tip > 0.0:  # no ray of the row goes down
            level[v * width : (v + 1) * width] = NOT_FLOOR
            continue
        x0, y0, c, s = f(rows[v, 0]), f(rows[v, 1]), f(rows[v, 2]), f(rows[v, 3])
        for block in range(v * width // TILE, (v + 1) * width // TILE):
            # Slices, so that no index can be negative as far as the compiler knows.
            r, n = rays[block * 9 * TILE : (block + 1) * 9 * TILE], numbers[block * 8 * TILE :]
            out = level[block * TILE : (block + 1) * TILE]
            # No branches and nothing but float32: the compiler takes many pixels at a time.
            for j in range(TILE):
                a, b, d = r[j], r[TILE + j], r[2 * TILE + j]
                rx, ry = s00 * a + s01 * b + s02 * d, s10 * a + s11 * b + s12 * d
                rz = s20 * a + s21 * b + s22 * d
                per_z = f(1.0) / rz
                t, slope_x, slope_y = -height * per_z, rx * per_z, ry * per_z
                right, ahead = rx * t, ry * t
                reach2 = right * right + ahead * ahead
                a, b, d = r[3 * TILE + j], r[4 * TILE + j], r[5 * TILE + j]
                dz = s20 * a + s21 * b + s22 * d
                right_u = t * (s00 * a + s01 * b + s02 * d - slope_x * dz)
                ahead_u = t * (s10 * a + s11 * b + s12 * d - slope_y * dz)
                a, b, d = r[6 * TILE + j], r[7 * TILE + j], r[8 * TILE + j]
                dz = s20 * a + s21 * b + s22 * d
                right_v = t * (s00 * a + s01 * b + s02 * d - slope_x * dz)
                ahead_v = t * (s10 * a + s11 * b + s12 * d - slope_y * dz)
                right, ahead = right + eye_right, ahead + eye_ahead
                x, y = ahead * c + right * s, ahead * s - right * c
                n[j], n[TILE + j] = x0 + x, y0 + y
                n[2 * TILE + j] = ahead_u * c + right_u * s
                n[3 * TILE + j] = ahead_u * s - right_u * c
                n[4 * TILE + j] = ahead_v * c + right_v * s
                n[5 * TILE + j] = ahead_v * s - right_v * c
                # The pixel keeps its place on the car, so its point sweeps over the floor.
                n[6 * TILE + j], n[7 * TILE + j] = way * c - turn * y, way * s + turn * x
                # The texture's cells double from level to level, their areas are four times as large.
                area = abs(right_u * ahead_v - right_v * ahead_u) / cell2
                fits = f(0.0)
                fits += f(1.0) if area > f(1.0) else f(0.0)
                fits += f(1.0) if area > f(4.0) else f(0.0)
                fits += f(1.0) if area > f(16.0) else f(0.0)
                fits += f(1.0) if area > f(64.0) else f(0.0)
                fits += f(1.0) if area > f(256.0) else f(0.0)
                fits += f(0.0) if reach2 < near2 else f(FAR)
                meets = (rz < f(-1e-6)) & (reach2 < wall2)
                out[j] = np.uint8(fits if meets else f(NOT_FLOOR))


@njit(cache=True, error_model="numpy")
@no_type_check
def bound_tiles(width, numbers, level, tiles):
    """Find the box of floor that each tile of pixels covers, see :class:`FloorHits`; ``tiles`` is filled."""
    columns, height = width // TILE, level.shape[0] // width
    for tile in range(tiles.shape[0]):
        top, left = tile // columns * TILE, tile % columns * TILE
        low_x, low_y, high_x, high_y, spread = 1e18, 1e18, -1e18, -1e18, 0.0
        for v in range(top, min(top + TILE, height)):
            n, seen = numbers[(v * width + left) * 8 :], level[v * width + left :]
            for j in range(TILE):
                if seen[j] != NOT_FLOOR:
                    x, y = n[j], n[TILE + j]
                    low_x, high_x = min(low_x, x), max(high_x, x)
                    low_y, high_y = min(low_y, y), max(high_y, y)
                    wide = abs(n[2 * TILE + j]) + abs(n[4 * TILE + j])
                    long = abs(n[3 * TILE + j]) + abs(n[5 * TILE + j])
                    sweep = abs(n[6 * TILE + j]) + abs(n[7 * TILE + j])
                    spread = max(spread, wide + long + sweep)
        # Half the sums would do along the axes, but things lie across them.
        tiles[tile, 0], tiles[tile, 1] = low_x - spread, low_y - spread
        tiles[tile, 2], tiles[tile, 3] = high_x + spread, high_y + spread
