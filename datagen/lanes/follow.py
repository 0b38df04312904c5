"""Following a line, or the middle of a lane, along a path: dynamic programming over offsets.

How lane lines are looked for.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from pydantic import Field
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.path import Path
from datagen.lanes.profile import EdgeProfile, shifted
from lanenet.config import Settings


class TraceSettings(Settings):
    """How lane lines are looked for; lengths in camera heights where the name says so.

    Attributes:
        cell_heights: Cells across the path.
        side_heights: How far beside the path edges count.
        min_side: Component across the path of the normal of an edge that runs along it.
        tape_heights: Narrowest and widest marking.
        lane_heights: Narrowest and widest lane, where its width is not known.
        smoothness: Cost of a step of one cell across per sample along the path, growing with its square.
        sideways: Cost of a step of one cell where no paint is.
        second_line: What the weaker one of the two lines counts beside the stronger one.
        inside: What it costs per sample when the car is a lane further, less when it is only just outside:
            more than a second line brings, so that a lane beside it with two solid lines does not take over;
            not much more, or the lane changes sides with a car that does.
        min_support: Density of edges from which a marking counts as seen, 0..1.
        width_share: How much the lane's width may vary along the road.
        neighbours: Lines to look for on each side beyond those of the driven lane.
        neighbour_lanes: Length of paint that makes a neighbouring line, in lane widths.
        neighbour_share: Share of the path along which a neighbouring line must be seen,
        visit_share: or of the way that the car drives in the lane before it,
        visit_lanes: where that is so long at least, in lane widths.
    """

    cell_heights: float = Field(default=0.03, gt=0.0)
    side_heights: float = Field(default=8.0, gt=0.0)
    min_side: float = Field(default=0.75, gt=0.0, lt=1.0)
    tape_heights: tuple[float, float] = (0.05, 0.6)
    lane_heights: tuple[float, float] = (0.8, 6.5)
    smoothness: float = Field(default=0.04, gt=0.0)
    sideways: float = Field(default=0.3, ge=0.0)
    second_line: float = Field(default=0.08, gt=0.0, le=1.0)
    inside: float = Field(default=0.12, ge=0.0)
    min_support: float = Field(default=0.4, gt=0.0)
    width_share: float = Field(default=0.15, gt=0.0, lt=0.5)
    neighbours: int = Field(default=1, ge=0)
    neighbour_lanes: float = Field(default=4.0, gt=0.0)
    neighbour_share: float = Field(default=0.35, ge=0.0, le=1.0)
    visit_share: float = Field(default=0.5, ge=0.0, le=1.0)
    visit_lanes: float = Field(default=2.0, gt=0.0)


def best_lane(
    path: Path,
    tapes: Float[np.ndarray, "m c"],
    profile: EdgeProfile,
    lane_width_cm: float,
    settings: TraceSettings,
) -> tuple[float, Float[np.ndarray, "m"]]:
    """Track the lane's centre; the width may differ by a tenth from what the user gave."""
    best: tuple[float, float, Float[np.ndarray, "m"]] | None = None
    outside = settings.inside * _car_outside(path, profile, lane_width_cm)
    for width in lane_width_cm * np.linspace(0.9, 1.1, 9):
        cells = width / profile.cell_cm
        left, right = shifted(tapes, 0.5 * cells), shifted(tapes, -0.5 * cells)
        # One line is nearly as good as two: a lane with a worn line must not be left for its neighbour.
        support = np.maximum(left, right) + settings.second_line * np.minimum(left, right)
        centre, score = _best_track(path, support, outside, settings)
        if best is None or score > best[0]:
            best = (score, float(width), (centre - profile.half_cells) * profile.cell_cm)
    assert best is not None
    return best[1], best[2]


def follow_line(
    path: Path,
    tapes: Float[np.ndarray, "m c"],
    profile: EdgeProfile,
    guess_cm: Float[np.ndarray, "m"],
    band_cm: float,
    settings: TraceSettings,
) -> Float[np.ndarray, "m"]:
    """Follow one marking within a band about a guess."""
    reach = max(2, int(band_cm / profile.cell_cm))
    offsets = np.arange(-reach, reach + 1)
    column = np.clip(guess_cm / profile.cell_cm + profile.half_cells, 0.0, tapes.shape[1] - 1.0)
    nearest = np.rint(column).astype(np.intp)
    window = np.clip(nearest[:, None] + offsets, 0, tapes.shape[1] - 1)
    support = np.take_along_axis(tapes, window, axis=1)
    # Of two tapes side by side the one nearer to the guess.
    against = np.broadcast_to(0.1 * np.abs(offsets) / reach, support.shape)
    track, _ = _best_track(path, support, np.ascontiguousarray(against), settings)
    return (nearest + track - reach - profile.half_cells) * profile.cell_cm


def _car_outside(path: Path, profile: EdgeProfile, lane_cm: float) -> Float[np.ndarray, "m c"]:
    """How far outside a lane centred at each offset the car is, 1 from a lane away, mean of all visits."""
    m, columns = profile.left.shape
    at = (np.arange(columns) - profile.half_cells) * profile.cell_cm
    forward = path.drives_forward
    rows = np.rint(path.s_frames_cm / path.step_cm).astype(np.intp) % m
    total, visits = np.zeros((m, columns)), np.zeros(m)
    for row, offset in zip(rows[forward], path.offsets_cm[forward], strict=True):
        total[row] += np.clip(np.abs(at - offset) / (0.5 * lane_cm) - 1.0, 0.0, 1.0) ** 2
        visits[row] += 1.0
    near = max(1.0, 0.25 * lane_cm / path.step_cm)
    total = gaussian_filter1d(total, near, axis=0, mode="wrap" if path.closed else "nearest")
    visits = gaussian_filter1d(visits, near, mode="wrap" if path.closed else "nearest")
    return total / np.maximum(visits, 1e-3)[:, None]


def _best_track(
    path: Path, support: Float[np.ndarray, "m c"], against: Float[np.ndarray, "m c"], settings: TraceSettings
) -> tuple[Float[np.ndarray, "m"], float]:
    """Columns with the most support along the path; a closed path is followed once more on either side."""
    m = len(support)
    lead = m // 2 if path.closed else 0
    if lead:
        support, against = (np.concatenate([part[-lead:], part, part[:lead]]) for part in (support, against))
    track, score = _viterbi(
        support.astype(np.float32), against.astype(np.float32), settings.smoothness, settings.sideways
    )
    return track[lead : lead + m].astype(np.float64), float(score)


@njit(cache=True)
@no_type_check
def _viterbi(support, against, smoothness, sideways):
    """Path of columns with the most support; steps of up to four columns, dearer where no paint is."""
    m, columns = support.shape
    cost = np.empty((m, columns), np.float32)
    back = np.zeros((m, columns), np.int8)
    for c in range(columns):
        cost[0, c] = support[0, c] - against[0, c]
    for i in range(1, m):
        for c in range(columns):
            best, step = -1e18, 0
            bare = sideways * max(0.0, 1.0 - support[i, c])
            for j in range(-4, 5):
                if 0 <= c + j < columns:
                    value = cost[i - 1, c + j] - smoothness * j * j - bare * abs(j)
                    if value > best:
                        best, step = value, j
            cost[i, c] = best + support[i, c] - against[i, c]
            back[i, c] = step
    track = np.empty(m, np.int64)
    track[m - 1] = np.argmax(cost[m - 1])
    score = cost[m - 1, track[m - 1]]
    for i in range(m - 1, 0, -1):
        track[i - 1] = track[i] + back[i, track[i]]
    return track, score
