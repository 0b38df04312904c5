"""The bare floor under a row of ``TILE`` pixels, compiled: where they lie, its pattern, its joints, the road.

Plain loops over a row, one simple step each: the compiler takes many pixels at a time. What only a few pixels
need, such as the paint, follows pixel by pixel in :mod:`datagen.world.render.floor`.

``no_type_check`` keeps run-time checks of shapes away from what numba compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from datagen.world.compiled import compiled_bare
from datagen.world.render.coverage import box_share, strip_share
from datagen.world.render.ground import (
    FAR,
    NOT_FLOOR,
    TEXTURE_BITS,
    TEXTURE_CELL_CM,
    TEXTURE_LEVELS,
    TEXTURE_SIDE,
    TILE,
)

#: Where the numbers of a row of pixels start: place on the map, place along and across the floor's pattern,
#: reach (no edge further away than this cuts the pixel, whatever its direction), strength of the pattern;
#: offset from the road's centre line, share that lies beside the road; and room for two more.
X, Y, ALONG, ACROSS, REACH, SHADE, OFFSET, VERGE, A, B = range(0, 10 * TILE, TILE)
ROW_NUMBERS = 10 * TILE
#: Likewise the whole numbers: nearest sample of the centre line (-1: away from the road), first marking that
#: may cover the pixel (or -1), whether the pixel needs more than the bare floor; four cells of the pattern.
NODE, MARKING, MORE, CELL_00, CELL_01, CELL_10, CELL_11 = range(0, 7 * TILE, TILE)
ROW_INDICES = 7 * TILE


@compiled_bare
@no_type_check
def place_row(seen, n, origin_x, origin_y, cj, sj, row, index):
    """Find where a row of pixels lies.

    Args:
        seen: Level of the pixels, see :func:`datagen.world.render.ground.cast_tile`.
        n: Their numbers, see there.
        origin_x: Rear-axle centre.
        origin_y: Likewise.
        cj: Cosine of the direction of the pattern.
        sj: Sine of it.
        row: Filled: ``X`` to ``REACH``; the origin where there is no floor.
        index: Filled: ``NODE``, ``MARKING`` and ``MORE`` as away from the road.
    """
    for j in range(TILE):
        floor = seen[j] != NOT_FLOOR
        x, y = origin_x + n[j], origin_y + n[TILE + j]
        x, y = x if floor else origin_x, y if floor else origin_y
        wide = abs(n[2 * TILE + j]) + abs(n[3 * TILE + j]) + abs(n[4 * TILE + j]) + abs(n[5 * TILE + j])
        row[X + j], row[Y + j] = x, y
        row[ALONG + j], row[ACROSS + j] = x * cj + y * sj, y * cj - x * sj
        row[REACH + j] = 0.5 * (wide + abs(n[6 * TILE + j]) + abs(n[7 * TILE + j]))
        row[SHADE + j], row[OFFSET + j], row[VERGE + j] = 0.0, 1e9, 0.0
        index[NODE + j], index[MARKING + j], index[MORE + j] = -1, -1, 0


@compiled_bare
@no_type_check
def sample(texture, start, side, shrink, along, across):
    """Sample one level of a square texture that repeats, at a place in cells of level 0.

    Args:
        texture: See :func:`datagen.world.render.textures.pack_levels`.
        start: Of the level.
        side: Of the level, a power of two.
        shrink: Cells of the level per cell of level 0.
        along: Place.
        across: Place.
    """
    column, row = along * shrink, across * shrink
    mask = side - 1
    c0, r0 = int(np.floor(column)), int(np.floor(row))
    fc, fr = column - c0, row - r0
    c0, r0 = c0 & mask, r0 & mask
    c1, r1 = (c0 + 1) & mask, (r0 + 1) & mask
    r0, r1 = start + r0 * side, start + r1 * side
    upper = texture[r0 + c0] * (1.0 - fc) + texture[r0 + c1] * fc
    lower = texture[r1 + c0] * (1.0 - fc) + texture[r1 + c1] * fc
    return upper * (1.0 - fr) + lower * fr


@compiled_bare
@no_type_check
def shade_row(seen, n, texture, starts, texture_level, cj, sj, row, index):
    """Sample the floor's pattern into ``SHADE``, drawn out by the motion.

    Args:
        seen: See :func:`place_row`.
        n: See there.
        texture: See :func:`datagen.world.render.textures.pack_levels`.
        starts: Of its levels.
        texture_level: Strength of the pattern.
        cj: See :func:`place_row`.
        sj: See there.
        row: Changed.
        index: Changed.
    """
    # Neighbours mostly share one level, and the few steps below suffice.
    f = np.float32
    fits = np.int64(seen[0]) & (FAR - 1)
    scale2 = f(1.0 / (1 << fits) ** 2 / (TEXTURE_CELL_CM * TEXTURE_CELL_CM))
    mixed, above_1, above_9 = np.uint8(0), np.int32(0), np.int32(0)
    for j in range(TILE):
        mixed |= seen[j] ^ seen[0]
    for j in range(TILE):
        mx, my = n[6 * TILE + j], n[7 * TILE + j]
        cells2 = (mx * mx + my * my) * scale2
        above_1 += np.int32(cells2 > f(1.0))
        above_9 += np.int32(cells2 > f(9.0))
    if mixed != 0 or seen[0] == NOT_FLOOR or above_9 > 0 or 0 < above_1 < TILE:
        for j in range(TILE):
            if seen[j] != NOT_FLOOR:
                shade = _shade(n, j, texture, starts, cj, sj, row[ALONG + j], row[ACROSS + j], seen[j])
                row[SHADE + j] = texture_level * shade
        return
    blurred = min(fits + (1 if above_1 > 0 else 0), TEXTURE_LEVELS - 1)
    start, side, per_cell = starts[blurred], TEXTURE_SIDE >> blurred, 1.0 / (TEXTURE_CELL_CM * (1 << blurred))
    mask, bits = side - 1, TEXTURE_BITS - blurred
    for j in range(TILE):
        column = row[ALONG + j] * per_cell
        line = row[ACROSS + j] * per_cell
        whole_column, whole_line = np.floor(column), np.floor(line)
        row[A + j], row[B + j] = column - whole_column, line - whole_line
        c0, r0 = np.int64(whole_column) & mask, np.int64(whole_line) & mask
        c1, r1 = (c0 + 1) & mask, start + (((r0 + 1) & mask) << bits)
        r0 = start + (r0 << bits)
        index[CELL_00 + j], index[CELL_01 + j] = r0 + c0, r0 + c1
        index[CELL_10 + j], index[CELL_11 + j] = r1 + c0, r1 + c1
    for j in range(TILE):
        fc, fr = row[A + j], row[B + j]
        # Unsigned: no index can be negative as far as the compiler knows.
        value_00, value_01 = texture[np.uint64(index[CELL_00 + j])], texture[np.uint64(index[CELL_01 + j])]
        value_10, value_11 = texture[np.uint64(index[CELL_10 + j])], texture[np.uint64(index[CELL_11 + j])]
        upper = value_00 * (1.0 - fc) + value_01 * fc
        lower = value_10 * (1.0 - fc) + value_11 * fc
        row[SHADE + j] = texture_level * (upper * (1.0 - fr) + lower * fr)


@compiled_bare
@no_type_check
def _shade(n, j, texture, starts, cj, sj, along, across, level):
    """Sample the floor's pattern for one pixel.

    Up to a few cells of motion the next level's cells, which are twice as large, will do; beyond, two samples
    of a level whose cells are not much smaller than the motion.
    """
    blurred = np.int64(level) & (FAR - 1)
    shrink = 1.0 / (1 << blurred)
    mx, my = n[6 * TILE + j], n[7 * TILE + j]
    motion2 = (mx * mx + my * my) / (TEXTURE_CELL_CM * TEXTURE_CELL_CM)
    twice = motion2 * shrink * shrink > 9.0
    most = 9.0 if twice else 1.0
    while motion2 * shrink * shrink > most and blurred < TEXTURE_LEVELS - 1:
        blurred += 1
        shrink *= 0.5
        if not twice:
            break
    start, side = starts[blurred], TEXTURE_SIDE >> blurred
    a, b = along / TEXTURE_CELL_CM, across / TEXTURE_CELL_CM
    if not twice:
        return sample(texture, start, side, shrink, a, b)
    step_a = 0.25 * (mx * cj + my * sj) / TEXTURE_CELL_CM
    step_b = 0.25 * (my * cj - mx * sj) / TEXTURE_CELL_CM
    before = sample(texture, start, side, shrink, a - step_a, b - step_b)
    return 0.5 * (before + sample(texture, start, side, shrink, a + step_a, b + step_b))


@compiled_bare
@no_type_check
def joint_row(seen, n, place, shift, every, width, level, c, s, row):
    """Darken ``SHADE`` where the floor's joints of one direction run.

    Args:
        seen: See :func:`place_row`.
        n: See there.
        place: Row of ``row`` that holds the distance across the joints.
        shift: Where they start.
        every: Distance between them.
        width: Of a joint.
        level: Darkening.
        c: Cosine of the direction across them.
        s: Sine of it.
        row: Changed.
    """
    per_joint = 1.0 / max(every, 1e-9)
    even, half = level * width * per_joint, 0.5 * width
    hits = 0
    for j in range(TILE):
        d, reach = row[place + j] - shift, row[REACH + j]
        d -= every * np.floor(d * per_joint + 0.5)
        row[A + j] = d
        far = reach > every  # a far pixel covers several of them
        row[SHADE + j] -= even if far else 0.0
        hits += 1 if (not far) & (abs(d) < half + reach) & (seen[j] != NOT_FLOOR) else 0
    if hits == 0:
        return
    for j in range(TILE):
        d, reach = row[A + j], row[REACH + j]
        if reach <= every and abs(d) < half + reach and seen[j] != NOT_FLOOR:
            ux, uy, vx, vy = n[2 * TILE + j], n[3 * TILE + j], n[4 * TILE + j], n[5 * TILE + j]
            mx, my = n[6 * TILE + j], n[7 * TILE + j]
            row[SHADE + j] -= level * strip_share(d, half, ux * c + uy * s, vx * c + vy * s, mx * c + my * s)


@compiled_bare
@no_type_check
def road_row(seen, grid, frame, nodes, markings, borders, row, index):
    """Tell roughly where pixels lie on the road: most are on bare floor.

    Args:
        seen: See :func:`place_row`.
        grid: See :class:`datagen.world.render.nearest.NearestGrid`.
        frame: See there.
        nodes: See :func:`datagen.world.render.floor.paint_floor`.
        markings: See there.
        borders: See there.
        row: Filled: ``OFFSET``, ``VERGE``.
        index: Filled: ``NODE``, ``MARKING``, ``MORE``.

    Returns:
        How many pixels need more than the bare floor.
    """
    rows, columns, per_cell = float(grid.shape[0]), float(grid.shape[1]), 1.0 / frame[2]
    cells, samples = grid.reshape(-1), nodes.reshape(-1)
    on_grid = 0
    for j in range(TILE):
        column = np.floor((row[X + j] - frame[0]) * per_cell)
        line = np.floor((row[Y + j] - frame[1]) * per_cell)
        within = (seen[j] < FAR) & (line >= 0.0) & (line < rows) & (column >= 0.0) & (column < columns)
        cell = line * columns + column
        index[NODE + j] = np.int64(cell) if within else -1
        on_grid += 1 if within else 0
        row[VERGE + j] = borders[2]
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
                c, s = samples[k + np.uint64(2)], samples[k + np.uint64(3)]
                row[OFFSET + j] = (row[Y + j] - samples[k + np.uint64(1)]) * c - (row[X + j] - samples[k]) * s
    if on_grid == 0:
        return 0
    for m in range(markings.shape[0] - 1, -1, -1):
        middle, half = markings[m, 0], 0.5 * markings[m, 1]
        for j in range(TILE):
            close = abs(row[OFFSET + j] - middle) < half + row[REACH + j] + 0.5
            index[MARKING + j] = m if close else index[MARKING + j]
    more = 0
    for j in range(TILE):
        offset = row[OFFSET + j]
        marked = index[MARKING + j] >= 0
        border = min(abs(offset - borders[0]), abs(offset - borders[1])) < row[REACH + j]
        inside = (borders[1] < offset) & (offset < borders[0])
        row[VERGE + j] = 0.0 if inside else borders[2]
        needs = marked | (border & (borders[2] > 0.0))
        index[MORE + j] = 1 if needs else 0
        more += 1 if needs else 0
    return more


@compiled_bare
@no_type_check
def colour_row(seen, floor, row, colours):
    """Colour the bare floor; what is not floor keeps its colour."""
    d_blue, d_green, d_red = floor[3] - floor[0], floor[4] - floor[1], floor[5] - floor[2]
    for j in range(TILE):
        if seen[j] != NOT_FLOOR:
            verge, shade = row[VERGE + j], row[SHADE + j]
            colours[j, 0] = floor[0] + verge * d_blue + shade * floor[6]
            colours[j, 1] = floor[1] + verge * d_green + shade * floor[7]
            colours[j, 2] = floor[2] + verge * d_red + shade * floor[8]


@compiled_bare
@no_type_check
def verge_share(offset, acu, acv, acm, reach, borders):
    """Share of a pixel that lies beside the road, by its offset and its widths across the road."""
    if min(abs(offset - borders[0]), abs(offset - borders[1])) >= reach:
        return 0.0 if borders[1] < offset < borders[0] else 1.0
    inside = box_share(borders[0] - offset, acu, acv, acm)
    return 1.0 - inside * box_share(offset - borders[1], acu, acv, acm)
