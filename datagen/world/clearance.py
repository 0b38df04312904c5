"""Whether a road keeps clear of itself."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit


def nearest_approach(
    xy_cm: Float[np.ndarray, "n 2"],
    s_cm: Float[np.ndarray, "n"],
    separation_cm: float,
    lap_cm: float | None,
    after_cm: float = 0.0,
) -> tuple[float, float, float] | None:
    """Find a place where two stretches of a curve lie closer together than they should.

    Args:
        xy_cm: Points along the curve.
        s_cm: Their distance along it, evenly spaced.
        separation_cm: Least distance of points that are far apart along the curve. Far apart is more than
            pi/2 times this, so that a bend of radius 2/3 ``separation_cm`` is not taken for a near miss.
        lap_cm: Length of a closed curve; None for an open one.
        after_cm: Only points further along than this are compared with the whole curve.

    Returns:
        The two places along the curve and their distance, [cm]; None where it keeps clear.
    """
    gap_cm = 0.5 * np.pi * separation_cm
    lap = np.inf if lap_cm is None else lap_cm
    i, j = _first_pair(xy_cm, s_cm, separation_cm, gap_cm, lap, after_cm)
    if i < 0:
        return None
    i, j = max(i, j), min(i, j)
    return float(s_cm[j]), float(s_cm[i]), float(np.linalg.norm(xy_cm[i] - xy_cm[j]))


@njit(cache=True, error_model="numpy")
@no_type_check
def _first_pair(xy, s, separation, gap, lap, after):
    """Indices of the first two points that are too close, -1 if there are none."""
    n = xy.shape[0]
    step = s[1] - s[0]
    for i in range(n):
        if s[i] < after:
            continue
        j = 0
        while j < n:
            d = np.hypot(xy[i, 0] - xy[j, 0], xy[i, 1] - xy[j, 1])
            if d >= separation:
                # A curve leads no nearer than its length: what comes before this is no closer either. Twice
                # the step covers a line beside the centre line, which is longer than it in bends.
                j += max(1, int((d - separation) / (2.0 * step)))
                continue
            along = abs(s[i] - s[j])
            if min(along, lap - along) > gap:
                return i, j
            j += 1
    return -1, -1
