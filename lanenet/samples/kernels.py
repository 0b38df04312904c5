"""The compiled loops of the augmentation: frames are changed point by point and written into rasters.

Every sample has its own random stream, so that it is the same whatever else is in its batch and whichever
thread prepares it. Numba's cache notices changes of a function's own file only: after a change of the modules
that this one imports, delete ``lanenet/samples/__pycache__``.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from lanenet.geometry.lane import BESIDE_DIVIDER_LANES, ROWS_CM
from lanenet.perception.edges.raster import MIDDLE, STEPS
from lanenet.samples.random_stream import (
    kernel,
    next_amount,
    next_bell,
    next_between,
    next_number,
    next_spread,
    next_uniform,
    start_stream,
)
from lanenet.samples.settings import AugmentSettings

#: Radius of a disc without paint, and width of a ring. Chosen: glare and worn paint on model roads.
_UNPAINTED_CM = (4.0, 20.0)
#: The second of two edge points lies this close to the first, along each axis. Chosen: a blurred border.
_DOUBLE_CM = 1.5
_LABEL_ROWS_CM = np.array(ROWS_CM)

#: Edge points this close to a line belong to it. Chosen: both borders of a wide tape and their blur.
LINE_REACH_CM = 4.0
#: Sine of the largest angle between a marking's border and its line. Chosen: 30 degrees.
_LEAN = 0.5
#: A line that marks cells over the first length can be seen; over less than the second it cannot. Chosen;
#: both borders of a tape count, so the first is 9 cm of it.
SEEN_CM, UNSEEN_CM = 18.0, 3.0

# All ranges below are chosen: objects, shadows and markings as they occur on model roads, at 1:10.
#: Corners of every outline; enough for a round one.
CORNERS = 12

#: Half the width and half the length of a box.
_BOX_HALF_CM = ((1.5, 12.0), (1.5, 22.0))
#: Radius of a cone's foot, and how many times longer it appears: what stands is smeared away from the camera.
_CONE_CM, _SMEAR = (1.5, 6.0), (1.0, 5.0)
#: Radius of a shadow.
_SHADOW_CM = (8.0, 50.0)
#: Shares of shadows and of cones among the outlines; the rest are boxes.
_SHADOW_SHARE, _CONE_SHARE = 0.3, 0.35
#: Length of a straight edge.
_EDGE_CM = (4.0, 40.0)
#: Length of a dash and of the gap after it.
_DASH_CM, _GAP_CM = (5.0, 30.0), (5.0, 30.0)
#: Offset of the dashes from the middle of the lane, in lane widths.
_OFF_MIDDLE = 0.04
#: Share of the things beside the lane that have a colour of their own.
_COLOURED = 0.3


#: :class:`AugmentSettings` as numbers, by the same names; ``limit`` is 1 for draws at the limit.
Amounts: Any = namedtuple(  # type: ignore[misc]
    "Amounts", [*(name for name in AugmentSettings.model_fields if name != "draw"), "limit"]
)


class Frames(NamedTuple):
    """Frames, concatenated: frame i owns the edges from ``edge_start[i]`` on, its lines 2 i and 2 i + 1.

    ``edge_looks`` are normals and hues in steps of a raster, ``edge_lines`` the bits of :func:`near_lines`;
    the others are explained at
    :func:`lanenet.samples.augment.join_frames`.
    """

    edges_cm: np.ndarray
    edge_looks: np.ndarray
    edge_lines: np.ndarray
    edge_start: np.ndarray
    lines_cm: np.ndarray
    line_start: np.ndarray
    points_cm: np.ndarray
    camera_cm: np.ndarray
    lane_cm: np.ndarray
    divides: np.ndarray


class Grid(NamedTuple):
    """A bird's-eye window, in the single precision of edge points and the double precision of labels."""

    left_cm: np.float32
    far_cm: np.float32
    cell_cm: np.float32
    rows: int
    columns: int
    label_left_cm: float
    label_right_cm: float


@kernel
def rasterise_frames(out, indices, frames, grid, present):
    """Write frames as they are into rasters, and which lines they show into ``present``."""
    cells = np.zeros(2, np.int64)
    for slot in range(len(indices)):
        i = indices[slot]
        clear(out[slot])
        cells[:] = 0
        for k in range(frames.edge_start[i], frames.edge_start[i + 1]):
            if mark(out[slot], frames.edges_cm[k, 0], frames.edges_cm[k, 1], frames.edge_looks[k], grid):
                count_cells(cells, frames.edge_lines[k])
        for side in range(2):
            present[slot, side] = presence(cells[side], frames, 2 * i + side, grid)


@kernel
def augment_frames(out, labels, present, given_cm, indices, streams, seed, epoch, frames, grid, amounts):
    """Change frames, each by its own draw; write rasters, labels, visible lines and the given lane width.

    The order is that of the world: paint comes off, the car moves, objects stand on the road, and all is seen
    through a camera with a wrong mounting.
    """
    rng = np.empty(1, np.uint64)
    cells = np.empty(2, np.int64)
    corners = np.empty((amounts.objects, CORNERS, 2))
    opaque = np.empty(amounts.objects, np.bool_)
    nothing, look = np.empty((0, 3)), np.empty(4)
    for slot in range(len(indices)):
        i, raster = indices[slot], out[slot]
        clear(raster)
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
        # A point p of the road is seen at p @ ((xx, xy), (yx, yy)) + (x0, y0): scaled and mirrored, then from
        # a car that was moved to the right and turned left about its front axle.
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
        light = -1.0 if next_uniform(rng) < amounts.inverted else 1.0
        gain = np.exp(next_spread(rng, np.log1p(amounts.hue_gain), amounts.limit))
        if next_uniform(rng) < amounts.colourless:
            gain = 0.0
        yellow_cast = STEPS * next_spread(rng, amounts.hue_cast, amounts.limit)
        red_cast = STEPS * next_spread(rng, amounts.hue_cast, amounts.limit)
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
                source, px, py = k, np.float64(frames.edges_cm[k, 0]), np.float64(frames.edges_cm[k, 1])
            else:
                source, px, py = int(dashes[k - last, 2]), dashes[k - last, 0], dashes[k - last, 1]
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
            nx, ny = frames.edge_looks[source, 0], frames.edge_looks[source, 1]
            look[0] = light * (sign * c * nx + s * ny)
            look[1] = light * (c * ny - sign * s * nx)
            look[2] = gain * frames.edge_looks[source, 2] + yellow_cast
            look[3] = gain * frames.edge_looks[source, 3] + red_cast
            if mark(raster, x, y, look, grid):
                count += 1
                count_cells(cells, lines)
            if doubled > 0.0 and next_uniform(rng) < doubled:
                x += next_between(rng, -_DOUBLE_CM, _DOUBLE_CM)
                mark(raster, x, y + next_between(rng, -_DOUBLE_CM, _DOUBLE_CM), look, grid)
        for side in range(2):
            line = 2 * i + (1 - side if mirror else side)
            present[slot, side] = presence(cells[1 - side if mirror else side], frames, line, grid)
        for o in range(n_objects):
            _draw_look(rng, look)
            mark_outline(raster, corners[o], look, grid)
        add_clutter(rng, raster, count, grid, amounts)


@kernel
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


@kernel
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


@kernel
def _missing_lines(rng, amounts):
    """Draw which lines are missing, as bits."""
    chance, side = next_uniform(rng), next_uniform(rng)
    if chance < amounts.missing_both:
        return 3
    if chance < amounts.missing_both + amounts.missing_line:
        return 1 if side < 0.5 else 2
    return 0


@kernel
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


@kernel
def misplace(x, y, camera_x, camera_y, camera_z, height, pitch, roll):
    """Return where a point of the road appears to be if the camera's mounting is wrong.

    The camera's ray is turned by the error of the mounting and intersected with the road again, below a
    camera of the wrong height. The camera is assumed to look straight ahead: a wrong pitch then moves the
    points alike whatever the pitch is, and a wrong roll is one about the level line ahead.

    Args:
        x: Of the true point, [cm], frame car, like y.
        y: Likewise.
        camera_x: Optical centre: right of the front axle, [cm]; the next two are ahead of and above it.
        camera_y: Likewise.
        camera_z: Likewise.
        height: Assumed height over the true one.
        pitch: The assumed pitch is too large by this much, [rad].
        roll: The assumed roll is too far to the right by this much, [rad].

    Returns:
        The apparent point, [cm], frame car; NaN where the turned ray misses the road.

    Source:
        Own derivation; ``tests/unit/samples/test_augment.py`` compares it with two cameras.
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


@kernel
def clear(raster):
    """Mark nothing in any plane."""
    raster[0] = 0
    raster[1:] = MIDDLE


@kernel
def mark(raster, x_cm, y_cm, look, grid):
    """Mark the cell of a point; return whether it lies in the window and was not marked before.

    Args:
        raster: All planes, as :func:`lanenet.perception.edges.raster.fill_raster` writes them: in single
            precision, the last point of a cell for its looks.
        x_cm: Of the point, frame car; the next one is y.
        y_cm: Likewise.
        look: Its normal and its hues, in steps of the raster.
        grid: The window.
    """
    column = (np.float32(x_cm) - grid.left_cm) / grid.cell_cm
    row = (grid.far_cm - np.float32(y_cm)) / grid.cell_cm
    if not (column >= 0.0 and column < grid.columns and row >= 0.0 and row < grid.rows):
        return False
    i, j = int(row), int(column)
    fresh = raster[0, i, j] == 0
    raster[0, i, j] = 255
    for k in range(4):
        raster[1 + k, i, j] = np.uint8(MIDDLE + min(max(np.rint(look[k]), -STEPS), STEPS))
    return fresh


@kernel
def mark_edge(raster, ax, ay, bx, by, look, grid):
    """Mark a straight edge without holes; return how many cells it added.

    Its normal is across it, to one side or the other by the sign of ``look[0]``; that of a point is as given.
    """
    length = np.hypot(bx - ax, by - ay)
    steps = 1 + int(length / (0.7 * grid.cell_cm))
    added = 0
    turned = look.copy()
    if length > 0.0:
        across = (STEPS if look[0] >= 0.0 else -STEPS) / length
        turned[0], turned[1] = across * (by - ay), across * (ax - bx)
    for k in range(steps + 1):
        t = k / steps
        if mark(raster, ax + t * (bx - ax), ay + t * (by - ay), turned, grid):
            added += 1
    return added


@kernel
def _draw_look(rng, look):
    """Draw the direction of a point, and the hues of a thing, most often none."""
    angle = next_between(rng, 0.0, 2.0 * np.pi)
    look[0], look[1] = STEPS * np.cos(angle), STEPS * np.sin(angle)
    coloured = 1.0 if next_uniform(rng) < _COLOURED else 0.0
    look[2] = coloured * next_between(rng, -STEPS, STEPS)
    look[3] = coloured * next_between(rng, -STEPS, STEPS)


@kernel
def near_lines(edges, left_cm, right_cm, out):
    """Find which lines edge points belong to, and which points go with a line that is missing.

    Bit 0 is set for points within ``LINE_REACH_CM`` of the left line, and for those that run along it farther
    to the left: other borders of the road, which would be taken for the line if it were missing. Bit 1 is set
    likewise for the right line. Bits 2 and 3 are set for points within ``LINE_REACH_CM`` that run along the
    line, as a marking's borders do, and not across it, as most other edges.
    """
    reach = LINE_REACH_CM * LINE_REACH_CM
    for k in range(len(edges)):
        x, y = edges[k, 0], edges[k, 1]
        found = 0
        for side in range(2):
            line = left_cm if side == 0 else right_cm
            nearest, outside, along = np.inf, False, False
            for j in range(len(line) - 1):
                ax, ay = line[j, 0], line[j, 1]
                bx, by = line[j + 1, 0] - ax, line[j + 1, 1] - ay
                length = bx * bx + by * by
                t = ((x - ax) * bx + (y - ay) * by) / length if length > 0.0 else 0.0
                t = min(max(t, 0.0), 1.0)
                square = (x - ax - t * bx) ** 2 + (y - ay - t * by) ** 2
                # NaN, where a polyline is broken, is never near.
                if square < nearest:
                    lean = edges[k, 2] * bx + edges[k, 3] * by
                    nearest, along = square, lean * lean <= _LEAN * _LEAN * length
                    outside = (bx * (y - ay) - by * (x - ax) > 0.0) == (side == 0)
            if nearest <= reach:
                found |= 5 << side if along else 1 << side
            elif outside and along:
                found |= 1 << side
        out[k] = found


@kernel
def count_cells(cells, lines):
    """Count a newly marked cell for the lines along which its point runs."""
    cells[0] += (lines >> 2) & 1
    cells[1] += lines >> 3


@kernel
def presence(cells, frames, line, grid):
    """Return 1 for a line that can be seen, 0 for one that cannot, NaN between or if its place is unknown."""
    known = False
    for k in range(frames.line_start[line], frames.line_start[line + 1]):
        known = known or not np.isnan(frames.lines_cm[k, 0])
    seen_cm = cells * grid.cell_cm
    if not known or UNSEEN_CM <= seen_cm < SEEN_CM:
        return np.nan
    return 1.0 if seen_cm >= SEEN_CM else 0.0


@kernel
def draw_outline(rng, corners, grid):
    """Draw a closed outline within the window; return whether it hides the road within it.

    Args:
        rng: Stream of random numbers.
        corners: Its corners, [cm], frame car; written.
        grid: The window.
    """
    x = next_between(rng, grid.left_cm, grid.left_cm + grid.columns * grid.cell_cm)
    y = next_between(rng, grid.far_cm - grid.rows * grid.cell_cm, grid.far_cm)
    kind = next_uniform(rng)
    if kind < _SHADOW_SHARE:
        # An irregular quadrangle: a shadow, a stain, a rug. The road can be seen below it.
        size, turn = next_between(rng, *_SHADOW_CM), next_between(rng, 0.0, 2.0 * np.pi)
        for k in range(CORNERS):
            if k % 3 == 0:
                angle = turn + 2.0 * np.pi * (k + next_between(rng, -1.0, 1.0)) / CORNERS
                radius = size * next_between(rng, 0.4, 1.0)
            corners[k, 0], corners[k, 1] = x + radius * np.cos(angle), y + radius * np.sin(angle)
        return False
    if kind < _SHADOW_SHARE + _CONE_SHARE:
        radius, smear = next_between(rng, *_CONE_CM), next_between(rng, *_SMEAR)
        away = np.hypot(x, y)
        ax, ay = (x / away, y / away) if away > 0.0 else (0.0, 1.0)
        for k in range(CORNERS):
            angle = 2.0 * np.pi * k / CORNERS
            along, across = radius * np.sin(angle), radius * np.cos(angle)
            if along > 0.0:
                along *= smear
            corners[k, 0], corners[k, 1] = x + along * ax - across * ay, y + along * ay + across * ax
        return True
    wide, long = next_between(rng, *_BOX_HALF_CM[0]), next_between(rng, *_BOX_HALF_CM[1])
    turn = next_between(rng, 0.0, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    for k in range(CORNERS):
        quarter = k // 3
        along = long if quarter == 0 or quarter == 1 else -long
        across = wide if quarter == 0 or quarter == 3 else -wide
        corners[k, 0], corners[k, 1] = x + along * c - across * s, y + along * s + across * c
    return True


@kernel
def is_inside(x, y, corners):
    """Tell whether a point lies within a closed outline (even-odd rule)."""
    inside = False
    j = CORNERS - 1
    for k in range(CORNERS):
        if (corners[k, 1] > y) != (corners[j, 1] > y):
            cut = (corners[j, 0] - corners[k, 0]) * (y - corners[k, 1]) / (corners[j, 1] - corners[k, 1])
            if x < corners[k, 0] + cut:
                inside = not inside
        j = k
    return inside


@kernel
def mark_outline(raster, corners, look, grid):
    """Mark a closed outline, brighter inside or outside by the sign of ``look[0]``."""
    for k in range(CORNERS):
        a, b = corners[k], corners[(k + 1) % CORNERS]
        mark_edge(raster, a[0], a[1], b[0], b[1], look, grid)


@kernel
def add_clutter(rng, raster, count, grid, amounts):
    """Mark edges of things that are not lanes; ``count`` is the number of cells that the frame marked."""
    for _ in range(next_number(rng, amounts.clutter_segments, amounts.limit)):
        _add_edge(rng, raster, _EDGE_CM[1], grid)
    for _ in range(next_number(rng, amounts.clutter_points, amounts.limit)):
        _add_point(rng, raster, grid)
    wanted = next_amount(rng, amounts.clutter_share, amounts.limit) * count
    added, tries = 0, 0
    # A crowded raster has no room for more: stop trying.
    while added < wanted and tries < 2 * count:
        tries += 1
        if next_uniform(rng) < 0.1:
            added += _add_edge(rng, raster, (wanted - added) * grid.cell_cm, grid)
        else:
            added += _add_point(rng, raster, grid)


@kernel
def _add_edge(rng, raster, longest_cm, grid):
    """Mark a straight edge at a random place; return how many cells it added."""
    width_cm, depth_cm = grid.columns * grid.cell_cm, grid.rows * grid.cell_cm
    x = grid.left_cm + width_cm * next_uniform(rng)
    y = grid.far_cm - depth_cm * next_uniform(rng)
    angle = next_between(rng, 0.0, np.pi)
    half = 0.5 * min(next_between(rng, _EDGE_CM[0], _EDGE_CM[1]), longest_cm)
    dx, dy = half * np.cos(angle), half * np.sin(angle)
    look = np.empty(4)
    _draw_look(rng, look)
    return mark_edge(raster, x - dx, y - dy, x + dx, y + dy, look, grid)


@kernel
def _add_point(rng, raster, grid):
    """Mark a cell at a random place; return how many cells that added."""
    x = grid.left_cm + grid.columns * grid.cell_cm * next_uniform(rng)
    y = grid.far_cm - grid.rows * grid.cell_cm * next_uniform(rng)
    look = np.empty(4)
    _draw_look(rng, look)
    return 1 if mark(raster, x, y, look, grid) else 0


@kernel
def middle_dashes(rng, frames, i):
    """Copy a line of a frame to the middle of its lane, in dashes.

    Returns x and y of their points, [cm], frame car, and the edge points whose looks they have.

    The line of which the frame shows more is copied, with its blur, gaps and range. There are none if the two
    lines are not sampled alike.

    Args:
        rng: Stream of random numbers.
        frames: :class:`Frames`.
        i: The frame.
    """
    dash, gap = next_between(rng, *_DASH_CM), next_between(rng, *_GAP_CM)
    phase, off = next_uniform(rng), next_between(rng, -_OFF_MIDDLE, _OFF_MIDDLE)
    first, last = frames.edge_start[i], frames.edge_start[i + 1]
    starts = frames.line_start
    n = starts[2 * i + 1] - starts[2 * i]
    if n < 2 or starts[2 * i + 2] - starts[2 * i + 1] != n:
        return np.empty((0, 3))
    along = np.zeros(2, np.int64)
    for k in range(first, last):
        along[0] += (frames.edge_lines[k] >> 2) & 1
        along[1] += frames.edge_lines[k] >> 3
    side = 0 if along[0] >= along[1] else 1
    line, other = starts[2 * i + side], starts[2 * i + 1 - side]
    distance = np.zeros(n)
    for j in range(1, n):
        step = np.hypot(
            frames.lines_cm[line + j, 0] - frames.lines_cm[line + j - 1, 0],
            frames.lines_cm[line + j, 1] - frames.lines_cm[line + j - 1, 1],
        )
        distance[j] = distance[j - 1] + (0.0 if np.isnan(step) else step)
    points, count = np.empty((along[side], 3)), 0
    for k in range(first, last):
        if not (frames.edge_lines[k] >> (2 + side)) & 1:
            continue
        x, y = frames.edges_cm[k, 0], frames.edges_cm[k, 1]
        nearest, at = np.inf, 0
        for j in range(n):
            # NaN, where a line is broken, is never near.
            square = (x - frames.lines_cm[line + j, 0]) ** 2 + (y - frames.lines_cm[line + j, 1]) ** 2
            if square < nearest:
                nearest, at = square, j
        if (distance[at] + phase * (dash + gap)) % (dash + gap) > dash:
            continue
        px = x + (0.5 + off) * (frames.lines_cm[other + at, 0] - frames.lines_cm[line + at, 0])
        py = y + (0.5 + off) * (frames.lines_cm[other + at, 1] - frames.lines_cm[line + at, 1])
        if not np.isnan(px + py):
            points[count, 0], points[count, 1], points[count, 2] = px, py, k
            count += 1
    return points[:count]
