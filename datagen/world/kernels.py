"""The floor's inner loops, compiled: what a pixel covers of the floor, the markings and the things on it.

Each pixel is taken as the parallelogram that it covers on the road, drawn out by the car's motion during the
exposure; a border covers the part of it that an unbounded straight edge at the same distance would. Corners
multiply the two directions' shares.

All in one file on purpose: numba's cache does not notice a change of a callee that lives in another file.
``no_type_check`` keeps run-time checks of shapes away from what numba compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from datagen.world.ground import FAR, NOT_FLOOR, TEXTURE_CELL_CM, TEXTURE_LEVELS, TILE


@njit(cache=True, error_model="numpy")
@no_type_check
def fold(width_a, width_b, width_c):
    """Turn three widths, of either sign, into two, the larger first: the third goes in by its variance."""
    a, b, c = abs(width_a), abs(width_b), abs(width_c)
    if a < b:
        a, b = b, a
    if c > 0.0:
        if a < c:
            a, c = c, a
        b = np.sqrt(b * b + c * c)
        if a < b:
            a, b = b, a
    return a, b


@njit(cache=True, error_model="numpy")
@no_type_check
def inner_share(distance, a, b):
    """Share of a pixel on the inner side of an edge, by its folded widths across the edge."""
    half = 0.5 * (a + b)
    d = abs(distance)
    if d >= half:
        outside = 0.0
    elif d <= 0.5 * (a - b):
        outside = 0.5 - d / a
    else:
        outside = (half - d) * (half - d) / (2.0 * a * b)
    return 1.0 - outside if distance > 0.0 else outside


@njit(cache=True, error_model="numpy")
@no_type_check
def box_share(distance, width_a, width_b, width_c=0.0):
    """Share of a parallelogram on the inner side of an edge.

    The distance across the edge, over the pixel, is the sum of two even distributions: their distribution
    function is the share. A third one, the motion, is folded into the smaller of the two by its variance.

    Args:
        distance: From the pixel's centre to the edge, positive when the centre is inside.
        width_a: Change of the distance over one pixel in u.
        width_b: The same in v.
        width_c: The same over the exposure.

    Returns:
        0..1.
    """
    a, b = fold(width_a, width_b, width_c)
    return inner_share(distance, a, b)


@njit(cache=True, error_model="numpy")
@no_type_check
def strip_share(distance, half, width_a, width_b, width_c):
    """Share of a pixel on a strip of half width ``half``, by the distance to its middle."""
    a, b = fold(width_a, width_b, width_c)
    if abs(distance) >= half + 0.5 * (a + b):
        return 0.0
    return inner_share(distance + half, a, b) - inner_share(distance - half, a, b)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
@no_type_check
def painted_share(s, width_a, width_b, width_c, stretches, first, last):
    """Share of a pixel that lies on painted stretches along the road (rows first..last, ascending)."""
    a, b = fold(width_a, width_b, width_c)
    half = 0.5 * (a + b)
    low, high = first, last
    while low < high:  # the first stretch that ends beyond the pixel's start
        middle = (low + high) // 2
        if stretches[middle, 1] > s - half:
            high = middle
        else:
            low = middle + 1
    share = 0.0
    while low < last and stretches[low, 0] < s + half:
        share += inner_share(s - stretches[low, 0], a, b) - inner_share(s - stretches[low, 1], a, b)
        low += 1
    return min(max(share, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
@no_type_check
def sample(texture, start, side, shrink, along, across):
    """Sample one level of a square texture that repeats, at a place in cells of level 0.

    Args:
        texture: See :func:`datagen.world.textures.pack_levels`.
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


@njit(cache=True, error_model="numpy")
@no_type_check
def rectangle_share(x, y, ux, uy, vx, vy, mx, my, reach, boxes, q):
    """Share of a pixel on a rectangle: x, y, cos and sin of the direction, half length, half width, ..."""
    dx, dy, c, s = x - boxes[q, 0], y - boxes[q, 1], boxes[q, 2], boxes[q, 3]
    along, across = dx * c + dy * s, dy * c - dx * s
    if abs(along) >= boxes[q, 4] + reach or abs(across) >= boxes[q, 5] + reach:
        return 0.0
    alpha = strip_share(along, boxes[q, 4], ux * c + uy * s, vx * c + vy * s, mx * c + my * s)
    if alpha > 0.0:
        alpha *= strip_share(across, boxes[q, 5], uy * c - ux * s, vy * c - vx * s, my * c - mx * s)
    return alpha


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
@no_type_check
def paint_floor(out, width, numbers, level, tiles, origin, floor, patterns, road, things):
    """Paint every pixel that sees the floor.

    Args:
        out: Image as rows of pixels, float32, filled in place.
        width: Pixels per row, filled up.
        numbers: See :class:`datagen.world.ground.FloorHits`.
        level: See there.
        tiles: See there.
        origin: Rear-axle centre x and y.
        floor: Colour of the road's floor, colour beside the road, colour of the pattern (three each).
        patterns: Texture of the floor, texture of the wear, starts of their levels, and as numbers: strength
            of the pattern, wear; direction, two shifts, two distances, width and darkening of the joints.
        road: Grid of nearest samples, its frame (x and y of the origin, cell), nodes (see :func:`locate`),
            whether closed, markings (offset, width, blue, green, red, first and last row of the stretches),
            stretches, and the right and left border of the road.
        things: Boxes painted on the floor and clutter on it (see ``Scene.clutter``), each with its reaches.
    """
    texture, wear_texture, starts, settings = patterns
    grid, frame, nodes, closed, markings, stretches, borders = road
    boxes, box_reach, clutter, clutter_reach = things
    texture_level, wear = settings[0], settings[1]
    cj, sj = np.cos(settings[2]), np.sin(settings[2])
    height = level.shape[0] // width
    all_boxes, all_clutter = np.arange(len(boxes)), np.arange(len(clutter))
    tile_boxes, tile_clutter = np.empty_like(all_boxes), np.empty_like(all_clutter)
    near_boxes, near_clutter = np.empty_like(all_boxes), np.empty_like(all_clutter)
    origin_x, origin_y = origin[0], origin[1]
    per_cell = 1.0 / frame[2]
    per_joint_u, per_joint_v = 1.0 / max(settings[5], 1e-9), 1.0 / max(settings[6], 1e-9)
    base_side = int(np.sqrt(starts[1]) + 0.5)
    for tile in range(tiles.shape[0]):
        if tiles[tile, 0] > tiles[tile, 2]:
            continue
        top, left = tile // (width // TILE) * TILE, tile % (width // TILE) * TILE
        low_x, low_y = origin_x + tiles[tile, 0], origin_y + tiles[tile, 1]
        high_x, high_y = origin_x + tiles[tile, 2], origin_y + tiles[tile, 3]
        in_tile = list_near(low_x, low_y, high_x, high_y, boxes, box_reach, all_boxes, len(boxes), tile_boxes)
        lying = list_near(
            low_x, low_y, high_x, high_y, clutter, clutter_reach, all_clutter, len(clutter), tile_clutter
        )
        for v in range(top, min(top + TILE, height)):
            i = v * width + left
            # Slices, so that no index can be negative as far as the compiler knows.
            seen, colours, n = level[i : i + TILE], out[i : i + TILE], numbers[8 * i : 8 * (i + TILE)]
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
            for j in range(TILE):
                fits = seen[j]
                if fits == NOT_FLOOR:
                    continue
                near = fits < FAR
                fits = fits if near else fits - FAR
                shrink = 1.0 / (1 << fits)
                x, y = origin_x + n[j], origin_y + n[TILE + j]
                ux, uy, vx, vy = n[2 * TILE + j], n[3 * TILE + j], n[4 * TILE + j], n[5 * TILE + j]
                mx, my = n[6 * TILE + j], n[7 * TILE + j]
                # No edge further away than this cuts the pixel, whatever its direction.
                reach = 0.5 * (abs(ux) + abs(uy) + abs(vx) + abs(vy) + abs(mx) + abs(my))
                # Where along the road, and what of the markings.
                offset, candidate, on_grid = 1e9, -1, False
                c, sn, k_road, s_road = 1.0, 0.0, 0.0, 0.0
                verge = borders[2]
                if near:
                    column = int(np.floor((x - frame[0]) * per_cell))
                    row = int(np.floor((y - frame[1]) * per_cell))
                    on_grid = (
                        0 <= row < grid.shape[0] and 0 <= column < grid.shape[1] and grid[row, column] >= 0
                    )
                if on_grid:
                    node = grid[row, column]
                    c, sn = nodes[node, 2], nodes[node, 3]
                    offset = (y - nodes[node, 1]) * c - (x - nodes[node, 0]) * sn
                    # Most pixels lie on bare floor, which this rough offset tells.
                    for m in range(markings.shape[0]):
                        if abs(offset - markings[m, 0]) < 0.5 * markings[m, 1] + reach + 0.5:
                            candidate = m
                            break
                    if candidate >= 0:
                        s_road, offset, c, sn, k_road = locate(x, y, nodes, closed, node)
                    if verge > 0.0:
                        verge = 0.0 if borders[1] < offset < borders[0] else 1.0
                        if min(abs(offset - borders[0]), abs(offset - borders[1])) < reach:
                            acu, acv, acm = uy * c - ux * sn, vy * c - vx * sn, my * c - mx * sn
                            inside = box_share(borders[0] - offset, acu, acv, acm)
                            verge = 1.0 - inside * box_share(offset - borders[1], acu, acv, acm)
                along, across = x * cj + y * sj, y * cj - x * sj
                shade = 0.0
                if texture_level > 0.0:
                    # Drawn out by the motion: up to a few cells the next level's, which are twice as large,
                    # will do; beyond, two samples of a level whose cells are not much smaller than it.
                    blurred, motion2 = fits, (mx * mx + my * my) / (TEXTURE_CELL_CM * TEXTURE_CELL_CM)
                    twice = motion2 * shrink * shrink > 9.0
                    most = 9.0 if twice else 1.0
                    while motion2 * shrink * shrink > most and blurred < TEXTURE_LEVELS - 1:
                        blurred += 1
                        shrink *= 0.5
                        if not twice:
                            break
                    start, side = starts[blurred], base_side >> blurred
                    a, b = along / TEXTURE_CELL_CM, across / TEXTURE_CELL_CM
                    if twice:
                        step_a = 0.25 * (mx * cj + my * sj) / TEXTURE_CELL_CM
                        step_b = 0.25 * (my * cj - mx * sj) / TEXTURE_CELL_CM
                        shade = sample(texture, start, side, shrink, a - step_a, b - step_b)
                        shade += sample(texture, start, side, shrink, a + step_a, b + step_b)
                        shade *= 0.5 * texture_level
                    else:
                        shade = texture_level * sample(texture, start, side, shrink, a, b)
                if settings[5] > 0.0:
                    d = along - settings[3]
                    d -= settings[5] * np.floor(d * per_joint_u + 0.5)
                    if reach > settings[5]:  # a far pixel covers several of them
                        shade -= settings[8] * settings[7] * per_joint_u
                    elif abs(d) < 0.5 * settings[7] + reach:
                        shade -= settings[8] * strip_share(
                            d, 0.5 * settings[7], ux * cj + uy * sj, vx * cj + vy * sj, mx * cj + my * sj
                        )
                if settings[6] > 0.0:
                    d = across - settings[4]
                    d -= settings[6] * np.floor(d * per_joint_v + 0.5)
                    if reach > settings[6]:
                        shade -= settings[8] * settings[7] * per_joint_v
                    elif abs(d) < 0.5 * settings[7] + reach:
                        shade -= settings[8] * strip_share(
                            d, 0.5 * settings[7], uy * cj - ux * sj, vy * cj - vx * sj, my * cj - mx * sj
                        )
                blue = floor[0] + verge * (floor[3] - floor[0]) + shade * floor[6]
                green = floor[1] + verge * (floor[4] - floor[1]) + shade * floor[7]
                red = floor[2] + verge * (floor[5] - floor[2]) + shade * floor[8]
                fresh = 1.0
                if wear > 0.0 and (candidate >= 0 or (near and n_boxes > 0)):
                    a, b = along / TEXTURE_CELL_CM, across / TEXTURE_CELL_CM
                    worn = sample(wear_texture, starts[fits], base_side >> fits, 1.0 / (1 << fits), a, b)
                    fresh = 1.0 - min(max(1.5 * (worn - 3.0 + 3.2 * wear), 0.0), 1.0)
                if near:
                    for k in range(n_boxes):
                        q = near_boxes[k]
                        alpha = fresh * rectangle_share(x, y, ux, uy, vx, vy, mx, my, reach, boxes, q)
                        blue += alpha * (boxes[q, 6] - blue)
                        green += alpha * (boxes[q, 7] - green)
                        red += alpha * (boxes[q, 8] - red)
                if candidate >= 0:
                    acu, acv, acm = uy * c - ux * sn, vy * c - vx * sn, my * c - mx * sn
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
                if near:
                    for k in range(n_clutter):
                        q = near_clutter[k]
                        alpha = rectangle_share(x, y, ux, uy, vx, vy, mx, my, reach, clutter, q)
                        blue += alpha * (clutter[q, 6] - blue)
                        green += alpha * (clutter[q, 7] - green)
                        red += alpha * (clutter[q, 8] - red)
                colours[j, 0], colours[j, 1], colours[j, 2] = blue, green, red
