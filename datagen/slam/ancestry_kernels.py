"""The loops of the shared map: following the ancestry, writing, pruning.

Resampling keeps the order of the particles (systematic resampling draws ascending indices), so that the
living descendants of a node are always neighbours: one interval of particles. Whether a particle descends
from a node is two comparisons, and what a cell holds for each particle is a sum over intervals.

An entry whose interval is empty is dead; one whose interval holds everybody is the same for all particles and
moves into the root. Both happen where a cell is visited, and at the latest when its frame leaves the tree.

The entries of a cell stand in pages, each of which is one run of memory, and the loops over points are
outermost: chasing entries one by one through memory would take longer than all the arithmetic.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from datagen.slam.ancestry_arrays import (
    OWNER_X,
    OWNER_Y,
    PAGE,
    PAGE_SIZE,
    PLACE,
    PLACE_BITS,
    PRUNED,
    STAMP,
    U,
)

_RECENT = 4  # cells along each side of the square that a node's last entries are known of
_NOWHERE = -(1 << 31)  # no cell has this number


@njit(cache=True, error_model="numpy")
@no_type_check
def grow(tree, row, frame, states, chosen):
    """Follow a resampling: give every node its new interval, and the survivors nodes of their own.

    Args:
        tree: The tree.
        row: Row of the new nodes.
        frame: Their frame.
        states: Particles before resampling; the first three columns are poses.
        chosen: Ascending index of each new particle's parent among them.
    """
    span, particles = tree.span, len(chosen)
    # How many new particles stand before the copies of each old one.
    before = np.zeros(particles + 1, np.int32)
    for p in range(particles):
        before[chosen[p] + 1] += 1
    for p in range(particles):
        before[p + 1] += before[p]
    for r in range(span.shape[0]):
        for i in range(tree.nodes[r]):
            span[r, i, 0] = before[span[r, i, 0]]
            span[r, i, 1] = before[span[r, i, 1]]
    count = 0
    for p in range(particles):
        if before[p + 1] > before[p]:
            span[row, count, 0] = before[p]
            span[row, count, 1] = before[p + 1]
            tree.pose[row, count] = states[p, :3]
            count += 1
    tree.nodes[row] = count
    tree.frame[row] = frame
    tree.version[0] += 1


@njit(cache=True, error_model="numpy")
@no_type_check
def prune(tree, cells, pages, a, b, memory):
    """Take the dead entries out of a cell, and move those that all particles share into its root.

    Entries with the same descendants will have the same for ever: they become one.
    """
    state, root = cells.state, cells.root
    following, used = pages.following, pages.used
    entered, vector = pages.node.reshape(-1), pages.vector.reshape((-1, 2))
    span, frames, fades, mark = tree.span, tree.frame, tree.fades, tree.mark
    window, particles = span.shape[0], span.shape[1]
    state[a, b, PRUNED] = tree.version[0]
    tree.version[1] += 1
    serial = tree.version[1]
    # Entries that stay move up to the front; ``into`` is the page that is being filled, ``out`` the place.
    page = into = state[a, b, PAGE]
    out = into * PAGE_SIZE
    while page >= 0:
        first, stop_at = page * PAGE_SIZE, page * PAGE_SIZE + used[page]
        page = following[page]
        for at in range(first, stop_at):
            e = U(at)
            node = entered[e]
            row, place = U(node >> PLACE_BITS), U(node & PLACE)
            start, stop = U(span[row, place, 0]), np.int64(span[row, place, 1])
            size, frame = stop - np.int64(start), np.int64(frames[row])
            if size == particles:
                stamp, fade = state[a, b, STAMP], 1.0
                if stamp < frame:
                    old = np.exp((stamp - frame) / memory) if stamp >= 0 else 0.0
                    root[a, b, 0] *= old
                    root[a, b, 1] *= old
                    state[a, b, STAMP] = frame
                elif stamp > frame:
                    fade = np.exp((frame - stamp) / memory)
                root[a, b, 0] += fade * vector[e, 0]
                root[a, b, 1] += fade * vector[e, 1]
            elif size > 0:
                if mark[start, 0] == serial and mark[start, 1] == stop:
                    like, fade = U(mark[start, 3]), fades[U(window + mark[start, 2] - frame)]
                    vector[like, 0] += fade * vector[e, 0]
                    vector[like, 1] += fade * vector[e, 1]
                    continue
                if out == (into + 1) * PAGE_SIZE:
                    used[into] = PAGE_SIZE
                    into = following[into]
                    out = into * PAGE_SIZE
                entered[U(out)] = node
                vector[U(out), 0], vector[U(out), 1] = vector[e, 0], vector[e, 1]
                mark[start, 0], mark[start, 1], mark[start, 2], mark[start, 3] = serial, stop, frame, out
                out += 1
    rest, filled = state[a, b, PAGE], out - into * PAGE_SIZE
    if filled > 0:
        used[into] = filled
        rest = following[into]
        following[into] = -1
    else:
        state[a, b, PAGE] = -1
    _free(pages, rest)


@njit(cache=True, error_model="numpy")
@no_type_check
def _free(pages, page):
    """Give a chain of pages back."""
    while page >= 0:
        following = pages.following[page]
        pages.following[page] = pages.free[0]
        pages.free[0] = page
        pages.free[1] += 1
        page = following


@njit(cache=True, error_model="numpy")
@no_type_check
def write(tree, cells, pages, row, start, wheelbase, cell_cm, plain):
    """Enter the points of a row, seen from each of its nodes.

    Args:
        tree: The tree.
        cells: The grid.
        pages: The pages.
        row: Row to enter.
        start: First point to enter.
        wheelbase: Distance between the axles, [cm].
        cell_cm: Side of a cell.
        plain: Enter (weight, 0) into the point's own cell instead of blurred normals, for counting.

    Returns:
        First point that was not entered, because the pages might not suffice for it.
    """
    pose, points, state, root = tree.pose, tree.points, cells.state, cells.root
    following, used, free = pages.following, pages.used, pages.free
    entered, vector = pages.node.reshape(-1), pages.vector.reshape((-1, 2))
    nodes, mask = tree.nodes[row], state.shape[0] - 1
    wx, wy = np.ones(2), np.ones(2)
    reach, half = (1, 0.0) if plain else (2, 0.5)
    cosines, sines = np.cos(pose[row, :nodes, 2]), np.sin(pose[row, :nodes, 2])
    # Neighbouring points share cells: the entry that a node made last in each of a few cells takes both.
    recent = np.full((nodes, _RECENT * _RECENT, 3), _NOWHERE, np.int32)
    for i in range(start, tree.size[row]):
        if free[1] < reach * reach * nodes:
            return i
        right, forward = points[row, i, 0], points[row, i, 1] + wheelbase
        weight = points[row, i, 4]
        for node in range(nodes):
            c, s = cosines[node], sines[node]
            gx = (pose[row, node, 0] + forward * c + right * s) / cell_cm - half
            gy = (pose[row, node, 1] + forward * s - right * c) / cell_cm - half
            cx, cy = int(np.floor(gx)), int(np.floor(gy))
            nx, ny = 1.0, 0.0
            if not plain:
                nx = points[row, i, 3] * c + points[row, i, 2] * s
                ny = points[row, i, 3] * s - points[row, i, 2] * c
                # Shared among the four nearest cells by distance.
                tx, ty = gx - cx, gy - cy
                wx[0], wx[1] = 1.0 - tx, tx
                wy[0], wy[1] = 1.0 - ty, ty
            for jy in range(reach):
                for jx in range(reach):
                    share = weight * wx[jx] * wy[jy]
                    ix, iy = cx + jx, cy + jy
                    a, b = U(iy & mask), U(ix & mask)
                    slot = U((iy & (_RECENT - 1)) * _RECENT + (ix & (_RECENT - 1)))
                    if state[a, b, OWNER_X] != ix or state[a, b, OWNER_Y] != iy:
                        # Another patch of road takes the cell over; what it held is forgotten.
                        if state[a, b, PAGE] >= 0:
                            _free(pages, state[a, b, PAGE])
                            recent[:] = _NOWHERE
                        state[a, b, PAGE], state[a, b, STAMP] = -1, -1
                        root[a, b, 0], root[a, b, 1] = 0.0, 0.0
                        state[a, b, OWNER_X], state[a, b, OWNER_Y] = ix, iy
                    elif recent[node, slot, 0] == ix and recent[node, slot, 1] == iy:
                        like = U(recent[node, slot, 2])
                        vector[like, 0] += share * nx
                        vector[like, 1] += share * ny
                        continue
                    page = state[a, b, PAGE]
                    if page < 0 or used[U(page)] == PAGE_SIZE:
                        fresh = free[0]
                        free[0] = following[fresh]
                        free[1] -= 1
                        following[fresh] = page
                        used[fresh] = 0
                        state[a, b, PAGE] = page = fresh
                    out = page * PAGE_SIZE + used[U(page)]
                    used[U(page)] += 1
                    entered[U(out)] = row << PLACE_BITS | node
                    vector[U(out), 0] = share * nx
                    vector[U(out), 1] = share * ny
                    recent[node, slot, 0], recent[node, slot, 1], recent[node, slot, 2] = ix, iy, out
    return tree.size[row]


@njit(cache=True, error_model="numpy")
@no_type_check
def forget(tree, cells, pages, row, wheelbase, cell_cm, memory, plain):
    """Free a row of the tree: its entries move into the roots or are dropped.

    Where particles still disagree on the frame, a node at their ancestors' mean pose is left in the row, to
    be entered and forgotten in its turn.

    Args:
        tree: The tree.
        cells: The grid.
        pages: The pages.
        row: Row to free.
        wheelbase: Distance between the axles, [cm].
        cell_cm: Side of a cell.
        memory: Frames after which what was mapped has faded to 1/e.
        plain: As in :func:`write`.

    Returns:
        Whether they disagreed.
    """
    span, pose, points, state = tree.span, tree.pose, tree.points, cells.state
    particles, nodes, mask = span.shape[1], tree.nodes[row], state.shape[0] - 1
    reach, half = (1, 0.0) if plain else (2, 0.5)
    forced, mean = True, np.zeros(3)
    for node in range(nodes):
        size = span[row, node, 1] - span[row, node, 0]
        forced &= size < particles
        mean += size / particles * pose[row, node]
    if forced:
        span[row, :nodes] = 0
        tree.version[0] += 1
    version = tree.version[0]
    cosines, sines = np.cos(pose[row, :nodes, 2]), np.sin(pose[row, :nodes, 2])
    for i in range(tree.size[row]):
        right, forward = points[row, i, 0], points[row, i, 1] + wheelbase
        for node in range(nodes):
            c, s = cosines[node], sines[node]
            cx = int(np.floor((pose[row, node, 0] + forward * c + right * s) / cell_cm - half))
            cy = int(np.floor((pose[row, node, 1] + forward * s - right * c) / cell_cm - half))
            for iy in range(cy, cy + reach):
                for ix in range(cx, cx + reach):
                    a, b = U(iy & mask), U(ix & mask)
                    if state[a, b, PAGE] >= 0 and state[a, b, PRUNED] != version:
                        prune(tree, cells, pages, a, b, memory)
    if forced:
        # All lineages are gone from the cells; one node that everybody descends from takes their place.
        pose[row, 0] = mean
        span[row, 0, 1] = particles
        tree.nodes[row] = 1
        tree.version[0] += 1
    else:
        tree.nodes[row] = 0
        tree.size[row] = 0
    return forced
