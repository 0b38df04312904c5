"""Where each pixel's ray meets the floor, frame by frame: shake, rolling shutter and motion included.

The rays are found once per camera. A frame turns them by the shake, carries each image row to where the car
was when that row was read, and meets them with the floor.

Where the car is while a frame is taken: each image row has its own moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32

from datagen.world.compiled import compiled_bare
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import arc_chord

NEAR_CM = 250.0  # markings and things on the floor are painted up to here
WALL_CM = 450.0  # the floor ends here
TEXTURE_CELL_CM = 0.5
TEXTURE_LEVELS = 6
TEXTURE_BITS = 9
TEXTURE_SIDE = 1 << TEXTURE_BITS  # cells; the pattern repeats every 256 cm
TILE = 16  # side of the blocks of pixels that share a list of what lies near, [px]
NOT_FLOOR, FAR = 255, 8  # values of a pixel's level, see cast_tile
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


def _rays(camera: Camera, u: Float[np.ndarray, "n"], v: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    return camera.unproject(np.stack([u, v], axis=1)) @ camera.mounting.camera_from_car


def _difference(
    centre: Float[np.ndarray, "n 3"], before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Change of the ray over one pixel, from whichever of its sides are seen."""
    whole = after - before
    half = np.where(np.isfinite(after), after - centre, centre - before) / _HALF_PX
    return np.asarray(np.where(np.isfinite(whole), whole, np.where(np.isfinite(half), half, 0.0)))


@compiled_bare
@no_type_check
def cast_tile(rays, lowest, width, view, top, left, numbers, level):
    """Meet the rays of a tile of pixels with the floor.

    Args:
        rays: See :class:`PixelGround`, in one row.
        lowest: See there.
        width: Pixels per row, filled up.
        view: Rotation of the camera in the frame car by which it shakes; for each image row the car when it
            was read: x and y of its rear axle from the frame's pose, cos and sin of its heading; optical
            centre: right and ahead of the rear axle, height; how far the car drives during the exposure, and
            by how much it turns meanwhile.
        top: First row of the tile.
        left: First pixel of its rows.
        numbers: Filled. Row by row, eight blocks of ``TILE`` numbers: x and y of the pixel's point of the
            floor from the rear axle, axes of the map, [cm]; what the pixel covers, as change of x and y per
            pixel in u, in v, and during the exposure, [cm].
        level: Of all pixels of the image, filled: level of the floor's texture that fits; plus ``FAR`` beyond
            the painted part of the floor; ``NOT_FLOOR`` where the ray does not meet the floor.

    Returns:
        Whether any pixel sees the floor.
    """
    f = np.float32
    shake, rows, eye, way, turn = view
    near2, wall2, cell2 = f(NEAR_CM * NEAR_CM), f(WALL_CM * WALL_CM), f(TEXTURE_CELL_CM * TEXTURE_CELL_CM)
    s00, s01, s02 = f(shake[0, 0]), f(shake[0, 1]), f(shake[0, 2])
    s10, s11, s12 = f(shake[1, 0]), f(shake[1, 1]), f(shake[1, 2])
    s20, s21, s22 = f(shake[2, 0]), f(shake[2, 1]), f(shake[2, 2])
    eye_right, eye_ahead, height, way, turn = f(eye[0]), f(eye[1]), f(eye[2]), f(way), f(turn)
    tip = np.hypot(shake[2, 0], shake[2, 1])
    any_floor = np.uint8(0)
    for v in range(top, min(top + TILE, rows.shape[0])):
        i = v * width + left
        # Slices, so that no index can be negative as far as the compiler knows.
        r, n, seen = rays[9 * i : 9 * (i + TILE)], numbers[(v - top) * 8 * TILE :], level[i : i + TILE]
        if shake[2, 2] * lowest[v] - tip > 0.0:  # no ray of the row goes down
            seen[:] = NOT_FLOOR
            continue
        x0, y0, c, s = f(rows[v, 0]), f(rows[v, 1]), f(rows[v, 2]), f(rows[v, 3])
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
            seen[j] = np.uint8(fits if meets else f(NOT_FLOOR))
        for j in range(TILE):
            any_floor |= seen[j] ^ NOT_FLOOR
    return any_floor != 0


@compiled_bare
@no_type_check
def bound_tile(width, height, top, left, numbers, level, lanes):
    """Find the box of floor that a tile of pixels covers.

    Args:
        width: Pixels per row, filled up.
        height: Rows of the image.
        top: See :func:`cast_tile`.
        left: See there.
        numbers: See there.
        level: See there.
        lanes: Buffer, five float32 per pixel of a tile's row.

    Returns:
        Lowest x and y, highest x and y from the rear axle, axes of the map.
    """
    far = np.float32(1e18)
    for j in range(TILE):
        lanes[j], lanes[TILE + j], lanes[2 * TILE + j], lanes[3 * TILE + j] = far, far, -far, -far
        lanes[4 * TILE + j] = np.float32(0.0)
    for v in range(top, min(top + TILE, height)):
        n, seen = numbers[(v - top) * 8 * TILE :], level[v * width + left :]
        # Each column of the tile for itself: the compiler takes many of them at a time.
        for j in range(TILE):
            floor = seen[j] != NOT_FLOOR
            x, y = n[j], n[TILE + j]
            wide = abs(n[2 * TILE + j]) + abs(n[4 * TILE + j])
            long = abs(n[3 * TILE + j]) + abs(n[5 * TILE + j])
            spread = wide + long + (abs(n[6 * TILE + j]) + abs(n[7 * TILE + j]))
            lanes[j] = x if floor & (x < lanes[j]) else lanes[j]
            lanes[TILE + j] = y if floor & (y < lanes[TILE + j]) else lanes[TILE + j]
            lanes[2 * TILE + j] = x if floor & (x > lanes[2 * TILE + j]) else lanes[2 * TILE + j]
            lanes[3 * TILE + j] = y if floor & (y > lanes[3 * TILE + j]) else lanes[3 * TILE + j]
            lanes[4 * TILE + j] = spread if floor & (spread > lanes[4 * TILE + j]) else lanes[4 * TILE + j]
    low_x, low_y, high_x, high_y, spread = 1e18, 1e18, -1e18, -1e18, 0.0
    for j in range(TILE):
        low_x, low_y = min(low_x, lanes[j]), min(low_y, lanes[TILE + j])
        high_x, high_y = max(high_x, lanes[2 * TILE + j]), max(high_y, lanes[3 * TILE + j])
        spread = max(spread, lanes[4 * TILE + j])
    # Half the sums would do along the axes, but things lie across them.
    return low_x - spread, low_y - spread, high_x + spread, high_y + spread


def row_poses(
    height: int, heading_rad: float, speed_cm_s: float, yaw_rate_rad_s: float, readout_s: float
) -> Float[np.ndarray, "h 4"]:
    """Return the car when each image row is read.

    The frame's pose holds for the middle of the image, so that the truth is the same with and without.

    Args:
        height: Rows of the image.
        heading_rad: Heading of the frame's pose.
        speed_cm_s: Of the rear axle, along the heading.
        yaw_rate_rad_s: Positive left.
        readout_s: From the first row to the last.

    Returns:
        x and y of the rear axle from the frame's pose, [cm], axes of the map; cos and sin of the heading.
    """
    at_s = readout_s * (np.arange(height) / max(height - 1, 1) - 0.5)
    turn = yaw_rate_rad_s * at_s
    heading = heading_rad + turn
    chord_cm = arc_chord(heading_rad, speed_cm_s * at_s, turn)
    return np.column_stack([chord_cm, np.cos(heading), np.sin(heading)])


def shake_rotation(pitch_down_rad: float, roll_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return how a shake turns the camera's rays in the car frame (right, ahead, up).

    Args:
        pitch_down_rad: The view goes down by this.
        roll_rad: The camera's right side goes down by this.
    """
    cp, sp = np.cos(pitch_down_rad), np.sin(pitch_down_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, cp, sp], [0.0, -sp, cp]])
    roll = np.array([[cr, 0.0, sr], [0.0, 1.0, 0.0], [-sr, 0.0, cr]])
    return np.asarray(pitch @ roll)
