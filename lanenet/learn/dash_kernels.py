"""Dashes along the middle of a lane, compiled: a marking that is not the lane's border."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from lanenet.learn.random_stream import next_between, next_uniform

#: Length of a dash and of the gap after it.
_DASH_CM, _GAP_CM = (5.0, 30.0), (5.0, 30.0)
#: How far off the middle of the lane they lie, in lane widths.
_OFF_MIDDLE = 0.04


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def middle_dashes(rng, frames, i):
    """Copy a line of a frame to the middle of its lane, in dashes; answers their points, [cm], frame car.

    The copy has the blur, the gaps and the range of what the frame shows of that line. It is the line of
    which the frame shows more. Nothing comes of it where the two lines are not sampled alike.

    Args:
        rng: Stream of random numbers.
        frames: :class:`lanenet.learn.augment_kernels.Frames`.
        i: The frame.
    """
    dash, gap = next_between(rng, *_DASH_CM), next_between(rng, *_GAP_CM)
    phase, off = next_uniform(rng), next_between(rng, -_OFF_MIDDLE, _OFF_MIDDLE)
    first, last = frames.edge_start[i], frames.edge_start[i + 1]
    starts = frames.line_start
    n = starts[2 * i + 1] - starts[2 * i]
    if n < 2 or starts[2 * i + 2] - starts[2 * i + 1] != n:
        return np.empty((0, 2))
    along = np.zeros(2, np.int64)
    for k in range(first, last):
        along[0] += (frames.edge_lines[k] >> 2) & 1
        along[1] += frames.edge_lines[k] >> 3
    side = 0 if along[0] >= along[1] else 1
    line, other = starts[2 * i + side], starts[2 * i + 1 - side]
    way = np.zeros(n)
    for j in range(1, n):
        step = np.hypot(
            frames.lines_cm[line + j, 0] - frames.lines_cm[line + j - 1, 0],
            frames.lines_cm[line + j, 1] - frames.lines_cm[line + j - 1, 1],
        )
        way[j] = way[j - 1] + (0.0 if np.isnan(step) else step)
    points, count = np.empty((along[side], 2)), 0
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
        if (way[at] + phase * (dash + gap)) % (dash + gap) > dash:
            continue
        px = x + (0.5 + off) * (frames.lines_cm[other + at, 0] - frames.lines_cm[line + at, 0])
        py = y + (0.5 + off) * (frames.lines_cm[other + at, 1] - frames.lines_cm[line + at, 1])
        if not np.isnan(px + py):
            points[count, 0], points[count, 1] = px, py
            count += 1
    return points[:count]
