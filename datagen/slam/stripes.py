"""Borders of narrow stripes, put where they are.

An edge lies where the image is steepest. The blur of lens, pixels and edge detector moves the two borders of
a stripe apart, the more, the narrower the stripe is: even one that can hardly be seen has its borders two
standard deviations of the blur apart. Far lines are drawn too wide in all frames alike, and a camera that is
found from them comes out too long. Their middle is right everywhere, and how wide they are on the road is
seen near the car.

Source:
    Steger 1998, "An unbiased detector of curvilinear structures", IEEE Transactions on Pattern Analysis and
    Machine Intelligence 20: where the borders of a blurred stripe are found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.optimize import least_squares

from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RoadTable
from lanenet.processes import in_threads

#: Borders up to so far apart are looked at, [px]. Chosen: about ten standard deviations of the blur, so that
#: many are too wide to be widened by it.
_MOST_APART_PX = 12.0
#: A partner lies across the edge, give or take so much, [px], and faces the other way: the cosine of both
#: normals, at most. Chosen: a neighbouring pixel, and 37 degrees.
_BESIDE_PX, _OPPOSITE = 0.8, -0.8
#: Half of a stripe's width, in standard deviations of the blur, beyond which its borders stay: there they are
#: 0.03 of these off.
_NARROW = 1.5
#: Apparent widths within so many standard deviations of the blur from the expected one are those of a line.
#: Chosen: twice their scatter; dashes that lie across, cracks and joints are further off.
_ALIKE = 0.4
#: Pairs of borders from which the width is found, at least and at most; share of the pairs that must be like
#: it. Chosen: below, the width is a guess.
_LEAST_PAIRS, _MOST_PAIRS, _LEAST_ALIKE = 200, 4000, 0.5
#: Frames whose edges are looked at in one call. Chosen: more only takes more memory.
_FRAMES_AT_ONCE = 64
#: Standard deviation of blur and edge detector before it is measured, [px]: of the Gauss kernel and Sobel's,
#: 0.95, and a little lens. And the scatter of apparent widths, [px], on simulated drives.
_BLUR_PX, _SCATTER_PX = 1.2, 0.25


def true_borders(frames: Sequence[EdgePixels], table: RoadTable) -> list[EdgePixels]:
    """Move the borders of a drive's narrow lines inwards, to the width that they have on the road.

    The lines may be brighter or darker than the road, whichever there are more of. Edges stay where they are
    if they have no partner, if their stripe is of another width, or if the drive has no common width.

    Args:
        frames: Edge pixels per frame.
        table: The road of the camera that took them.
    """
    blocks = range(0, len(frames), _FRAMES_AT_ONCE)
    pairs = in_threads(lambda first: _partnered(frames[first : first + _FRAMES_AT_ONCE], table), blocks)
    apart_px, per_cm, inwards = np.concatenate([np.empty((0, 3)), *pairs]).T
    side = 1.0 if np.sum(inwards > 0.0) >= np.sum(inwards < 0.0) else -1.0
    chosen = (inwards == side) & np.isfinite(per_cm)
    if np.count_nonzero(chosen) < _LEAST_PAIRS:
        return list(frames)
    rows = np.flatnonzero(chosen)[:: 1 + np.count_nonzero(chosen) // _MOST_PAIRS]
    width_cm, blur_px = fit_width(apart_px[rows], per_cm[rows])
    width_px = width_cm * per_cm
    with np.errstate(invalid="ignore"):
        alike = chosen & (np.abs(apart_px - apparent_px(width_px, blur_px)) < _ALIKE * blur_px)
        if np.count_nonzero(alike) < _LEAST_ALIKE * np.count_nonzero(chosen):
            return list(frames)
        narrow = alike & (width_px < 2.0 * _NARROW * blur_px)
    shift_px = np.where(narrow, 0.5 * side * (apart_px - width_px), 0.0)
    ends = np.cumsum([0] + [len(pixels.uv_px) for pixels in frames])
    return [
        replace(pixels, uv_px=pixels.uv_px + shift_px[first:last, None] * pixels.normals)
        for pixels, first, last in zip(frames, ends[:-1], ends[1:], strict=True)
    ]


def _partnered(frames: Sequence[EdgePixels], table: RoadTable) -> Float[np.ndarray, "n 3"]:
    """Find the stripe that each edge of some frames bounds.

    Returns:
        Per edge: apparent width, [px]; pixels per cm across it; 1 if the other border lies towards the
        brighter side, -1 if towards the darker one, 0 if there is none.
    """
    uv = np.concatenate([pixels.uv_px for pixels in frames])
    normals = np.concatenate([pixels.normals for pixels in frames])
    found = np.full((len(uv), 3), np.nan)
    found[:, 2] = 0.0
    counts = [len(pixels.uv_px) for pixels in frames]
    order = np.lexsort((uv[:, 1], np.repeat(np.arange(len(frames)), counts)))
    partner = np.full(len(order), -1)
    _find_partners(uv[order], normals[order], np.cumsum([0, *counts]), partner)
    own = order[partner >= 0]
    other = order[partner[partner >= 0]]
    across = normals[own] - normals[other]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    apart = np.sum((uv[other] - uv[own]) * across, axis=1)
    road = table.lift(EdgePixels(uv, normals))
    across_cm = road.normals[own] - road.normals[other]
    across_cm /= np.maximum(np.linalg.norm(across_cm, axis=1, keepdims=True), 1e-9)
    wide_cm = np.abs(np.sum((road.points_cm[other] - road.points_cm[own]) * across_cm, axis=1))
    found[own] = np.stack([np.abs(apart), np.abs(apart) / np.maximum(wide_cm, 1e-9), np.sign(apart)], axis=1)
    return found


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _find_partners(uv, normals, starts, partner):
    """Fill in the other border of the stripe that each edge bounds: the nearest across it that faces back.

    Args:
        uv: Edges of all frames, those of each sorted by row.
        normals: Their unit gradients.
        starts: First edge of each frame, and one behind the last.
        partner: Filled where there is one.
    """
    nearest = np.empty(len(uv))
    for p in range(len(uv)):
        nearest[p] = _MOST_APART_PX * _MOST_APART_PX
    for frame in range(len(starts) - 1):
        for p in range(starts[frame], starts[frame + 1]):
            u, v, nu, nv = uv[p, 0], uv[p, 1], normals[p, 0], normals[p, 1]
            # Each pair of edges once, for both.
            for q in range(p + 1, starts[frame + 1]):
                du, dv = uv[q, 0] - u, uv[q, 1] - v
                if dv > _MOST_APART_PX:
                    break
                d = du * du + dv * dv
                if d >= nearest[p] and d >= nearest[q]:
                    continue
                if nu * normals[q, 0] + nv * normals[q, 1] >= _OPPOSITE:
                    continue
                if d < nearest[p] and abs(dv * nu - du * nv) < _BESIDE_PX:
                    nearest[p], partner[p] = d, q
                if d < nearest[q] and abs(dv * normals[q, 0] - du * normals[q, 1]) < _BESIDE_PX:
                    nearest[q], partner[q] = d, p


@cache
def _widening() -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Half widths of stripes, true and as they appear, in standard deviations of the blur.

    The gradient of a blurred stripe of half width a is steepest at x with x tanh(a x) = a.
    """
    t = np.linspace(1e-3, 40.0, 4000)
    half = np.sqrt(t * np.tanh(t))
    return half, t / half


def apparent_px(width_px: Float[np.ndarray, "n"], blur_px: float) -> Float[np.ndarray, "n"]:
    """Distance between the borders of stripes as an edge detector finds them.

    Args:
        width_px: Their true widths.
        blur_px: Standard deviation of the blur, that of the detector included.
    """
    half, seen = _widening()
    return np.maximum(2.0 * blur_px * np.interp(0.5 * width_px / blur_px, half, seen), width_px)


def fit_width(apart_px: Float[np.ndarray, "n"], per_cm: Float[np.ndarray, "n"]) -> tuple[float, float]:
    """Find the width that most of the stripes have on the road, [cm], and the blur, [px].

    Args:
        apart_px: Apparent width of each stripe.
        per_cm: Pixels per cm across it.
    """
    # The wider ones of the stripes are widened least.
    wide = apart_px >= np.median(apart_px)
    start = np.log([np.median(apart_px[wide] / per_cm[wide]), _BLUR_PX])

    def misfit(found: Float[np.ndarray, "2"]) -> Float[np.ndarray, "m"]:
        width_cm, blur_px = np.exp(found)
        off = (apparent_px(width_cm * per_cm, blur_px) - apart_px) / _SCATTER_PX
        # Where no stripe is narrow, nothing else tells the blur.
        return np.append(off, found[1] - start[1])

    width_cm, blur_px = np.exp(least_squares(misfit, start, loss="cauchy").x)
    return float(width_cm), float(blur_px)
