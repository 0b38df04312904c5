"""Scoring: what each particle sees of a frame, against what its own lineage saw before."""

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
from datagen.slam.ancestry_kernels import prune

_BOX = 4096  # cells that the particles' views of one point may spread over to be looked up together
_FEW = 4  # particles that ask for the same cell and are yet looked up singly


@njit(cache=True, error_model="numpy")
@no_type_check
def score(tree, cells, pages, poses, points, frame, wheelbase, cell_cm, memory, occupied, scores):
    """Score each particle's view of a frame against the map of its own lineage.

    Args:
        tree: The tree.
        cells: The grid.
        pages: The pages.
        poses: Predicted poses, frame map.
        points: Edge points as in :class:`Tree`.
        frame: Number of the frame, one more than the newest in the tree.
        wheelbase: Distance between the axles, [cm].
        cell_cm: Side of a cell.
        memory: Frames after which what was mapped has faded to 1/e.
        occupied: Score 1 for a point in a cell that holds at least this; 0 scores directions.
        scores: Filled.
    """
    particles = len(poses)
    state, root, mask = cells.state, cells.root, cells.state.shape[0] - 1
    following, used = pages.following, pages.used
    entered, vector = pages.node.reshape(-1), pages.vector.reshape((-1, 2))
    span, window = tree.span, tree.span.shape[0]
    fade_of = np.empty(window)
    for row in range(window):
        fade_of[row] = tree.fades[window + min(frame - tree.frame[row], window)]
    cosines, sines = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    values = np.empty((particles // _FEW + 1, particles + 1, 2))
    asked, rows = np.zeros(_BOX, np.int64), np.empty(_BOX, np.int64)
    ix, iy = np.empty(particles, np.int64), np.empty(particles, np.int64)
    seen_x, seen_y = np.empty(particles), np.empty(particles)
    scores[:] = 0.0
    for i in range(len(points)):
        right, forward, weight = points[i, 0], points[i, 1] + wheelbase, points[i, 4]
        for p in range(particles):
            ix[p] = int(np.floor((poses[p, 0] + forward * cosines[p] + right * sines[p]) / cell_cm))
            iy[p] = int(np.floor((poses[p, 1] + forward * sines[p] - right * cosines[p]) / cell_cm))
        low_x, low_y = ix.min(), iy.min()
        wide, high = ix.max() - low_x + 1, iy.max() - low_y + 1
        boxed, filled = wide * high <= _BOX, 0
        if boxed:
            asked[: wide * high] = 0
            for p in range(particles):
                asked[(iy[p] - low_y) * wide + ix[p] - low_x] += 1
        for p in range(particles):
            x, y = 0.0, 0.0
            box = (iy[p] - low_y) * wide + ix[p] - low_x if boxed else 0
            if boxed and asked[box] == 0:
                # Looked up before, for all particles.
                x, y = values[rows[box], p, 0], values[rows[box], p, 1]
            else:
                a, b = U(iy[p] & mask), U(ix[p] & mask)
                mine = state[a, b, OWNER_X] == ix[p] and state[a, b, OWNER_Y] == iy[p]
                page = -1
                if mine:
                    if state[a, b, PAGE] >= 0 and state[a, b, PRUNED] != tree.version[0]:
                        prune(tree, cells, pages, a, b, memory)
                    if state[a, b, STAMP] >= 0:
                        fade = np.exp((state[a, b, STAMP] - frame) / memory)
                        x, y = fade * root[a, b, 0], fade * root[a, b, 1]
                    page = state[a, b, PAGE]
                if boxed and asked[box] > _FEW:
                    held = values[filled]
                    held[:, :] = 0.0
                    while page >= 0:
                        for at in range(page * PAGE_SIZE, page * PAGE_SIZE + used[page]):
                            e = U(at)
                            row, place = U(entered[e] >> PLACE_BITS), U(entered[e] & PLACE)
                            start, stop = U(span[row, place, 0]), U(span[row, place, 1])
                            vx, vy = fade_of[row] * vector[e, 0], fade_of[row] * vector[e, 1]
                            # Steps at both ends of the interval; the running sum makes them plateaus.
                            held[start, 0] += vx
                            held[start, 1] += vy
                            held[stop, 0] -= vx
                            held[stop, 1] -= vy
                        page = following[page]
                    for q in range(particles):
                        x += held[q, 0]
                        y += held[q, 1]
                        held[q, 0], held[q, 1] = x, y
                    rows[box], asked[box] = filled, 0
                    filled += 1
                    x, y = held[p, 0], held[p, 1]
                else:
                    while page >= 0:
                        for at in range(page * PAGE_SIZE, page * PAGE_SIZE + used[page]):
                            e = U(at)
                            row, place = U(entered[e] >> PLACE_BITS), U(entered[e] & PLACE)
                            if span[row, place, 0] <= p < span[row, place, 1]:
                                x += fade_of[row] * vector[e, 0]
                                y += fade_of[row] * vector[e, 1]
                        page = following[page]
            seen_x[p], seen_y[p] = x, y
        if occupied > 0.0:
            for p in range(particles):
                scores[p] += weight * (seen_x[p] >= occupied)
            continue
        # A loop of its own, which the processor takes several particles at a time through.
        for p in range(particles):
            x, y = seen_x[p], seen_y[p]
            nx = points[i, 3] * cosines[p] + points[i, 2] * sines[p]
            ny = points[i, 3] * sines[p] - points[i, 2] * cosines[p]
            # Saturate: an edge that was seen often counts once.
            scores[p] += weight * (nx * x + ny * y) / (1.0 + np.sqrt(x * x + y * y))
