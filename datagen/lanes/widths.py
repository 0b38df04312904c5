"""Width of a line's marking along the line, from the borders of its marking on the map.

Tape is not as wide everywhere as it is on the whole: another roll, a second strip beside it, or a sheet that
bulges, on which the map takes what is nearer to the camera for wider. Where its width changes, a border lies
beside the place that the usual width gives it, though the middle of the line is right.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import median
from scipy.spatial import cKDTree

from datagen.lanes.path import MapEdges, left_of
from lanenet.data.maps.line import LaneLine

#: Length of a place along the line, and half the number of places that are taken together. Chosen: 2 cm and
#: 20 cm at 20 cm, so that a corner of tape is outvoted.
_PLACE, _AROUND = 0.1, 5
#: Bounds of a border's distance from the line, in usual widths: half of 0.4 and 1.7.
_NEAREST, _FARTHEST = 0.2, 0.85
#: Least cosine between a border and the line. Chosen: 26 degrees; the ends of dashes are across.
_MIN_COSINE = 0.9
#: Least number of edge points of either border of a place. Chosen: one frame shows one, and one may be wrong.
_MIN_POINTS = 2
#: Least number of places with both borders among those that are taken together. Chosen: 6 cm at 20 cm.
_MIN_PLACES = 3


def marking_widths(line: LaneLine, edges: MapEdges, camera_height_cm: float) -> Float[np.ndarray, "u"]:
    """Measure the width of a line's marking where its sigma is given.

    Args:
        line: The line, with its usual width.
        edges: Edge points on the map, normals into the markings.
        camera_height_cm: Sets the scale of places.

    Returns:
        Widths at ``line.sigma_s_cm``, the usual one where both borders are not seen; none if they are seen
        nowhere.
    """
    s_cm = line.sigma_s_cm
    if not np.isfinite(line.marking_cm) or not len(edges.xy_cm) or len(s_cm) < 2:
        return np.empty(0)
    at_cm, to_right = line.everywhere(s_cm), -left_of(line.everywhere(s_cm, 1))
    reach_cm = _FARTHEST * line.marking_cm + float(s_cm[1] - s_cm[0])
    apart_cm, nearest = cKDTree(at_cm).query(edges.xy_cm, distance_upper_bound=reach_cm)
    near = np.flatnonzero(np.isfinite(apart_cm))
    sample = np.asarray(nearest)[near]
    across_cm = np.sum((edges.xy_cm[near] - at_cm[sample]) * to_right[sample], axis=1)
    facing = np.sum(edges.normals[near] * to_right[sample], axis=1)
    # The left border brightens to the right, and lies to the left of the middle.
    aside_cm = -np.sign(facing) * across_cm
    good = (aside_cm > _NEAREST * line.marking_cm) & (aside_cm < _FARTHEST * line.marking_cm)
    good &= np.abs(facing) > _MIN_COSINE
    place_cm = _PLACE * camera_height_cm
    place = ((s_cm - s_cm[0]) / place_cm).astype(np.int64)
    count = int(place[-1]) + 1
    borders = [good & (side * facing > 0.0) for side in (1.0, -1.0)]
    left, right = (_medians(place[sample[rows]], aside_cm[rows], count) for rows in borders)
    smooth_cm = _running_median(left + right, line.period_cm is not None)
    known = np.isfinite(smooth_cm)
    if not known.any():
        return np.empty(0)
    centres_cm = s_cm[0] + (np.arange(count) + 0.5) * place_cm
    found = np.interp(s_cm, centres_cm[known], smooth_cm[known], period=line.period_cm)
    return np.where(known[place], found, line.marking_cm)


def _medians(
    place: Int[np.ndarray, "n"], values: Float[np.ndarray, "n"], count: int
) -> Float[np.ndarray, "p"]:
    """Median of the values by place; NaN where they are too few."""
    if not len(values):
        return np.full(count, np.nan)
    enough = np.bincount(place, minlength=count) >= _MIN_POINTS
    return np.where(enough, median(values, place, np.arange(count)), np.nan)


def _running_median(values: Float[np.ndarray, "p"], closed: bool) -> Float[np.ndarray, "p"]:
    """Median of what is known around each place; NaN where that is too little."""
    filled = {"mode": "wrap"} if closed else {"constant_values": np.nan}
    padded = np.pad(values, _AROUND, **filled)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1)
    found = np.full(len(values), np.nan)
    enough = np.isfinite(windows).sum(axis=1) >= _MIN_PLACES
    if enough.any():
        found[enough] = np.nanmedian(windows[enough], axis=1)
    return found
