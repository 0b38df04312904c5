"""The floor as each pixel sees it, compiled: the bare floor row by row, then what lies on it pixel by pixel.

``no_type_check`` keeps run-time checks of shapes away from what numba compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from datagen.world.compiled import compiled, compiled_bare
from datagen.world.render.bare_floor import (
    ACROSS,
    ALONG,
    MARKING,
    MORE,
    NODE,
    OFFSET,
    REACH,
    ROW_INDICES,
    ROW_NUMBERS,
    SHADE,
    VERGE,
    X,
    Y,
    colour_row,
    joint_row,
    place_row,
    road_row,
    sample,
    shade_row,
    verge_share,
)
from datagen.world.render.coverage import painted_share, rectangle_share, strip_share
from datagen.world.render.ground import (
    FAR,
    NOT_FLOOR,
    TEXTURE_CELL_CM,
    TEXTURE_SIDE,
    TILE,
    bound_tile,
    cast_tile,
)
from datagen.world.render.light import light_tile


@compiled_bare
@no_type_check
def locate(x, y, nodes, closed, start):
    """Foot of the perpendicular on the centre line, from a guess.

    Args:
        x: Position, frame map.
        y: Position, frame map.
        nodes: x, y, cos and sin of the heading, curvature, s of each sample.
        closed: Whether the last sample is followed by the first.
        start: Sample to start from.

    Returns:
        Distance along the road, offset (left positive), cos and sin of the heading there, curvature.
    """
    n = nodes.shape[0]
    i = start
    d = (x - nodes[i, 0]) ** 2 + (y - nodes[i, 1]) ** 2
    for _ in range(16):
        before, after = i - 1, i + 1
        if closed:
            before, after = before % n, after % n
        else:
            before, after = max(before, 0), min(after, n - 1)
        d_before = (x - nodes[before, 0]) ** 2 + (y - nodes[before, 1]) ** 2
        d_after = (x - nodes[after, 0]) ** 2 + (y - nodes[after, 1]) ** 2
        if d_before < d and d_before <= d_after:
            i, d = before, d_before
        elif d_after < d:
            i, d = after, d_after
        else:
            break
    c, s, k = nodes[i, 2], nodes[i, 3], nodes[i, 4]
    dx, dy = x - nodes[i, 0], y - nodes[i, 1]
    ahead, left = dx * c + dy * s, dy * c - dx * s
    # The road near a sample is the circle through it; the angle to the foot is small.
    inward = 1.0 - k * left
    along = ahead / inward if inward > 0.2 else ahead
    offset = (2.0 * left - k * (ahead * ahead + left * left)) / (1.0 + np.sqrt((k * ahead) ** 2 + inward**2))
    turn = k * along
    return nodes[i, 5] + along, offset, c - turn * s, s + turn * c, k


@compiled_bare
@no_type_check
def list_near(low_x, low_y, high_x, high_y, places, reaches, among, count, found):
    """Write which of ``among`` have a circle that touches the box into ``found``; return how many."""
    near = 0
    for k in range(count):
        q = among[k]
        reach, x, y = reaches[q], places[q, 0], places[q, 1]
        if low_x - reach < x < high_x + reach and low_y - reach < y < high_y + reach:
            found[near] = q
            near += 1
    return near


@compiled
@no_type_check
def paint_floor(out, level, rays, lowest, width, view, origin, floor, patterns, road, things, lights):
    """Paint every pixel that sees the floor, and find out which do.

    Args:
        out: Image as rows of pixels, float32, filled in place.
        level: Of each pixel, filled, see :func:`datagen.world.render.ground.cast_tile`.
        rays: See :class:`datagen.world.render.ground.PixelGround`, in one row.
        lowest: See there.
        width: Pixels per row, filled up.
        view: See :func:`datagen.world.render.ground.cast_tile`.
        origin: Rear-axle centre x and y.
        floor: Colour of the road's floor, colour beside the road, colour of the pattern (three each).
        patterns: Texture of the floor, texture of the wear, starts of their levels, and as numbers: strength
            of the pattern, wear; direction, two shifts, two distances, width and darkening of the joints.
        road: Grid of nearest samples, its frame (x and y of the origin, cell), nodes (see :func:`locate`),
            whether closed, markings (offset, width, blue, green, red, first and last row of the stretches),
            stretches, and the right and left border of the road.
        things: Boxes painted on the floor and clutter on it (see ``Scene.clutter``), each with its reaches.
        lights: See :func:`datagen.world.render.light.light_tile`.
    """
    boxes, clutter = np.arange(len(things[0])), np.arange(len(things[2]))
    lists = (
        boxes, np.empty_like(boxes), np.empty_like(boxes),
        clutter, np.empty_like(clutter), np.empty_like(clutter),
    )  # fmt: skip
    row, index = np.empty(ROW_NUMBERS), np.empty(ROW_INDICES, np.int64)
    # A tile at a time through all steps: its numbers stay in the processor's nearest memory.
    numbers, lanes = np.zeros(8 * TILE * TILE, np.float32), np.empty(5 * TILE, np.float32)
    lighting = np.empty(2 * TILE * TILE, np.float32)
    height = level.shape[0] // width
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            if not cast_tile(rays, lowest, width, view, top, left, numbers, level):
                continue
            box = bound_tile(width, height, top, left, numbers, level, lanes)
            _paint_tile(
                out, width, top, left, box, numbers, level, origin, floor, patterns, road, things, lists, row,
                index,
            )  # fmt: skip
            light_tile(out, width, top, left, box, numbers, level, origin, lights, lighting)


@compiled_bare
@no_type_check
def _paint_tile(
    out, width, top, left, box, numbers, level, origin, floor, patterns, road, things, lists, row, index
):
    """Paint a tile with buffers at hand; see :func:`paint_floor`."""
    texture, wear_texture, starts, settings = patterns
    grid, frame, nodes, closed, markings, stretches, borders = road
    boxes, box_reach, clutter, clutter_reach = things
    texture_level, wear = settings[0], settings[1]
    cj, sj = np.cos(settings[2]), np.sin(settings[2])
    all_boxes, tile_boxes, near_boxes, all_clutter, tile_clutter, near_clutter = lists
    height = level.shape[0] // width
    origin_x, origin_y = origin[0], origin[1]
    low_x, low_y = origin_x + box[0], origin_y + box[1]
    high_x, high_y = origin_x + box[2], origin_y + box[3]
    in_tile = list_near(low_x, low_y, high_x, high_y, boxes, box_reach, all_boxes, len(boxes), tile_boxes)
    lying = list_near(
        low_x, low_y, high_x, high_y, clutter, clutter_reach, all_clutter, len(clutter), tile_clutter
    )
    for v in range(top, min(top + TILE, height)):
        i = v * width + left
        # Slices, so that no index can be negative as far as the compiler knows.
        seen, colours, n = level[i : i + TILE], out[i : i + TILE], numbers[(v - top) * 8 * TILE :]
        n_boxes, n_clutter = 0, 0
        if in_tile + lying > 0:
            # Near the horizon a tile covers a lot of floor, one of its rows much less.
            low_x, low_y, high_x, high_y, spread = np.inf, np.inf, -np.inf, -np.inf, 0.0
            for j in range(TILE):
                if seen[j] != NOT_FLOOR:
                    low_x, high_x = min(low_x, n[j]), max(high_x, n[j])
                    low_y, high_y = min(low_y, n[TILE + j]), max(high_y, n[TILE + j])
                    wide = abs(n[2 * TILE + j]) + abs(n[3 * TILE + j]) + abs(n[4 * TILE + j])
                    spread = max(
                        spread, wide + abs(n[5 * TILE + j]) + abs(n[6 * TILE + j]) + abs(n[7 * TILE + j])
                    )
            low_x, low_y = low_x + origin_x - spread, low_y + origin_y - spread
            high_x, high_y = high_x + origin_x + spread, high_y + origin_y + spread
            n_boxes = list_near(
                low_x, low_y, high_x, high_y, boxes, box_reach, tile_boxes, in_tile, near_boxes
            )
            n_clutter = list_near(
                low_x, low_y, high_x, high_y, clutter, clutter_reach, tile_clutter, lying, near_clutter
            )
        place_row(seen, n, origin_x, origin_y, cj, sj, row, index)
        if texture_level > 0.0:
            shade_row(seen, n, texture, starts, texture_level, cj, sj, row, index)
        if settings[5] > 0.0:
            joint_row(seen, n, ALONG, settings[3], settings[5], settings[7], settings[8], cj, sj, row)
        if settings[6] > 0.0:
            joint_row(seen, n, ACROSS, settings[4], settings[6], settings[7], settings[8], -sj, cj, row)
        more = road_row(seen, grid, frame, nodes, markings, borders, row, index)
        colour_row(seen, floor, row, colours)
        if more + n_boxes + n_clutter == 0:
            continue
        for j in range(TILE):
            if seen[j] >= FAR or index[MORE + j] + n_boxes + n_clutter == 0:
                continue
            x, y, reach = row[X + j], row[Y + j], row[REACH + j]
            ux, uy, vx, vy = n[2 * TILE + j], n[3 * TILE + j], n[4 * TILE + j], n[5 * TILE + j]
            mx, my = n[6 * TILE + j], n[7 * TILE + j]
            offset, candidate, node = row[OFFSET + j], index[MARKING + j], index[NODE + j]
            verge, shade = row[VERGE + j], row[SHADE + j]
            c, sn, k_road, s_road = 1.0, 0.0, 0.0, 0.0
            acu, acv, acm = 0.0, 0.0, 0.0
            if index[MORE + j]:
                c, sn = nodes[node, 2], nodes[node, 3]
                if candidate >= 0:
                    s_road, offset, c, sn, k_road = locate(x, y, nodes, closed, node)
                acu, acv, acm = uy * c - ux * sn, vy * c - vx * sn, my * c - mx * sn
                if borders[2] > 0.0:
                    verge = verge_share(offset, acu, acv, acm, reach, borders)
            blue = floor[0] + verge * (floor[3] - floor[0]) + shade * floor[6]
            green = floor[1] + verge * (floor[4] - floor[1]) + shade * floor[7]
            red = floor[2] + verge * (floor[5] - floor[2]) + shade * floor[8]
            fresh = 1.0
            if wear > 0.0 and (candidate >= 0 or n_boxes > 0):
                a, b, fits = (
                    row[ALONG + j] / TEXTURE_CELL_CM,
                    row[ACROSS + j] / TEXTURE_CELL_CM,
                    seen[j] & (FAR - 1),
                )
                worn = sample(wear_texture, starts[fits], TEXTURE_SIDE >> fits, 1.0 / (1 << fits), a, b)
                fresh = 1.0 - min(max(1.5 * (worn - 3.0 + 3.2 * wear), 0.0), 1.0)
            for k in range(n_boxes):
                q = near_boxes[k]
                alpha = fresh * rectangle_share(x, y, ux, uy, vx, vy, mx, my, reach, boxes, q)
                blue += alpha * (boxes[q, 6] - blue)
                green += alpha * (boxes[q, 7] - green)
                red += alpha * (boxes[q, 8] - red)
            if candidate >= 0:
                scale = 1.0 / max(1.0 - k_road * offset, 0.2)
                alu, alv = (ux * c + uy * sn) * scale, (vx * c + vy * sn) * scale
                alm = (mx * c + my * sn) * scale
                for m in range(candidate, markings.shape[0]):
                    if abs(offset - markings[m, 0]) >= 0.5 * markings[m, 1] + reach:
                        continue
                    alpha = strip_share(offset - markings[m, 0], 0.5 * markings[m, 1], acu, acv, acm)
                    if alpha > 0.0:
                        first, last = int(markings[m, 5]), int(markings[m, 6])
                        alpha *= fresh * painted_share(s_road, alu, alv, alm, stretches, first, last)
                        blue += alpha * (markings[m, 2] - blue)
                        green += alpha * (markings[m, 3] - green)
                        red += alpha * (markings[m, 4] - red)
            for k in range(n_clutter):
                q = near_clutter[k]
                alpha = rectangle_share(x, y, ux, uy, vx, vy, mx, my, reach, clutter, q)
                blue += alpha * (clutter[q, 6] - blue)
                green += alpha * (clutter[q, 7] - green)
                red += alpha * (clutter[q, 8] - red)
            colours[j, 0], colours[j, 1], colours[j, 2] = blue, green, red
