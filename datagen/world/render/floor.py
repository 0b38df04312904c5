"""The floor as each pixel sees it, compiled: the bare floor row by row, then what lies on it pixel by pixel.

The bare floor (pattern, joints, rough place on the road) is drawn by plain loops over rows of ``TILE``
pixels, one simple step each, so that the compiler takes many pixels at a time. What only a few pixels need,
such as paint, follows pixel by pixel.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int

from datagen.world.render.compiled import (
    AT_X,
    AT_Y,
    BLUE,
    FAR,
    FLOOR_NUMBERS,
    MOVE_X,
    MOVE_Y,
    NOT_FLOOR,
    TILE,
    U_X,
    U_Y,
    V_X,
    V_Y,
    X,
    Y,
    compiled,
    compiled_bare,
    edge_share,
    painted_share,
    rectangle_share,
    strip_share,
    widths_along,
)
from datagen.world.render.ground import (
    BOUND_NUMBERS,
    TEXTURE_BITS,
    TEXTURE_CELL_CM,
    TEXTURE_LEVELS,
    TEXTURE_SIDE,
    bound_tile,
    cast_tile,
)
from datagen.world.render.light import light_tile


class Surface(NamedTuple):
    """What the floor is made of.

    Attributes:
        floor_bgr: Colour of the road's floor.
        verge_bgr: Colour beside the road.
        pattern_bgr: Factor on the pattern in each channel.
        pattern: Texture of the floor, see :func:`datagen.world.render.textures.pack_levels`.
        wear_pattern: Texture by which paint wears off.
        starts: Where the levels of both start.
        level: Strength of the pattern, grey levels.
        wear: 0 (fresh) to 1 (about half of the paint is worn off).
        joint_rad: Direction of pattern and joints.
        joint_shift_cm: Where the joints of both directions start.
        joint_every_cm: Distance between them; 0: none.
        joint_width_cm: Of a joint.
        joint_level: How much darker the joints are.
    """

    floor_bgr: Float[np.ndarray, "3"]
    verge_bgr: Float[np.ndarray, "3"]
    pattern_bgr: Float[np.ndarray, "3"]
    pattern: Float32[np.ndarray, "packed"]
    wear_pattern: Float32[np.ndarray, "packed"]
    starts: Int[np.ndarray, "starts"]
    level: float
    wear: float
    joint_rad: float
    joint_shift_cm: Float[np.ndarray, "2"]
    joint_every_cm: Float[np.ndarray, "2"]
    joint_width_cm: float
    joint_level: float


#: Columns of ``Road.nodes``.
NODE_X, NODE_Y, NODE_COS, NODE_SIN, NODE_CURVATURE, NODE_S = range(6)
#: Columns of ``Road.markings``: three hold the colour; the last two are rows of ``Road.painted``.
OFFSET, WIDTH, MARKING_BLUE, _, _, FIRST, LAST = range(7)


class Road(NamedTuple):
    """The road near the car.

    Attributes:
        grid: Nearest sample of the centre line by cell, -1 away from the road.
        grid_origin_cm: x and y of the grid's corner and the size of a cell.
        nodes: Samples of the centre line: place, direction, curvature and distance along the road.
        closed: Whether the last sample is followed by the first.
        markings: Lines: offset, width, colour and rows of ``painted``.
        painted: Painted sections, from and to along the road; on a loop they go on beyond both ends.
        left_cm: Offset of the road's left border.
        right_cm: Offset of its right border.
        has_verge: Whether the floor beside the road has a colour of its own.
    """

    grid: Int[np.ndarray, "r c"]
    grid_origin_cm: Float[np.ndarray, "3"]
    nodes: Float[np.ndarray, "n 6"]
    closed: bool
    markings: Float[np.ndarray, "m 7"]
    painted: Float[np.ndarray, "k 2"]
    left_cm: float
    right_cm: float
    has_verge: bool


class FlatThings(NamedTuple):
    """Rectangles on the floor, and how far each reaches from its middle, [cm].

    Attributes:
        boxes: Painted on the road; they wear off.
        box_reaches: Of the boxes.
        clutter: Lies on the floor.
        clutter_reaches: Of the clutter.
    """

    boxes: Float[np.ndarray, "b 9"]
    box_reaches: Float[np.ndarray, "b"]
    clutter: Float[np.ndarray, "t 9"]
    clutter_reaches: Float[np.ndarray, "t"]


#: Where the numbers of a row of pixels start: place on the map, place along and across the floor's pattern,
#: reach (no edge further away than this cuts the pixel, whatever its direction), strength of the pattern,
#: offset from the road's centre line, share that lies beside the road; and two for passing use.
MAP_X, MAP_Y, ALONG, ACROSS, REACH, SHADE, ROAD_OFFSET, VERGE, PART_A, PART_B = range(0, 10 * TILE, TILE)
ROW_NUMBERS = 10 * TILE
#: Likewise the integers: nearest sample of the centre line (-1: away from the road), first marking that may
#: cover the pixel (or -1), whether the pixel needs more than the bare floor; four cells of the pattern.
NODE, MARKING, MORE, CELL_00, CELL_01, CELL_10, CELL_11 = range(0, 7 * TILE, TILE)
ROW_INDICES = 7 * TILE


@compiled
@no_type_check
def paint_floor(canvas, ground, view, surface, road, things, lights):
    """Paint every pixel that sees the floor, and find out which do.

    Args:
        canvas: Painted in place.
        ground: The camera's rays.
        view: The frame.
        surface: The bare floor.
        road: Its lines.
        things: On the floor.
        lights: Shadows and lamps.
    """
    boxes, clutter = np.arange(len(things.boxes)), np.arange(len(things.clutter))
    lists = (
        boxes, np.empty_like(boxes), np.empty_like(boxes),
        clutter, np.empty_like(clutter), np.empty_like(clutter),
    )  # fmt: skip
    row, index = np.empty(ROW_NUMBERS), np.empty(ROW_INDICES, np.int64)
    # A tile at a time through all steps: its numbers stay in the processor's nearest memory.
    numbers, lanes = np.zeros(TILE * FLOOR_NUMBERS, np.float32), np.empty(BOUND_NUMBERS, np.float32)
    lighting = np.empty(2 * TILE * TILE, np.float32)
    for top in range(0, ground.height, TILE):
        for left in range(0, ground.stride, TILE):
            if not cast_tile(canvas, ground, view, top, left, numbers):
                continue
            box = bound_tile(canvas, ground, top, left, numbers, lanes)
            _paint_tile(
                canvas, ground, view, top, left, box, numbers, surface, road, things, lists, row, index
            )
            light_tile(canvas, ground, view, top, left, box, numbers, lights, lighting)


@compiled_bare
@no_type_check
def _paint_tile(canvas, ground, view, top, left, box, numbers, surface, road, things, lists, row, index):
    """Paint a tile with buffers at hand; see :func:`paint_floor`."""
    boxes, clutter, nodes, markings = things.boxes, things.clutter, road.nodes, road.markings
    c, s = np.cos(surface.joint_rad), np.sin(surface.joint_rad)
    shift, every = surface.joint_shift_cm, surface.joint_every_cm
    joint_width, joint_level = surface.joint_width_cm, surface.joint_level
    floor, verge_bgr, pattern_bgr = surface.floor_bgr, surface.verge_bgr, surface.pattern_bgr
    all_boxes, tile_boxes, near_boxes, all_clutter, tile_clutter, near_clutter = lists
    x0, y0 = view.pose[0], view.pose[1]
    bounds = x0 + box[0], y0 + box[1], x0 + box[2], y0 + box[3]
    in_tile = _list_near(bounds, boxes, things.box_reaches, all_boxes, len(boxes), tile_boxes)
    lying = _list_near(bounds, clutter, things.clutter_reaches, all_clutter, len(clutter), tile_clutter)
    for v in range(top, min(top + TILE, ground.height)):
        i = v * ground.stride + left
        # Slices, so that no index can be negative as far as the compiler knows.
        seen, colours = canvas.level[i : i + TILE], canvas.light[i : i + TILE]
        n = numbers[(v - top) * FLOOR_NUMBERS :]
        n_boxes, n_clutter = 0, 0
        if in_tile + lying > 0:
            # Near the horizon a tile covers a lot of floor, one of its rows much less.
            bounds = _bound_row(seen, n, x0, y0)
            n_boxes = _list_near(bounds, boxes, things.box_reaches, tile_boxes, in_tile, near_boxes)
            n_clutter = _list_near(bounds, clutter, things.clutter_reaches, tile_clutter, lying, near_clutter)
        place_row(seen, n, x0, y0, c, s, row, index)
        if surface.level > 0.0:
            shade_row(seen, n, surface.pattern, surface.starts, surface.level, c, s, row, index)
        if every[0] > 0.0:
            _joint_row(seen, n, ALONG, shift[0], every[0], joint_width, joint_level, c, s, row)
        if every[1] > 0.0:
            _joint_row(seen, n, ACROSS, shift[1], every[1], joint_width, joint_level, -s, c, row)
        more = _road_row(seen, road, row, index)
        _colour_row(seen, floor, verge_bgr, pattern_bgr, row, colours)
        if more + n_boxes + n_clutter == 0:
            continue
        for j in range(TILE):
            if seen[j] >= FAR or index[MORE + j] + n_boxes + n_clutter == 0:
                continue
            x, y, reach = row[MAP_X + j], row[MAP_Y + j], row[REACH + j]
            moves = n[MOVE_X + j], n[MOVE_Y + j]
            pixel = (x, y, reach, n[U_X + j], n[U_Y + j], n[V_X + j], n[V_Y + j], moves[0], moves[1])
            offset, candidate, node = row[ROAD_OFFSET + j], index[MARKING + j], index[NODE + j]
            verge, shade = row[VERGE + j], row[SHADE + j]
            road_c, road_s, curvature, place = 1.0, 0.0, 0.0, 0.0
            across = (0.0, 0.0, 0.0)
            if index[MORE + j]:
                road_c, road_s = nodes[node, NODE_COS], nodes[node, NODE_SIN]
                if candidate >= 0:
                    place, offset, road_c, road_s, curvature = locate(x, y, nodes, road.closed, node)
                across = widths_along(pixel, -road_s, road_c)
                if road.has_verge:
                    verge = _verge_share(offset, across, reach, road)
            bgr = (
                floor[0] + verge * (verge_bgr[0] - floor[0]) + shade * pattern_bgr[0],
                floor[1] + verge * (verge_bgr[1] - floor[1]) + shade * pattern_bgr[1],
                floor[2] + verge * (verge_bgr[2] - floor[2]) + shade * pattern_bgr[2],
            )
            fresh = 1.0
            if surface.wear > 0.0 and (candidate >= 0 or n_boxes > 0):
                a, b = row[ALONG + j] / TEXTURE_CELL_CM, row[ACROSS + j] / TEXTURE_CELL_CM
                level = seen[j] & (FAR - 1)
                worn = _sample(surface.wear_pattern, surface.starts, level, 1.0 / (1 << level), a, b)
                fresh = 1.0 - min(max(1.5 * (worn - 3.0 + 3.2 * surface.wear), 0.0), 1.0)
            for k in range(n_boxes):
                q = near_boxes[k]
                bgr = _blend(bgr, fresh * rectangle_share(pixel, boxes[q]), boxes[q], BLUE)
            if candidate >= 0:
                scale = 1.0 / max(1.0 - curvature * offset, 0.2)
                wu, wv, wm = widths_along(pixel, road_c, road_s)
                along = (wu * scale, wv * scale, wm * scale)
                for m in range(candidate, markings.shape[0]):
                    aside, half = offset - markings[m, OFFSET], 0.5 * markings[m, WIDTH]
                    if abs(aside) >= half + reach:
                        continue
                    alpha = strip_share(aside, half, across)
                    if alpha > 0.0:
                        first, last = int(markings[m, FIRST]), int(markings[m, LAST])
                        alpha *= fresh * painted_share(place, along, road.painted, first, last)
                        bgr = _blend(bgr, alpha, markings[m], MARKING_BLUE)
            for k in range(n_clutter):
                q = near_clutter[k]
                bgr = _blend(bgr, rectangle_share(pixel, clutter[q]), clutter[q], BLUE)
            colours[j, 0], colours[j, 1], colours[j, 2] = bgr


@compiled_bare
@no_type_check
def _blend(bgr, alpha, row, first):
    """Cover a colour by that of a row, which begins at column ``first``, with the opacity ``alpha``."""
    blue, green, red = bgr
    return (
        blue + alpha * (row[first] - blue),
        green + alpha * (row[first + 1] - green),
        red + alpha * (row[first + 2] - red),
    )


@compiled_bare
@no_type_check
def locate(x, y, nodes, closed, start):
    """Foot of the perpendicular on the centre line, from a guess.

    Args:
        x: Position, frame map.
        y: Position, frame map.
        nodes: See :class:`Road`.
        closed: Whether the last sample is followed by the first.
        start: Sample to start from.

    Returns:
        Distance along the road, offset (left positive), cosine and sine of the heading there, curvature.
    """
    n = nodes.shape[0]
    i = start
    d = (x - nodes[i, NODE_X]) ** 2 + (y - nodes[i, NODE_Y]) ** 2
    for _ in range(16):
        before, after = i - 1, i + 1
        if closed:
            before, after = before % n, after % n
        else:
            before, after = max(before, 0), min(after, n - 1)
        d_before = (x - nodes[before, NODE_X]) ** 2 + (y - nodes[before, NODE_Y]) ** 2
        d_after = (x - nodes[after, NODE_X]) ** 2 + (y - nodes[after, NODE_Y]) ** 2
        if d_before < d and d_before <= d_after:
            i, d = before, d_before
        elif d_after < d:
            i, d = after, d_after
        else:
            break
    c, s, k = nodes[i, NODE_COS], nodes[i, NODE_SIN], nodes[i, NODE_CURVATURE]
    dx, dy = x - nodes[i, NODE_X], y - nodes[i, NODE_Y]
    ahead, left = dx * c + dy * s, dy * c - dx * s
    # The road near a sample is the circle through it; the angle to the foot is small.
    inward = 1.0 - k * left
    along = ahead / inward if inward > 0.2 else ahead
    offset = (2.0 * left - k * (ahead * ahead + left * left)) / (1.0 + np.sqrt((k * ahead) ** 2 + inward**2))
    turn = k * along
    return nodes[i, NODE_S] + along, offset, c - turn * s, s + turn * c, k


@compiled_bare
@no_type_check
def _list_near(bounds, places, reaches, among, count, found):
    """Write which of ``among`` have a circle that touches the box into ``found``; return how many."""
    low_x, low_y, high_x, high_y = bounds
    near = 0
    for k in range(count):
        q = among[k]
        reach, x, y = reaches[q], places[q, X], places[q, Y]
        if low_x - reach < x < high_x + reach and low_y - reach < y < high_y + reach:
            found[near] = q
            near += 1
    return near


@compiled_bare
@no_type_check
def _bound_row(seen, n, x0, y0):
    """Box of the map that a row of pixels covers; see :func:`place_row`."""
    low_x, low_y, high_x, high_y, spread = np.inf, np.inf, -np.inf, -np.inf, 0.0
    for j in range(TILE):
        if seen[j] != NOT_FLOOR:
            low_x, high_x = min(low_x, n[AT_X + j]), max(high_x, n[AT_X + j])
            low_y, high_y = min(low_y, n[AT_Y + j]), max(high_y, n[AT_Y + j])
            wide = abs(n[U_X + j]) + abs(n[U_Y + j]) + abs(n[V_X + j])
            spread = max(spread, wide + abs(n[V_Y + j]) + abs(n[MOVE_X + j]) + abs(n[MOVE_Y + j]))
    return low_x + x0 - spread, low_y + y0 - spread, high_x + x0 + spread, high_y + y0 + spread


@compiled_bare
@no_type_check
def place_row(seen, n, x0, y0, c, s, row, index):
    """Find where a row of pixels lies.

    Args:
        seen: Level of the pixels, see :class:`datagen.world.render.ground.Canvas`.
        n: Their floor numbers, see :data:`datagen.world.render.compiled.AT_X`.
        x0: Rear-axle centre.
        y0: Rear-axle centre.
        c: Cosine of the direction of the pattern.
        s: Sine of it.
        row: Filled: ``MAP_X`` to ``REACH``, where there is no floor with the rear axle's place; the rest as
            away from the road.
        index: Filled: ``NODE``, ``MARKING`` and ``MORE`` as away from the road.
    """
    for j in range(TILE):
        floor = seen[j] != NOT_FLOOR
        x, y = x0 + n[AT_X + j], y0 + n[AT_Y + j]
        x, y = x if floor else x0, y if floor else y0
        wide = abs(n[U_X + j]) + abs(n[U_Y + j]) + abs(n[V_X + j]) + abs(n[V_Y + j])
        row[MAP_X + j], row[MAP_Y + j] = x, y
        row[ALONG + j], row[ACROSS + j] = x * c + y * s, y * c - x * s
        row[REACH + j] = 0.5 * (wide + abs(n[MOVE_X + j]) + abs(n[MOVE_Y + j]))
        row[SHADE + j], row[ROAD_OFFSET + j], row[VERGE + j] = 0.0, 1e9, 0.0
        index[NODE + j], index[MARKING + j], index[MORE + j] = -1, -1, 0


@compiled_bare
@no_type_check
def _sample(texture, starts, level, shrink, along, across):
    """Sample a level of a repeating texture; ``shrink`` is 1 / 2**level, the place in cells of level 0."""
    side = TEXTURE_SIDE >> level
    column, row = along * shrink, across * shrink
    mask = side - 1
    c0, r0 = int(np.floor(column)), int(np.floor(row))
    fc, fr = column - c0, row - r0
    c0, r0 = c0 & mask, r0 & mask
    c1, r1 = (c0 + 1) & mask, (r0 + 1) & mask
    r0, r1 = starts[level] + r0 * side, starts[level] + r1 * side
    upper = texture[r0 + c0] * (1.0 - fc) + texture[r0 + c1] * fc
    lower = texture[r1 + c0] * (1.0 - fc) + texture[r1 + c1] * fc
    return upper * (1.0 - fr) + lower * fr


@compiled_bare
@no_type_check
def shade_row(seen, n, texture, starts, strength, c, s, row, index):
    """Sample the floor's pattern into ``SHADE``, drawn out by the motion.

    Arguments as of :func:`place_row` and :class:`Surface`; ``strength`` is the pattern's.
    """
    # Neighbours mostly share one level, and the few steps below suffice.
    f = np.float32
    level = np.int64(seen[0]) & (FAR - 1)
    scale2 = f(1.0 / (1 << level) ** 2 / (TEXTURE_CELL_CM * TEXTURE_CELL_CM))
    mixed, above_1, above_9 = np.uint8(0), np.int32(0), np.int32(0)
    for j in range(TILE):
        mixed |= seen[j] ^ seen[0]
    for j in range(TILE):
        mx, my = n[MOVE_X + j], n[MOVE_Y + j]
        cells2 = (mx * mx + my * my) * scale2
        above_1 += np.int32(cells2 > f(1.0))
        above_9 += np.int32(cells2 > f(9.0))
    if mixed != 0 or seen[0] == NOT_FLOOR or above_9 > 0 or 0 < above_1 < TILE:
        for j in range(TILE):
            if seen[j] != NOT_FLOOR:
                move = n[MOVE_X + j], n[MOVE_Y + j]
                shade = _shade(move, texture, starts, c, s, row[ALONG + j], row[ACROSS + j], seen[j])
                row[SHADE + j] = strength * shade
        return
    level = min(level + (1 if above_1 > 0 else 0), TEXTURE_LEVELS - 1)
    start, side, per_cell = starts[level], TEXTURE_SIDE >> level, 1.0 / (TEXTURE_CELL_CM * (1 << level))
    mask, bits = side - 1, TEXTURE_BITS - level
    for j in range(TILE):
        column, line = row[ALONG + j] * per_cell, row[ACROSS + j] * per_cell
        whole_column, whole_line = np.floor(column), np.floor(line)
        row[PART_A + j], row[PART_B + j] = column - whole_column, line - whole_line
        c0, r0 = np.int64(whole_column) & mask, np.int64(whole_line) & mask
        c1, r1 = (c0 + 1) & mask, start + (((r0 + 1) & mask) << bits)
        r0 = start + (r0 << bits)
        index[CELL_00 + j], index[CELL_01 + j] = r0 + c0, r0 + c1
        index[CELL_10 + j], index[CELL_11 + j] = r1 + c0, r1 + c1
    for j in range(TILE):
        fc, fr = row[PART_A + j], row[PART_B + j]
        # Unsigned: no index can be negative as far as the compiler knows.
        value_00, value_01 = texture[np.uint64(index[CELL_00 + j])], texture[np.uint64(index[CELL_01 + j])]
        value_10, value_11 = texture[np.uint64(index[CELL_10 + j])], texture[np.uint64(index[CELL_11 + j])]
        upper = value_00 * (1.0 - fc) + value_01 * fc
        lower = value_10 * (1.0 - fc) + value_11 * fc
        row[SHADE + j] = strength * (upper * (1.0 - fr) + lower * fr)


@compiled_bare
@no_type_check
def _shade(move, texture, starts, c, s, along, across, seen):
    """Sample the floor's pattern for one pixel.

    For a motion of up to a few cells the next level's cells, which are twice as large, will do; beyond, two
    samples of a level whose cells are not much smaller than the motion.
    """
    level = np.int64(seen) & (FAR - 1)
    shrink = 1.0 / (1 << level)
    mx, my = move
    motion2 = (mx * mx + my * my) / (TEXTURE_CELL_CM * TEXTURE_CELL_CM)
    twice = motion2 * shrink * shrink > 9.0
    most = 9.0 if twice else 1.0
    while motion2 * shrink * shrink > most and level < TEXTURE_LEVELS - 1:
        level += 1
        shrink *= 0.5
        if not twice:
            break
    a, b = along / TEXTURE_CELL_CM, across / TEXTURE_CELL_CM
    if not twice:
        return _sample(texture, starts, level, shrink, a, b)
    step_a = 0.25 * (mx * c + my * s) / TEXTURE_CELL_CM
    step_b = 0.25 * (my * c - mx * s) / TEXTURE_CELL_CM
    before = _sample(texture, starts, level, shrink, a - step_a, b - step_b)
    return 0.5 * (before + _sample(texture, starts, level, shrink, a + step_a, b + step_b))


@compiled_bare
@no_type_check
def _joint_row(seen, n, place, shift, every, width, darker, c, s, row):
    """Darken ``SHADE`` where the floor's joints of one direction run.

    Args:
        seen: See :func:`place_row`.
        n: See :func:`place_row`.
        place: Which number of ``row`` is the distance across the joints.
        shift: Where they start.
        every: Distance between them.
        width: Of a joint.
        darker: How much darker they are.
        c: Cosine of the direction across them.
        s: Sine of it.
        row: Changed.
    """
    per_joint = 1.0 / max(every, 1e-9)
    even, half = darker * width * per_joint, 0.5 * width
    hits = 0
    for j in range(TILE):
        d, reach = row[place + j] - shift, row[REACH + j]
        d -= every * np.floor(d * per_joint + 0.5)
        row[PART_A + j] = d
        far = reach > every  # a far pixel covers several of them
        row[SHADE + j] -= even if far else 0.0
        hits += 1 if (not far) & (abs(d) < half + reach) & (seen[j] != NOT_FLOOR) else 0
    if hits == 0:
        return
    for j in range(TILE):
        d, reach = row[PART_A + j], row[REACH + j]
        if reach <= every and abs(d) < half + reach and seen[j] != NOT_FLOOR:
            width_u, width_v = n[U_X + j] * c + n[U_Y + j] * s, n[V_X + j] * c + n[V_Y + j] * s
            width_move = n[MOVE_X + j] * c + n[MOVE_Y + j] * s
            row[SHADE + j] -= darker * strip_share(d, half, (width_u, width_v, width_move))


@compiled_bare
@no_type_check
def _road_row(seen, road, row, index):
    """Find roughly where pixels lie on the road: ``ROAD_OFFSET``, ``VERGE``, and all three indices.

    Returns:
        How many pixels need more than the bare floor, which most do not.
    """
    grid, origin, beside = road.grid, road.grid_origin_cm, 1.0 if road.has_verge else 0.0
    rows, columns, per_cell = float(grid.shape[0]), float(grid.shape[1]), 1.0 / origin[2]
    cells, samples = grid.reshape(-1), road.nodes.reshape(-1)
    on_grid = 0
    for j in range(TILE):
        column = np.floor((row[MAP_X + j] - origin[0]) * per_cell)
        line = np.floor((row[MAP_Y + j] - origin[1]) * per_cell)
        within = (seen[j] < FAR) & (line >= 0.0) & (line < rows) & (column >= 0.0) & (column < columns)
        cell = line * columns + column
        index[NODE + j] = np.int64(cell) if within else -1
        on_grid += 1 if within else 0
        row[VERGE + j] = beside
    if on_grid == 0:
        return 0
    on_grid = 0
    for j in range(TILE):
        cell = index[NODE + j]
        if cell >= 0:
            node = cells[np.uint64(cell)]
            index[NODE + j] = node
            if node >= 0:
                on_grid += 1
                k = np.uint64(6 * node)
                c, s = samples[k + np.uint64(NODE_COS)], samples[k + np.uint64(NODE_SIN)]
                dx, dy = row[MAP_X + j] - samples[k], row[MAP_Y + j] - samples[k + np.uint64(NODE_Y)]
                row[ROAD_OFFSET + j] = dy * c - dx * s
    if on_grid == 0:
        return 0
    for m in range(road.markings.shape[0] - 1, -1, -1):
        middle, half = road.markings[m, OFFSET], 0.5 * road.markings[m, WIDTH]
        for j in range(TILE):
            close = abs(row[ROAD_OFFSET + j] - middle) < half + row[REACH + j] + 0.5
            index[MARKING + j] = m if close else index[MARKING + j]
    more = 0
    for j in range(TILE):
        offset = row[ROAD_OFFSET + j]
        marked = index[MARKING + j] >= 0
        border = min(abs(offset - road.left_cm), abs(offset - road.right_cm)) < row[REACH + j]
        inside = (road.right_cm < offset) & (offset < road.left_cm)
        row[VERGE + j] = 0.0 if inside else beside
        needs = marked | (border & (beside > 0.0))
        index[MORE + j] = 1 if needs else 0
        more += 1 if needs else 0
    return more


@compiled_bare
@no_type_check
def _colour_row(seen, floor, verge_bgr, pattern_bgr, row, colours):
    """Colour the bare floor; what is not floor keeps its colour."""
    d_blue, d_green, d_red = verge_bgr[0] - floor[0], verge_bgr[1] - floor[1], verge_bgr[2] - floor[2]
    for j in range(TILE):
        if seen[j] != NOT_FLOOR:
            verge, shade = row[VERGE + j], row[SHADE + j]
            colours[j, 0] = floor[0] + verge * d_blue + shade * pattern_bgr[0]
            colours[j, 1] = floor[1] + verge * d_green + shade * pattern_bgr[1]
            colours[j, 2] = floor[2] + verge * d_red + shade * pattern_bgr[2]


@compiled_bare
@no_type_check
def _verge_share(offset, across, reach, road):
    """Share of a pixel that lies beside the road, by its offset and its widths across the road."""
    if min(abs(offset - road.left_cm), abs(offset - road.right_cm)) >= reach:
        return 0.0 if road.right_cm < offset < road.left_cm else 1.0
    inside = edge_share(road.left_cm - offset, across)
    return 1.0 - inside * edge_share(offset - road.right_cm, across)
