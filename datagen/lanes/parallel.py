"""Lines that run side by side: how far apart they are, and where a line beside another one has to be.

Both are measured across the lines, on the map. A difference of offsets from the path is not that: where the
lines turn against the path, as they do wherever the car cuts a corner, it is longer: by the cosine of the
angle between them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.lanes.path import Path, left_of

#: How much further than the distance of the lines the place opposite may lie along the path.
_SLACK = 1.2


def parallel_offset(
    path: Path, d_cm: Float[np.ndarray, "m"], apart_cm: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "m"]:
    """Offset from the path of the line that runs beside another one.

    Args:
        path: The path.
        d_cm: Offset of the line that is known, smooth, at each path sample.
        apart_cm: How far the other one lies to its left; negative to its right.
    """
    line = path.points(d_cm)
    beside = line + apart_cm[:, None] * left_of(_along(path, line))
    rows = _around(path, float(np.abs(apart_cm).max()))
    nearest = np.argmin(np.sum((path.xy_cm[rows] - beside[:, None]) ** 2, axis=2), axis=1)
    at = rows[np.arange(len(rows)), nearest]
    step = beside - path.xy_cm[at]
    ahead = step[:, 0] * path.left[at, 1] - step[:, 1] * path.left[at, 0]
    offset = np.sum(step * path.left[at], axis=1)
    s = path.s_cm[at] + ahead
    order = np.argsort(s, kind="stable")
    return np.interp(path.s_cm, s[order], offset[order], period=path.period_cm)


def distance_across(
    path: Path,
    from_cm: Float[np.ndarray, "m"],
    to_cm: Float[np.ndarray, "m"],
    known: Bool[np.ndarray, "m"],
) -> Float[np.ndarray, "m"]:
    """Distance from each sample of a line to another line; NaN where that is not known opposite.

    Args:
        path: The path.
        from_cm: Offset of the first line at each path sample.
        to_cm: Offset of the second one.
        known: Where the second one is known.
    """
    here, there = path.points(from_cm), path.points(to_cm)
    rows = _around(path, float(np.abs(from_cm - to_cm).max()))
    distance = np.linalg.norm(there[rows] - here[:, None], axis=2)
    nearest = np.argmin(distance, axis=1)
    each = np.arange(len(rows))
    return np.where(known[rows[each, nearest]], distance[each, nearest], np.nan)


def _along(path: Path, line: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """Direction of a line at each path sample."""
    if path.closed:
        return np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    return np.gradient(line, axis=0)


def _around(path: Path, apart_cm: float) -> Int[np.ndarray, "m k"]:
    """Samples of the path around each one; those beyond an open end repeat the last."""
    m = len(path.xy_cm)
    reach = min(int(_SLACK * apart_cm / path.step_cm) + 2, m // 4)
    rows = np.arange(m)[:, None] + np.arange(-reach, reach + 1)
    return rows % m if path.closed else np.clip(rows, 0, m - 1)
