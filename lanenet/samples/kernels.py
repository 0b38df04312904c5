"""The compiled loops of the augmentation: frames are changed point by point and written into rasters.

Every sample has its own random stream, so that it is the same whatever else is in its batch and whichever
thread prepares it. Numba's cache notices changes of a function's own file only: after a change of the modules
that this one imports, delete ``lanenet/samples/__pycache__``.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple, no_type_check

import numpy as np
from numba import njit

from lanenet.geometry.lane import BESIDE_DIVIDER_LANES, ROWS_CM
from lanenet.samples.clutter import CORNERS, add_clutter, draw_outline, is_inside, mark_outline, middle_dashes
from lanenet.samples.random_stream import (
    next_amount,
    next_bell,
    next_between,
    next_number,
    next_spread,
    next_uniform,
    start_stream,
)
from lanenet.samples.raster import count_cells, mark, presence
from lanenet.samples.settings import AugmentSettings

#: Radius of a disc without paint, and width of a ring. Chosen: glare and worn paint on model roads.
_UNPAINTED_CM = (4.0, 20.0)
#: The second of two edge points lies this close to the first, along each axis. Chosen: a blurred border.
_DOUBLE_CM = 1.5
_LABEL_ROWS_CM = np.array(ROWS_CM)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def misplace(x, y, camera_x, camera_y, camera_z, height, pitch, roll):
    """Return where a point of the road appears to be if the camera's mounting is wrong.

    See :func:`lanenet.samples.augment.misplaced`.
    """
    # The ray in the car's level frame, turned by the error of the mounting: first pitch, then roll.
    dx, dy, dz = x - camera_x, y - camera_y, -camera_z
    c, s = np.cos(pitch), np.sin(pitch)
    dy, dz = c * dy + s * dz, c * dz - s * dy
    c, s = np.cos(roll), np.sin(roll)
    dx, dz = c * dx + s * dz, c * dz - s * dx
    if not dz < 0.0:
        return np.nan, np.nan
    scale = -height * camera_z / dz
    return camera_x + dx * scale, camera_y + dy * scale


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def misplace_points(points_cm, camera_cm, height, pitch, roll, out):
    """Apply :func:`misplace` to many points of one camera."""
    right, ahead, up = camera_cm
    for k in range(len(points_cm)):
        x, y = points_cm[k]
        out[k, 0], out[k, 1] = misplace(x, y, right, ahead, up, height, pitch, roll)


#: :class:`AugmentSettings` as numbers, by the same names; ``limit`` is 1 for draws at the limit.
Amounts: Any = namedtuple(  # type: ignore[misc]
    "Amounts", [*(name for name in AugmentSettings.model_fields if name != "draw"), "limit"]
)


class Frames(NamedTuple):
    """Frames, concatenated: frame i owns the edges from ``edge_start[i]`` on, its lines 2 i and 2 i + 1.

    ``edge_lines`` are the bits of :func:`lanenet.samples.raster.near_lines`; the others are explained at
    :func:`lanenet.samples.augment.join_frames`.
    """

    edges_cm: np.ndarray
    edge_lines: np.ndarray
    edge_start: np.ndarray
    lines_cm: np.ndarray
    line_start: np.ndarray
    points_cm: np.ndarray
    camera_cm: np.ndarray
    lane_cm: np.ndarray
    divides: np.ndarray


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def rasterise_frames(out, indices, frames, grid, present):
    """Write frames as they are into rasters, and which lines they show into ``present``."""
    cells = np.zeros(2, np.int64)
    for slot in range(len(indices)):
        i = indices[slot]
        out[slot, 0] = 0
        cells[:] = 0
        for k in range(frames.edge_start[i], frames.edge_start[i + 1]):
            if mark(out[slot, 0], frames.edges_cm[k, 0], frames.edges_cm[k, 1], grid):
                count_cells(cells, frames.edge_lines[k])
        for side in range(2):
            present[slot, side] = presence(cells[side], frames, 2 * i + side, grid)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def augment_frames(out, labels, present, given_cm, indices, streams, seed, epoch, frames, grid, amounts):
    """Change frames, each by its own draw; write rasters, labels, visible lines and the given lane width.

    The order is that of the world: paint comes off, the car moves, objects stand on the road, and all is seen
    through a camera with a wrong mounting.
    """
    rng = np.empty(1, np.uint64)
    cells = np.empty(2, np.int64)
    corners = np.empty((amounts.objects, CORNERS, 2))
    opaque = np.empty(amounts.objects, np.bool_)
    nothing = np.empty((0, 2))
    for slot in range(len(indices)):
        i, raster = indices[slot], out[slot, 0]
        raster[:] = 0
        cells[:] = 0
        start_stream(rng, seed, epoch, streams[slot])
        mirror = next_uniform(rng) < amounts.mirror
        shift = next_spread(rng, 1.0, amounts.limit)
        turn = next_spread(rng, amounts.rotate_rad, amounts.limit)
        scale = np.exp(next_spread(rng, np.log1p(amounts.scale), amounts.limit))
        left_cm, right_cm = _room(frames, i, mirror, scale, amounts.shift_cm)
        shift *= right_cm if shift > 0.0 else left_cm
        sign = -1.0 if mirror else 1.0
        c, s = np.cos(turn), np.sin(turn)
        # As in `lanenet.samples.augment.make_view`.
        xx, xy, yx, yy = sign * c * scale, -sign * s * scale, s * scale, c * scale
        x0, y0 = -shift * c, shift * s
        _label(labels[slot], frames, i, (mirror, xx, xy, yx, yy, x0, y0), grid)
        height, pitch, roll = (
            1.0 + next_spread(rng, amounts.height, amounts.limit),
            next_spread(rng, amounts.pitch_rad, amounts.limit),
            next_spread(rng, amounts.roll_rad, amounts.limit),
        )
        camera_x = sign * scale * frames.camera_cm[i, 0]
        camera_y, camera_z = scale * frames.camera_cm[i, 1], scale * frames.camera_cm[i, 2]
        moves_camera = height != 1.0 or pitch != 0.0 or roll != 0.0
        n_objects = next_number(rng, amounts.objects, amounts.limit)
        for k in range(n_objects):
            opaque[k] = draw_outline(rng, corners[k], grid)
        missing = _missing_lines(rng, amounts)
        share = next_amount(rng, amounts.drop_points, amounts.limit)
        doubled = next_amount(rng, amounts.double_points, amounts.limit)
        first, last = frames.edge_start[i], frames.edge_start[i + 1]
        kind, place_x, place_y, radius = _unpainted(
            rng, amounts.missing_stretch, frames.edges_cm, first, last
        )
        is_given, error = (
            next_uniform(rng) >= amounts.untold_width,
            next_spread(rng, amounts.width_error, amounts.limit),
        )
        given_cm[slot] = frames.lane_cm[i] * scale * (1.0 + error) if is_given else 0.0
        dashes = nothing
        # Without the width they could be the border of a narrower lane.
        if given_cm[slot] > 0.0 and next_uniform(rng) < amounts.middle_dashes:
            dashes = middle_dashes(rng, frames, i)
        count = 0
        for k in range(first, last + len(dashes)):
            lines = frames.edge_lines[k] if k < last else 0
            if lines & missing or (share > 0.0 and next_uniform(rng) < share):
                continue
            if k < last:
                px, py = np.float64(frames.edges_cm[k, 0]), np.float64(frames.edges_cm[k, 1])
            else:
                px, py = dashes[k - last, 0], dashes[k - last, 1]
            if kind == 1 and (px - place_x) ** 2 + (py - place_y) ** 2 <= radius * radius:
                continue
            if kind == 2 and abs(np.sqrt(px * px + py * py) - place_x) <= radius:
                continue
            x, y = px * xx + py * yx + x0, px * xy + py * yy + y0
            hidden = False
            for o in range(n_objects):
                hidden = hidden or (opaque[o] and is_inside(x, y, corners[o]))
            if hidden:
                continue
            if moves_camera:
                x, y = misplace(x, y, camera_x, camera_y, camera_z, height, pitch, roll)
            if amounts.jitter_cm > 0.0:
                x += amounts.jitter_cm * next_bell(rng)
                y += amounts.jitter_cm * next_bell(rng)
            if mark(raster, x, y, grid):
                count += 1
                count_cells(cells, lines)
            if doubled > 0.0 and next_uniform(rng) < doubled:
                x += next_between(rng, -_DOUBLE_CM, _DOUBLE_CM)
                mark(raster, x, y + next_between(rng, -_DOUBLE_CM, _DOUBLE_CM), grid)
        for side in range(2):
            line = 2 * i + (1 - side if mirror else side)
            present[slot, side] = presence(cells[1 - side if mirror else side], frames, line, grid)
        for o in range(n_objects):
            mark_outline(raster, corners[o], grid)
        add_clutter(rng, raster, count, grid, amounts)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _room(frames, i, mirror, scale, most_cm):
    """Return how far the car can move to the left and to the right without leaving its lane.

    Beyond a line that divides lanes it would be in the other one, and have the labels of a lane that it is
    not in; close to such a line the image does not show which. Other lines do not limit it.
    """
    room_left, room_right = most_cm, most_cm
    margin_cm = BESIDE_DIVIDER_LANES * scale * frames.lane_cm[i]
    for side in range(2):
        x = scale * frames.points_cm[i, 3 * side]
        if frames.divides[i, side] and not np.isnan(x):
            room_cm = min(max((-x if side == 0 else x) - margin_cm, 0.0), most_cm)
            if (side == 0) != mirror:
                room_left = room_cm
            else:
                room_right = room_cm
    return room_left, room_right


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _label(labels, frames, i, view, grid):
    """Write the labels of the moved car: where its lines cross the rows, for points that the label set has.

    The rule is that of :func:`lanenet.geometry.lane.rows_of_polyline`; points outside the window have no
    label, as in :meth:`BirdseyeWindow.labelled`.
    """
    mirror, xx, xy, yx, yy, x0, y0 = view
    for side in range(2):
        old = 1 - side if mirror else side
        first, last = frames.line_start[2 * i + old], frames.line_start[2 * i + old + 1]
        for row in range(3):
            labels[3 * side + row] = np.nan
            if np.isnan(frames.points_cm[i, 3 * old + row]):
                continue
            y_row = _LABEL_ROWS_CM[row]
            for k in range(first, last - 1):
                ax, ay = frames.lines_cm[k, 0], frames.lines_cm[k, 1]
                bx, by = frames.lines_cm[k + 1, 0], frames.lines_cm[k + 1, 1]
                a = ax * xy + ay * yy + y0
                b = bx * xy + by * yy + y0
                if a <= y_row and b > y_row:
                    t = (y_row - a) / (b - a)
                    x_a, x_b = ax * xx + ay * yx + x0, bx * xx + by * yx + x0
                    x = x_a + t * (x_b - x_a)
                    if grid.label_left_cm <= x <= grid.label_right_cm:
                        labels[3 * side + row] = x
                    break


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _missing_lines(rng, amounts):
    """Draw which lines are missing, as bits."""
    chance, side = next_uniform(rng), next_uniform(rng)
    if chance < amounts.missing_both:
        return 3
    if chance < amounts.missing_both + amounts.missing_line:
        return 1 if side < 0.5 else 2
    return 0


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _unpainted(rng, chance, edges_cm, first, last):
    """Draw an area without paint: kind (0 none, 1 disc, 2 ring about the car), place and size.

    A ring hides a band across the whole road; a disc hides a section of one line.
    """
    draw, which, kind, size = (
        next_uniform(rng),
        next_uniform(rng),
        next_uniform(rng),
        next_between(rng, _UNPAINTED_CM[0], _UNPAINTED_CM[1]),
    )
    if draw >= chance or last == first:
        return 0, 0.0, 0.0, 0.0
    k = first + int(which * (last - first))
    x, y = np.float64(edges_cm[k, 0]), np.float64(edges_cm[k, 1])
    if kind < 0.5:
        return 1, x, y, size
    return 2, np.sqrt(x * x + y * y), 0.0, 0.5 * size
