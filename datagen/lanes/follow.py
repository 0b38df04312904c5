"""Follow a marking, or the centre of a lane, along a path by dynamic programming over offsets."""

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
    """How lane lines are traced; lengths in camera heights where the name says so.

    Where no other origin is given, values were chosen on simulated drives.

    Attributes:
        cell_heights: Cells across the path: 0.4 cm at a camera height of 15 cm, a fifth of a usual marking.
        side_heights: Largest offset from the path at which edges count.
        min_side: Least component of an edge's normal across the path: edges within 41 degrees of it.
        tape_heights: Narrowest and widest marking: 0.75 to 9 cm at a camera height of 15 cm.
        lane_heights: Narrowest and widest lane, if its width is not given: 12 to 98 cm at 15 cm.
        smoothness: Cost of a step of one cell across, per sample along the path; it grows with the square.
        sideways: Additional cost of a step of one cell where no paint is.
        second_line: Weight of the weaker of the lane's two lines; the stronger one counts 1.
        inside: Cost per sample if the car is a lane's width outside the lane, less if it is only just
            outside. It exceeds ``second_line``, so that an adjacent lane with two solid lines does not win; a
            much higher value makes the lane change sides with the car.
        min_support: Density of edges above which a marking counts as seen, 0..1.
        width_share: Largest variation of the lane's width along the road, as a share of it.
        neighbours: Number of lines to look for on each side beyond the driven lane.
        neighbour_lanes: Least length of paint of an adjacent line, in lane widths.
        neighbour_share: Least share of the path along which an adjacent line is seen,
        visit_share: or of the path that the car drives in the lane in front of it,
        visit_lanes: if that path has at least this length, in lane widths.
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
    """Find the lane's width, within a tenth of the given one, and the offset of its centre."""
    best: tuple[float, float, Float[np.ndarray, "m"]] | None = None
    outside = settings.inside * _car_outside(path, profile, lane_width_cm)
    for width in lane_width_cm * np.linspace(0.9, 1.1, 9):
        cells = width / profile.cell_cm
        left, right = shifted(tapes, 0.5 * cells), shifted(tapes, -0.5 * cells)
        # One line counts nearly as much as two, so that a lane with a worn line does not lose to its
        # neighbour.
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
    """Follow one marking within a band about a guess; returns its offset."""
    reach = max(2, int(band_cm / profile.cell_cm))
    offsets = np.arange(-reach, reach + 1)
    column = np.clip(guess_cm / profile.cell_cm + profile.half_cells, 0.0, tapes.shape[1] - 1.0)
    nearest = np.rint(column).astype(np.intp)
    window = np.clip(nearest[:, None] + offsets, 0, tapes.shape[1] - 1)
    support = np.take_along_axis(tapes, window, axis=1)
    # Of two markings side by side, prefer the one nearer to the guess.
    against = np.broadcast_to(0.1 * np.abs(offsets) / reach, support.shape)
    track, _ = _best_track(path, support, np.ascontiguousarray(against), settings)
    return (nearest + track - reach - profile.half_cells) * profile.cell_cm


def _car_outside(path: Path, profile: EdgeProfile, lane_cm: float) -> Float[np.ndarray, "m c"]:
    """Mean over all visits of how far the car is outside a lane centred at each offset, 0..1."""
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
    """Columns with the most support; a closed path is extended by half a lap at either end."""
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
    """Sequence of columns with the most support; steps of up to four columns, dearer without paint."""
    m, columns = support.shape
    cost = np.empty((m, columns), np.float32)
    back = np.zeros((m, columns), np.int8)
    for c in range(columns):
        cost[0, c] = support[0, c] - against[0, c]
    for i in range(1, m):
        for c in range(columns):
            best, step = -1e18, 0
            unpainted = sideways * max(0.0, 1.0 - support[i, c])
            for j in range(-4, 5):
                if 0 <= c + j < columns:
                    value = cost[i - 1, c + j] - smoothness * j * j - unpainted * abs(j)
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
