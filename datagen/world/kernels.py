"""The inner loops of the renderer, compiled: what a pixel covers, floor, room, sensor.

Each pixel is taken as the parallelogram that it covers on the road; a border covers the part of it that an
unbounded straight edge at the same distance would, exactly. Corners multiply the two directions' shares.

All in one file on purpose: numba's cache does not notice a change of a callee that lives in another file.
``no_type_check`` keeps run-time checks of shapes away from what numba compiles.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
@no_type_check
def box_share(distance, width_a, width_b):
    """Share of a parallelogram on the inner side of an edge.

    The distance across the edge, over the pixel, is the sum of two even distributions: their distribution
    function is the share.

    Args:
        distance: From the pixel's centre to the edge, positive when the centre is inside.
        width_a: Change of the distance over one pixel in u.
        width_b: The same in v.

    Returns:
        0..1.
    """
    a, b = abs(width_a), abs(width_b)
    if a < b:
        a, b = b, a
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
def painted_share(s, width_a, width_b, stretches, first, last):
    """Share of a pixel that lies on painted stretches along the road (rows first..last, ascending)."""
    half = 0.5 * (abs(width_a) + abs(width_b))
    low, high = first, last
    while low < high:  # the first stretch that ends beyond the pixel's start
        middle = (low + high) // 2
        if stretches[middle, 1] > s - half:
            high = middle
        else:
            low = middle + 1
    share = 0.0
    while low < last and stretches[low, 0] < s + half:
        share += box_share(s - stretches[low, 0], width_a, width_b)
        share -= box_share(s - stretches[low, 1], width_a, width_b)
        low += 1
    return min(max(share, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
@no_type_check
def bilinear(texture, column, row):
    """Sample a square texture that repeats; its side is a power of two."""
    mask = texture.shape[0] - 1
    c0, r0 = int(np.floor(column)), int(np.floor(row))
    fc, fr = column - c0, row - r0
    c0, r0 = c0 & mask, r0 & mask
    c1, r1 = (c0 + 1) & mask, (r0 + 1) & mask
    upper = texture[r0, c0] * (1.0 - fc) + texture[r0, c1] * fc
    lower = texture[r1, c0] * (1.0 - fc) + texture[r1, c1] * fc
    return upper * (1.0 - fr) + lower * fr


@njit(cache=True, error_model="numpy")
@no_type_check
def joint_share(position, period, width, width_a, width_b):
    """Share of a pixel on the nearest of evenly spaced joints."""
    d = position - period * np.floor(position / period + 0.5)
    if abs(d) >= 0.5 * (width + abs(width_a) + abs(width_b)):
        return 0.0
    return box_share(d + 0.5 * width, width_a, width_b) - box_share(d - 0.5 * width, width_a, width_b)


@njit(cache=True, error_model="numpy")
@no_type_check
def paint_floor(
    out,
    pixels,
    points,
    jacobians,
    levels,
    n_near,
    pose,
    floor_bgr,
    texture,
    texture_cell,
    texture_level,
    joints,
    grid,
    grid_frame,
    nodes,
    closed,
    markings,
    stretches,
    wear,
    clutter,
    lamps,
):
    """Paint every pixel that sees the floor.

    Args:
        out: Image as rows of pixels, float32, filled in place.
        pixels: Index of each pixel to paint; the first ``n_near`` may show the road.
        points: Their points of the road, relative to the rear axle: right, ahead.
        jacobians: d(right, ahead)/d(u, v): four values.
        levels: Level of the texture that fits the pixel's size.
        n_near: How many are near enough to the car to show markings and clutter.
        pose: Rear-axle centre x, y and heading.
        floor_bgr: Mean colour.
        texture: Floor's pattern, by level.
        texture_cell: Side of its cells.
        texture_level: Its strength.
        joints: Direction, shift in both directions, distance in both directions, width, darkening.
        grid: Nearest sample of the centre line by cell; -1 away from the road.
        grid_frame: x and y of the grid's origin, cell.
        nodes: See :func:`locate`.
        closed: Whether the road is a loop.
        markings: Offset, width, blue, green, red, first and last row of ``stretches``.
        stretches: Painted stretches of all markings.
        wear: 0..1.
        clutter: Rectangles near the car, see ``Scene.clutter``.
        lamps: Mirror images near the car: x, y, cos and sin of the view, widths along and across, level,
            square of the reach.
    """
    ch, sh = np.cos(pose[2]), np.sin(pose[2])
    cj, sj = np.cos(joints[0]), np.sin(joints[0])
    rows, columns = grid.shape
    for p in range(pixels.shape[0]):
        right, ahead = points[p, 0], points[p, 1]
        x = pose[0] + ahead * ch + right * sh
        y = pose[1] + ahead * sh - right * ch
        # What one pixel in u and one in v are on the map.
        ux, uy = jacobians[p, 2] * ch + jacobians[p, 0] * sh, jacobians[p, 2] * sh - jacobians[p, 0] * ch
        vx, vy = jacobians[p, 3] * ch + jacobians[p, 1] * sh, jacobians[p, 3] * sh - jacobians[p, 1] * ch
        blue, green, red = floor_bgr[0], floor_bgr[1], floor_bgr[2]
        along, across = x * cj + y * sj, y * cj - x * sj
        pattern = 0.0
        if texture_level > 0.0 or wear > 0.0:
            pattern = bilinear(texture[levels[p]], along / texture_cell, across / texture_cell)
        shade = texture_level * pattern
        if joints[3] > 0.0:
            share = joint_share(along - joints[1], joints[3], joints[5], ux * cj + uy * sj, vx * cj + vy * sj)
            shade -= joints[6] * share
        if joints[4] > 0.0:
            share = joint_share(
                across - joints[2], joints[4], joints[5], uy * cj - ux * sj, vy * cj - vx * sj
            )
            shade -= joints[6] * share
        blue, green, red = blue + shade, green + shade, red + shade
        if p < n_near:
            column = int(np.floor((x - grid_frame[0]) / grid_frame[2]))
            row = int(np.floor((y - grid_frame[1]) / grid_frame[2]))
            if 0 <= row < rows and 0 <= column < columns and grid[row, column] >= 0:
                s, offset, c, sn, k = locate(x, y, nodes, closed, grid[row, column])
                across_u, across_v = uy * c - ux * sn, vy * c - vx * sn
                scale = 1.0 / max(1.0 - k * offset, 0.2)
                along_u, along_v = (ux * c + uy * sn) * scale, (vx * c + vy * sn) * scale
                for m in range(markings.shape[0]):
                    d = offset - markings[m, 0]
                    half = 0.5 * markings[m, 1]
                    if abs(d) >= half + 0.5 * (abs(across_u) + abs(across_v)):
                        continue
                    alpha = box_share(d + half, across_u, across_v) - box_share(d - half, across_u, across_v)
                    if alpha > 0.0:
                        first, last = int(markings[m, 5]), int(markings[m, 6])
                        alpha *= painted_share(s, along_u, along_v, stretches, first, last)
                        if wear > 0.0:
                            alpha *= 1.0 - min(max(1.5 * (pattern - 3.0 + 3.2 * wear), 0.0), 1.0)
                        blue += alpha * (markings[m, 2] - blue)
                        green += alpha * (markings[m, 3] - green)
                        red += alpha * (markings[m, 4] - red)
            for q in range(clutter.shape[0]):
                dx, dy = x - clutter[q, 0], y - clutter[q, 1]
                reach = clutter[q, 4] + clutter[q, 5] + 6.0
                if dx * dx + dy * dy > reach * reach:
                    continue
                c, sn = clutter[q, 2], clutter[q, 3]
                d, au, av = dx * c + dy * sn, ux * c + uy * sn, vx * c + vy * sn
                alpha = box_share(d + clutter[q, 4], au, av) - box_share(d - clutter[q, 4], au, av)
                d, au, av = dy * c - dx * sn, uy * c - ux * sn, vy * c - vx * sn
                alpha *= box_share(d + clutter[q, 5], au, av) - box_share(d - clutter[q, 5], au, av)
                blue += alpha * (clutter[q, 6] - blue)
                green += alpha * (clutter[q, 7] - green)
                red += alpha * (clutter[q, 8] - red)
        for q in range(lamps.shape[0]):
            dx, dy = x - lamps[q, 0], y - lamps[q, 1]
            if dx * dx + dy * dy > lamps[q, 7]:
                continue
            a = (dx * lamps[q, 2] + dy * lamps[q, 3]) / lamps[q, 4]
            b = (dy * lamps[q, 2] - dx * lamps[q, 3]) / lamps[q, 5]
            r = a * a + b * b
            if r < 12.0:
                glow = lamps[q, 6] * np.exp(-0.5 * r)
                blue, green, red = blue + glow, green + glow, red + glow
        i = pixels[p]
        out[i, 0], out[i, 1], out[i, 2] = blue, green, red


@njit(cache=True, error_model="numpy")
@no_type_check
def paint_room(out, pixels, azimuths, elevations, heading, room):
    """Paint every pixel that sees the walls: azimuth from straight ahead (left positive), elevation >= 0."""
    rows, columns = room.shape[0], room.shape[1]
    for p in range(pixels.shape[0]):
        column = (azimuths[p] + heading) / (2.0 * np.pi) * columns
        c0 = int(np.floor(column))
        fc = column - c0
        row = min(elevations[p] / (0.5 * np.pi) * rows, rows - 1.001)
        r0 = int(row)
        fr = row - r0
        c0 = c0 % columns
        c1 = (c0 + 1) % columns
        i = pixels[p]
        for channel in range(3):
            lower = room[r0, c0, channel] * (1.0 - fc) + room[r0, c1, channel] * fc
            upper = room[r0 + 1, c0, channel] * (1.0 - fc) + room[r0 + 1, c1, channel] * fc
            out[i, channel] = lower * (1.0 - fr) + upper * fr


@njit(cache=True, error_model="numpy")
@no_type_check
def develop(light, gains, noise, first, noise_level, out):
    """Apply gains per pixel and channel, add a stretch of the (repeating) noise, round to uint8."""
    last = noise.shape[0] - 1
    j = first
    for i in range(light.shape[0]):
        for channel in range(3):
            value = light[i, channel] * gains[i, channel] + noise_level * noise[j] + 0.5
            out[i, channel] = np.uint8(min(max(value, 0.0), 255.0))
            j = 0 if j == last else j + 1
