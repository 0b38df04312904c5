"""From edges along the path to the two lines of the driven lane.

A marking shows as two edges of opposite direction, a tape's width apart. The lane is the pair of markings a
lane's width apart that runs along the whole path; both are found together by dynamic programming, so that a
dashed line and an interrupted one are carried by the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from pydantic import Field
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from datagen.lanes.path import Path, PathEdges
from lanenet.config import Settings
from lanenet.errors import TrackingLostError


class TraceSettings(Settings):
    """How lane lines are looked for; lengths in camera heights where the name says so."""

    cell_heights: float = Field(default=0.03, gt=0.0)
    side_heights: float = Field(default=8.0, gt=0.0)
    min_side: float = Field(default=0.75, gt=0.0, lt=1.0)
    tape_heights: tuple[float, float] = (0.05, 0.6)
    lane_heights: tuple[float, float] = (1.2, 6.5)
    smoothness: float = Field(default=0.04, gt=0.0)
    second_line: float = Field(default=0.3, gt=0.0, le=1.0)
    min_support: float = Field(default=0.2, gt=0.0)


@dataclass(frozen=True)
class EdgeProfile:
    """Density of edges over path position and offset.

    Attributes:
        cell_cm: Width of a column.
        half_cells: Columns on each side of the path; offset d is column half_cells + d / cell_cm.
        left: Edges that brighten to the right (left side of a bright marking), m x columns, 0..1.
        right: Edges that brighten to the left (right side of a bright marking), m x columns, 0..1.
    """

    cell_cm: float
    half_cells: int
    left: Float[np.ndarray, "m c"]
    right: Float[np.ndarray, "m c"]

    def tapes(self, width_cm: float) -> Float[np.ndarray, "m c"]:
        """Return how well a marking of this width, with its middle at each offset, is supported."""
        return np.sqrt(
            _shifted(self.left, 0.5 * width_cm / self.cell_cm)
            * _shifted(self.right, -0.5 * width_cm / self.cell_cm)
        )


@dataclass(frozen=True)
class TracedLane:
    """The two lines of the driven lane, in path coordinates.

    Attributes:
        left_cm: Offset of the left line's middle at each path sample; NaN where nothing supports it.
        right_cm: Offset of the right line's middle.
        centre_cm: Offset of the lane's centre as found from both, everywhere.
        lane_cm: Lane width.
        tape_cm: Width of the markings.
    """

    left_cm: Float[np.ndarray, "m"]
    right_cm: Float[np.ndarray, "m"]
    centre_cm: Float[np.ndarray, "m"]
    lane_cm: float
    tape_cm: float


def edge_profile(
    path: Path, edges: PathEdges, camera_height_cm: float, settings: TraceSettings
) -> EdgeProfile:
    """Count edges that run along the path, per direction, in cells of path position and offset.

    Counts saturate, so that a stretch where the car stood does not outweigh the rest, and are smoothed over
    a quarter of a camera height along the path and one cell across.
    """
    cell = settings.cell_heights * camera_height_cm
    half = int(settings.side_heights / settings.cell_heights)
    shape = (len(path.xy_cm), 2 * half + 1)
    profiles = []
    for sign in (-1.0, 1.0):
        column = np.rint(edges.d_cm / cell).astype(np.intp) + half
        row = np.rint(edges.s_cm / path.step_cm).astype(np.intp)
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        along = inside & (sign * edges.side >= settings.min_side)
        counts = np.bincount(
            row[along] * shape[1] + column[along], edges.weight[along], minlength=shape[0] * shape[1]
        )
        density = gaussian_filter(counts.reshape(shape), (0.25 * camera_height_cm / path.step_cm, 1.2))
        profiles.append(density / (density + 0.15))
    return EdgeProfile(cell, half, profiles[0], profiles[1])


def trace_lane(
    path: Path,
    edges: PathEdges,
    camera_height_cm: float,
    lane_width_cm: float | None,
    settings: TraceSettings,
) -> TracedLane:
    """Find the lines that bound the driven lane.

    Args:
        path: The driven path.
        edges: Edge points in its coordinates.
        camera_height_cm: Sets the scale of cells and bounds.
        lane_width_cm: Distance between the lines where the scale is known; None looks for it.
        settings: Cell sizes and bounds.

    Raises:
        TrackingLostError: If no pair of lines runs along the path.
    """
    profile = edge_profile(path, edges, camera_height_cm, settings)
    driven = round(float(path.s_frames_cm[-1]) / path.step_cm) + 1
    tape = _tape_width(profile, driven, camera_height_cm, settings)
    tapes = profile.tapes(tape)
    if lane_width_cm is None:
        lane_width_cm = _lane_width(tapes[:driven], profile, camera_height_cm, settings)
    lane, centre = _best_lane(tapes, profile, lane_width_cm, settings)
    left = _refine(profile, centre + 0.5 * lane, tape, camera_height_cm, settings)
    right = _refine(profile, centre - 0.5 * lane, tape, camera_height_cm, settings)
    if np.isfinite(left[:driven]).mean() + np.isfinite(right[:driven]).mean() < 0.3:
        raise TrackingLostError(
            f"no pair of lines about {lane_width_cm:.0f} cm apart runs along the drive: check the lane width "
            "and the camera's height, and look at the map's picture"
        )
    return TracedLane(left, right, centre, lane, tape)


def _shifted(image: Float[np.ndarray, "m c"], cells: float) -> Float[np.ndarray, "m c"]:
    """Return image[:, c + cells] with linear interpolation, zero outside."""
    whole = int(np.floor(cells))
    part = cells - whole
    padded = np.pad(image, ((0, 0), (abs(whole) + 1, abs(whole) + 1)))
    start, width = abs(whole) + 1 + whole, image.shape[1]
    return (1.0 - part) * padded[:, start : start + width] + part * padded[:, start + 1 : start + 1 + width]


def _tape_width(profile: EdgeProfile, driven: int, camera_height_cm: float, settings: TraceSettings) -> float:
    """Width at which left and right edges pair up best, over the driven stretch."""
    low, high = (t * camera_height_cm for t in settings.tape_heights)
    widths = np.arange(low, high, 0.5 * profile.cell_cm)
    # The best pairing at each path position, on either side; a wrong width pairs by chance only.
    scores = [np.sort(profile.tapes(w)[:driven], axis=1)[:, -6:].mean() for w in widths]
    return float(widths[int(np.argmax(gaussian_filter1d(np.array(scores), 1.0)))])


def _lane_width(
    tapes: Float[np.ndarray, "m c"], profile: EdgeProfile, camera_height_cm: float, settings: TraceSettings
) -> float:
    """Smallest distance at which two markings run side by side along the path, one on either side of it."""
    low, high = (w * camera_height_cm for w in settings.lane_heights)
    widths = np.arange(low, high, 2.0 * profile.cell_cm)
    scores = []
    for width in widths:
        pair = _pair_score(tapes, width / profile.cell_cm)
        within = int(0.6 * width / profile.cell_cm)
        scores.append(
            np.sqrt(pair[:, profile.half_cells - within : profile.half_cells + within + 1]).max(axis=1).mean()
        )
    score = gaussian_filter1d(np.array(scores), 1.5)
    peaks = [i for i in range(1, len(score) - 1) if score[i] >= score[i - 1] and score[i] > score[i + 1]]
    if not peaks:
        raise TrackingLostError("no two lines run side by side along the drive, so that its scale is unknown")
    good = [i for i in peaks if score[i] >= 0.7 * max(score[p] for p in peaks)]
    return float(widths[good[0]])


def _pair_score(tapes: Float[np.ndarray, "m c"], width_cells: float) -> Float[np.ndarray, "m c"]:
    """Product of left and right support for a lane centred at each offset."""
    return _shifted(tapes, 0.5 * width_cells) * _shifted(tapes, -0.5 * width_cells)


def _best_lane(
    tapes: Float[np.ndarray, "m c"], profile: EdgeProfile, lane_width_cm: float, settings: TraceSettings
) -> tuple[float, Float[np.ndarray, "m"]]:
    """Track the lane's centre; the width may differ by a tenth from what the user gave."""
    best: tuple[float, float, Float[np.ndarray, "m"]] | None = None
    for width in lane_width_cm * np.linspace(0.9, 1.1, 9):
        cells = width / profile.cell_cm
        left, right = _shifted(tapes, 0.5 * cells), _shifted(tapes, -0.5 * cells)
        # One line is nearly as good as two: a lane with a worn line must not be left for its neighbour.
        support = np.maximum(left, right) + settings.second_line * np.minimum(left, right)
        centre, score = _viterbi(support, settings.smoothness, profile.half_cells, cells)
        if best is None or score > best[0]:
            best = (score, float(width), (centre - profile.half_cells) * profile.cell_cm)
    assert best is not None
    return best[1], best[2]


@njit(cache=True)
@no_type_check
def _viterbi(support, smoothness, middle, width_cells):
    """Path of columns with the most support; steps of up to four columns, dearer the larger they are."""
    m, columns = support.shape
    cost = np.empty((m, columns), np.float32)
    back = np.zeros((m, columns), np.int8)
    for c in range(columns):
        # The car starts inside its lane.
        outside = max(0.0, abs(c - middle) / (0.5 * width_cells) - 1.0)
        cost[0, c] = support[0, c] - 5.0 * outside
    for i in range(1, m):
        for c in range(columns):
            best, step = -1e18, 0
            for j in range(-4, 5):
                if 0 <= c + j < columns:
                    value = cost[i - 1, c + j] - smoothness * j * j
                    if value > best:
                        best, step = value, j
            cost[i, c] = best + support[i, c]
            back[i, c] = step
    track = np.empty(m, np.int64)
    track[m - 1] = np.argmax(cost[m - 1])
    score = cost[m - 1, track[m - 1]]
    for i in range(m - 1, 0, -1):
        track[i - 1] = track[i] + back[i, track[i]]
    return track, score


def _refine(
    profile: EdgeProfile,
    guess_cm: Float[np.ndarray, "m"],
    tape_cm: float,
    camera_height_cm: float,
    settings: TraceSettings,
) -> Float[np.ndarray, "m"]:
    """Middle of the marking near a guess: centroids of its two edges, each on its own, then their mean.

    A stretch where only one of the edges is seen has no middle and stays NaN.
    """
    guess = guess_cm
    reach = min(0.3 * camera_height_cm, max(0.8 * tape_cm, 3.0 * profile.cell_cm))
    result = np.full(len(guess), np.nan)
    for _ in range(2):
        edges = []
        for density, offset in ((profile.left, 0.5 * tape_cm), (profile.right, -0.5 * tape_cm)):
            edges.append(
                _centroid(
                    profile, density, guess + offset, min(reach, 0.7 * tape_cm + profile.cell_cm), settings
                )
            )
        result = 0.5 * (edges[0] + edges[1])
        guess = np.where(np.isfinite(result), result, guess)
    return result


def _centroid(
    profile: EdgeProfile,
    density: Float[np.ndarray, "m c"],
    guess_cm: Float[np.ndarray, "m"],
    reach_cm: float,
    settings: TraceSettings,
) -> Float[np.ndarray, "m"]:
    """Weighted mean offset within reach of the guess; NaN where the densest cell is below the support."""
    reach = max(1, int(np.ceil(reach_cm / profile.cell_cm)))
    column = np.rint(guess_cm / profile.cell_cm).astype(np.intp) + profile.half_cells
    window = np.clip(column[:, None] + np.arange(-reach, reach + 1), 0, density.shape[1] - 1)
    weight = density[np.arange(len(density))[:, None], window] ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.sum(weight * window, axis=1) / weight.sum(axis=1)
    centre[weight.max(axis=1) < settings.min_support**2] = np.nan
    return (centre - profile.half_cells) * profile.cell_cm
