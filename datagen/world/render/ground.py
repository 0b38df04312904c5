"""Where each pixel's ray meets the floor, frame by frame: shake, rolling shutter and motion included.

The rays are found once per camera. A frame turns them by the shake, moves each image row to where the car was
when that row was read, and intersects them with the floor.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.spatial import cKDTree

from datagen.world.render.compiled import (
    AHEAD,
    AHEAD_U,
    AHEAD_V,
    AT_X,
    AT_Y,
    FAR,
    FLOOR_NUMBERS,
    MOVE_X,
    MOVE_Y,
    NOT_FLOOR,
    RAY_NUMBERS,
    RIGHT,
    RIGHT_U,
    RIGHT_V,
    TILE,
    U_X,
    U_Y,
    UP,
    UP_U,
    UP_V,
    V_X,
    V_Y,
    compiled_bare,
)
from datagen.world.road.track import Track
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import arc_chord

#: Markings and things on the floor are painted up to here; chosen: a line of 2 cm is below a pixel there.
NEAR_CM = 250.0
#: The floor ends here; chosen: a room of 9 m.
WALL_CM = 450.0
#: Finest cell of the floor's texture, about a pixel at the car's feet; 512 of them repeat every 256 cm.
TEXTURE_CELL_CM = 0.5
TEXTURE_BITS = 9
TEXTURE_SIDE = 1 << TEXTURE_BITS
#: Cells double from level to level: the coarsest ones, of 16 cm, are a pixel at ``WALL_CM``.
TEXTURE_LEVELS = 6
_HALF_PX = 0.5
#: Columns of the buffer of :func:`bound_tile`, a number per column of the tile.
_LOW_X, _LOW_Y, _HIGH_X, _HIGH_Y, _SPREAD = range(0, 5 * TILE, TILE)
BOUND_NUMBERS = 5 * TILE
#: Two samples of the centre line; the search from there takes a step or two.
_GRID_CELL_CM = 2.0
#: Around the markings, for pixels that reach over them from outside.
_GRID_MARGIN_CM = 10.0
_BLOCK_CELLS = 128
#: Some more than lie around a car.
_MAX_BLOCKS = 32
#: Cells of :class:`Nearby`, and how many are kept: as many as a car passes in 100 m.
_CELL_CM = 200.0
_MAX_CELLS = 64


class PixelGround(NamedTuple):
    """The rays of a camera's pixels, found once and shared by all drives with that camera.

    Pixels lie row by row, each row filled up to a multiple of ``TILE`` by pixels that see nothing. Blocks of
    ``TILE`` neighbours keep each of their numbers together, so that compiled loops take many at a time.

    Attributes:
        height: Of the image, [px].
        width: Of the image, [px].
        stride: Pixels per row, filled up.
        rays: Blocks of rays, frame car, see :data:`datagen.world.render.compiled.RIGHT`; NaN where the lens
            sees nothing.
        lowest: Smallest upward component of a row's rays.
        eye_cm: Optical centre: right of and ahead of the **rear** axle, above the floor.
        azimuth_rad: Of the rays, from straight ahead, left positive.
        elevation_rad: Of the rays, from the foot of the wall.
        toward: Cosine and sine of the azimuth.
    """

    height: int
    width: int
    stride: int
    rays: Float32[np.ndarray, "numbers"]
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
        # The patch that a pixel covers runs between the middles of its sides; at the edge of the lens' field
        # of view only one of them may be seen.
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
            rays=numbers.transpose(0, 2, 1).astype(np.float32, order="C").ravel(),
            lowest=up.min(axis=1),
            eye_cm=mounting.position_car_cm + [0.0, camera.wheelbase_cm, 0.0],
            azimuth_rad=azimuth.astype(np.float32),
            elevation_rad=elevation.astype(np.float32),
            toward=np.stack([np.cos(azimuth), np.sin(azimuth)]).astype(np.float32),
        )


class View(NamedTuple):
    """The camera while one frame is taken.

    Attributes:
        frame: Number of the frame.
        pose: Rear-axle centre x, y and heading in the middle of the frame's time, frame map.
        eye_map_cm: Optical centre then.
        shake: How the camera shakes: rotates rays in the frame car.
        tilt: The same as small angles: up at the front, down on the right, [rad].
        rows: For each image row the car when it is read: x and y of its rear axle from ``pose``, [cm], axes
            of the map; cosine and sine of its heading.
        move_cm: How far the car drives during the exposure.
        turn_rad: By how much it turns meanwhile.
        slack_rad: By how much it turns, at most, between the middle row and any other.
    """

    frame: int
    pose: Float[np.ndarray, "3"]
    eye_map_cm: Float[np.ndarray, "3"]
    shake: Float[np.ndarray, "3 3"]
    tilt: Float[np.ndarray, "2"]
    rows: Float[np.ndarray, "h 4"]
    move_cm: float
    turn_rad: float
    slack_rad: float


class Canvas(NamedTuple):
    """What the compiled loops paint into, with the pixels of :class:`PixelGround`.

    Attributes:
        light: Blue, green, red of each pixel; what no ray reaches stays black.
        level: Level of the floor's texture whose cells are about as large as the pixel; plus ``FAR`` beyond
            the painted part of the floor; ``NOT_FLOOR`` where the ray does not meet the floor.
        depth: Distance to the nearest solid.
    """

    light: Float32[np.ndarray, "n 3"]
    level: UInt8[np.ndarray, "n"]
    depth: Float32[np.ndarray, "n"]

    @classmethod
    def of(cls, ground: PixelGround) -> Canvas:
        """Return an empty canvas for a camera."""
        n = ground.height * ground.stride
        light, level = np.zeros((n, 3), np.float32), np.full(n, NOT_FLOOR, np.uint8)
        return cls(light, level, np.zeros(n, np.float32))


def _rays(camera: Camera, u: Float[np.ndarray, "n"], v: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    return camera.unproject(np.stack([u, v], axis=1)) @ camera.mounting.camera_from_car


def _difference(
    centre: Float[np.ndarray, "n 3"], before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Change of the ray over one pixel, from whichever of its sides are seen."""
    whole = after - before
    half = np.where(np.isfinite(after), after - centre, centre - before) / _HALF_PX
    return np.asarray(np.where(np.isfinite(whole), whole, np.where(np.isfinite(half), half, 0.0)))


def row_poses(
    height: int, heading_rad: float, speed_cm_s: float, yaw_rate_rad_s: float, readout_s: float
) -> Float[np.ndarray, "h 4"]:
    """Return the car when each image row is read, see :class:`View`.

    The frame's pose holds for the middle of the image, so that the truth is the same with and without a
    rolling shutter.

    Args:
        height: Rows of the image.
        heading_rad: Heading of the frame's pose.
        speed_cm_s: Of the rear axle, along the heading.
        yaw_rate_rad_s: Positive left.
        readout_s: From the first row to the last.
    """
    at_s = readout_s * (np.arange(height) / max(height - 1, 1) - 0.5)
    turn = yaw_rate_rad_s * at_s
    heading = heading_rad + turn
    chord_cm = arc_chord(heading_rad, speed_cm_s * at_s, turn)
    return np.column_stack([chord_cm, np.cos(heading), np.sin(heading)])


def shake_rotation(pitch_down_rad: float, roll_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return how a shake rotates the camera's rays in the car frame (right, ahead, up).

    Args:
        pitch_down_rad: The view goes down by this.
        roll_rad: The camera's right side goes down by this.
    """
    cp, sp = np.cos(pitch_down_rad), np.sin(pitch_down_rad)
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, cp, sp], [0.0, -sp, cp]])
    roll = np.array([[cr, 0.0, sr], [0.0, 1.0, 0.0], [-sr, 0.0, cr]])
    return np.asarray(pitch @ roll)


@compiled_bare
@no_type_check
def cast_tile(canvas, ground, view, top, left, numbers):
    """Intersect the rays of a tile of pixels with the floor.

    Args:
        canvas: Its levels are filled in.
        ground: The rays.
        view: The frame.
        top: First row of the tile.
        left: First pixel of its rows.
        numbers: Filled: a block of floor numbers (``AT_X`` to ``MOVE_Y``) for each row of the tile.

    Returns:
        Whether any pixel sees the floor.
    """
    f = np.float32
    rays, rows, shake, eye, stride = ground.rays, view.rows, view.shake, ground.eye_cm, ground.stride
    near2, wall2, cell2 = f(NEAR_CM * NEAR_CM), f(WALL_CM * WALL_CM), f(TEXTURE_CELL_CM * TEXTURE_CELL_CM)
    s00, s01, s02 = f(shake[0, 0]), f(shake[0, 1]), f(shake[0, 2])
    s10, s11, s12 = f(shake[1, 0]), f(shake[1, 1]), f(shake[1, 2])
    s20, s21, s22 = f(shake[2, 0]), f(shake[2, 1]), f(shake[2, 2])
    eye_right, eye_ahead, height = f(eye[0]), f(eye[1]), f(eye[2])
    move, turn = f(view.move_cm), f(view.turn_rad)
    tip = np.hypot(shake[2, 0], shake[2, 1])
    any_floor = np.uint8(0)
    for v in range(top, min(top + TILE, ground.height)):
        i = v * stride + left
        # Slices, so that no index can be negative as far as the compiler knows.
        r = rays[i // TILE * RAY_NUMBERS : (i // TILE + 1) * RAY_NUMBERS]
        n, seen = numbers[(v - top) * FLOOR_NUMBERS :], canvas.level[i : i + TILE]
        if shake[2, 2] * ground.lowest[v] - tip > 0.0:  # no ray of the row goes down
            seen[:] = NOT_FLOOR
            continue
        x0, y0, c, s = f(rows[v, 0]), f(rows[v, 1]), f(rows[v, 2]), f(rows[v, 3])
        # No branches and nothing but float32: the compiler takes many pixels at a time.
        for j in range(TILE):
            a, b, d = r[RIGHT + j], r[AHEAD + j], r[UP + j]
            rx, ry = s00 * a + s01 * b + s02 * d, s10 * a + s11 * b + s12 * d
            rz = s20 * a + s21 * b + s22 * d
            per_z = f(1.0) / rz
            t, slope_x, slope_y = -height * per_z, rx * per_z, ry * per_z
            right, ahead = rx * t, ry * t
            reach2 = right * right + ahead * ahead
            a, b, d = r[RIGHT_U + j], r[AHEAD_U + j], r[UP_U + j]
            dz = s20 * a + s21 * b + s22 * d
            right_u = t * (s00 * a + s01 * b + s02 * d - slope_x * dz)
            ahead_u = t * (s10 * a + s11 * b + s12 * d - slope_y * dz)
            a, b, d = r[RIGHT_V + j], r[AHEAD_V + j], r[UP_V + j]
            dz = s20 * a + s21 * b + s22 * d
            right_v = t * (s00 * a + s01 * b + s02 * d - slope_x * dz)
            ahead_v = t * (s10 * a + s11 * b + s12 * d - slope_y * dz)
            right, ahead = right + eye_right, ahead + eye_ahead
            x, y = ahead * c + right * s, ahead * s - right * c
            n[AT_X + j], n[AT_Y + j] = x0 + x, y0 + y
            n[U_X + j], n[U_Y + j] = ahead_u * c + right_u * s, ahead_u * s - right_u * c
            n[V_X + j], n[V_Y + j] = ahead_v * c + right_v * s, ahead_v * s - right_v * c
            # The pixel keeps its place on the car, so its point sweeps over the floor.
            n[MOVE_X + j], n[MOVE_Y + j] = move * c - turn * y, move * s + turn * x
            # The texture's cells double from level to level, their areas are four times as large.
            area = abs(right_u * ahead_v - right_v * ahead_u) / cell2
            level = f(0.0)
            level += f(1.0) if area > f(1.0) else f(0.0)
            level += f(1.0) if area > f(4.0) else f(0.0)
            level += f(1.0) if area > f(16.0) else f(0.0)
            level += f(1.0) if area > f(64.0) else f(0.0)
            level += f(1.0) if area > f(256.0) else f(0.0)
            level += f(0.0) if reach2 < near2 else f(FAR)
            meets = (rz < f(-1e-6)) & (reach2 < wall2)
            seen[j] = np.uint8(level if meets else f(NOT_FLOOR))
        for j in range(TILE):
            any_floor |= seen[j] ^ NOT_FLOOR
    return any_floor != 0


@compiled_bare
@no_type_check
def bound_tile(canvas, ground, top, left, numbers, lanes):
    """Find the box of floor that a tile of pixels covers.

    Args:
        canvas: See :func:`cast_tile`, as for all but the last.
        ground: The rays.
        top: First row of the tile.
        left: First pixel of its rows.
        numbers: Of its pixels.
        lanes: Buffer, ``BOUND_NUMBERS`` float32.

    Returns:
        Lowest x and y, highest x and y from the rear axle, axes of the map.
    """
    far = np.float32(1e18)
    for j in range(TILE):
        lanes[_LOW_X + j], lanes[_LOW_Y + j], lanes[_HIGH_X + j], lanes[_HIGH_Y + j] = far, far, -far, -far
        lanes[_SPREAD + j] = np.float32(0.0)
    for v in range(top, min(top + TILE, ground.height)):
        n, seen = numbers[(v - top) * FLOOR_NUMBERS :], canvas.level[v * ground.stride + left :]
        # Each column of the tile for itself: the compiler takes many of them at a time.
        for j in range(TILE):
            floor = seen[j] != NOT_FLOOR
            x, y = n[AT_X + j], n[AT_Y + j]
            wide, long = abs(n[U_X + j]) + abs(n[V_X + j]), abs(n[U_Y + j]) + abs(n[V_Y + j])
            spread = wide + long + (abs(n[MOVE_X + j]) + abs(n[MOVE_Y + j]))
            lanes[_LOW_X + j] = x if floor & (x < lanes[_LOW_X + j]) else lanes[_LOW_X + j]
            lanes[_LOW_Y + j] = y if floor & (y < lanes[_LOW_Y + j]) else lanes[_LOW_Y + j]
            lanes[_HIGH_X + j] = x if floor & (x > lanes[_HIGH_X + j]) else lanes[_HIGH_X + j]
            lanes[_HIGH_Y + j] = y if floor & (y > lanes[_HIGH_Y + j]) else lanes[_HIGH_Y + j]
            lanes[_SPREAD + j] = spread if floor & (spread > lanes[_SPREAD + j]) else lanes[_SPREAD + j]
    low_x, low_y, high_x, high_y, spread = 1e18, 1e18, -1e18, -1e18, 0.0
    for j in range(TILE):
        low_x, low_y = min(low_x, lanes[_LOW_X + j]), min(low_y, lanes[_LOW_Y + j])
        high_x, high_y = max(high_x, lanes[_HIGH_X + j]), max(high_y, lanes[_HIGH_Y + j])
        spread = max(spread, lanes[_SPREAD + j])
    # Half the sums would do along the axes, but things lie across them.
    return low_x - spread, low_y - spread, high_x + spread, high_y + spread


class NearestGrid:
    """The nearest sample of the centre line for places near a road."""

    def __init__(self, track: Track) -> None:
        """Take the samples of a road."""
        #: How far from the centre line it answers.
        self.reach_cm = _GRID_MARGIN_CM + max(
            (abs(m.offset_cm) + 0.5 * m.width_cm for m in track.markings), default=0.0
        )
        self._low = track.xy_cm.min(axis=0) - self.reach_cm - _GRID_CELL_CM
        self._samples = cKDTree(track.xy_cm)
        self._blocks: dict[tuple[int, int], Int[np.ndarray, "b b"]] = {}
        self._window: tuple[tuple[int, ...], Int[np.ndarray, "r c"]] | None = None

    def around(
        self, low_cm: Float[np.ndarray, "2"], high_cm: Float[np.ndarray, "2"]
    ) -> tuple[Int[np.ndarray, "r c"], Float[np.ndarray, "3"]]:
        """Return the grid over a box of the map, and more.

        Args:
            low_cm: Smallest x and y, frame map.
            high_cm: Largest x and y.

        Returns:
            Nearest sample by cell, -1 away from the road; x and y of its origin and the size of a cell.
        """
        size_cm = _BLOCK_CELLS * _GRID_CELL_CM
        first = np.floor((low_cm - self._low) / size_cm).astype(int)
        last = np.floor((high_cm - self._low) / size_cm).astype(int)
        key = (int(first[0]), int(first[1]), int(last[0]), int(last[1]))
        # The blocks around the car stay the same for many frames.
        if self._window is None or self._window[0] != key:
            rows, columns = range(key[1], key[3] + 1), range(key[0], key[2] + 1)
            self._window = key, np.block([[self._block(row, column) for column in columns] for row in rows])
        return self._window[1], np.array([*(self._low + first * size_cm), _GRID_CELL_CM])

    def _block(self, row: int, column: int) -> Int[np.ndarray, "b b"]:
        size_cm = _BLOCK_CELLS * _GRID_CELL_CM
        low_cm = self._low + np.array([column, row]) * size_cm
        if self._samples.query(low_cm + 0.5 * size_cm)[0] > self.reach_cm + size_cm:
            return np.full((_BLOCK_CELLS, _BLOCK_CELLS), -1, np.int32)
        block = self._blocks.get((row, column))
        if block is None:
            if len(self._blocks) >= _MAX_BLOCKS:  # the oldest goes: memory stays flat on a long road
                del self._blocks[next(iter(self._blocks))]
            x, y = low_cm[:, None] + (np.arange(_BLOCK_CELLS) + 0.5) * _GRID_CELL_CM
            cells_cm = np.stack(np.meshgrid(x, y), axis=-1)
            _, nearest = self._samples.query(cells_cm, distance_upper_bound=self.reach_cm)
            block = np.where(nearest < self._samples.n, nearest, -1).astype(np.int32)
            self._blocks[row, column] = block
        return block


class Nearby:
    """Rows of a table near the car; neighbouring frames share the answer."""

    def __init__(
        self, rows: Float[np.ndarray, "n k"], reaches_cm: Float[np.ndarray, "n"], sight_cm: float
    ) -> None:
        """Keep a table.

        Args:
            rows: Each starts with x and y, [cm], frame map.
            reaches_cm: How far each extends, or moves, from there.
            sight_cm: How far from the car things count.
        """
        self._rows, self._reaches_cm, self._sight_cm = rows, reaches_cm, sight_cm
        self._cells: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def at(self, x_cm: float, y_cm: float) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m"]]:
        """Return the rows that may be in sight from a place, in the table's order, and their reaches."""
        cell = (int(np.floor(x_cm / _CELL_CM)), int(np.floor(y_cm / _CELL_CM)))
        found = self._cells.get(cell)
        if found is None:
            middle = (np.array(cell) + 0.5) * _CELL_CM
            gap = np.abs(self._rows[:, :2] - middle).max(axis=1, initial=0.0)
            near = gap <= 0.5 * _CELL_CM + self._sight_cm + self._reaches_cm
            found = (self._rows[near], self._reaches_cm[near])
            if len(self._cells) >= _MAX_CELLS:  # the oldest goes: memory stays flat on a long road
                del self._cells[next(iter(self._cells))]
            self._cells[cell] = found
        return found
