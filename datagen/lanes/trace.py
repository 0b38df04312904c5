"""From edges along the path to the offsets of the lane lines.

A marking shows as two edges of opposite direction, a tape's width apart. The driven lane is the pair of
markings a lane's width apart that runs along the whole path, with the car inside it most of the way; both are
found together by dynamic programming, so that a dashed line and an interrupted one are carried by the other.
The lines of the neighbouring lanes are looked for from there outwards, one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from pydantic import Field
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.line import Side
from datagen.lanes.path import Path, PathEdges
from datagen.lanes.profile import EdgeProfile, edge_profile, shifted
from lanenet.config import Settings
from lanenet.errors import TrackingLostError

#: Shares of the distance of two lines within which a third one lies in the middle between them, and how well
#: it must be seen beside them: it may be dashed.
_HALF, _MIDDLE_LINE = (0.44, 0.56), 0.8
#: How much better a line in the middle is seen than what lies beside it, in the middles of the two lanes.
_CLEAR_MIDDLE = 1.25
#: How far off the middle of its lane the car may drive, as a share of the lane's width: what is further off
#: is half of a lane, beside a crack or a shadow that it drives over.
_OFF_CENTRE = 0.4


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
            more than a second line brings, so that a lane beside it with two solid lines does not take over.
        min_support: Density of edges from which a marking counts as seen, 0..1.
        width_share: How much the lane's width may vary along the road.
        neighbours: Lines to look for on each side beyond those of the driven lane.
        neighbour_lanes: Length of paint that makes a neighbouring line, in lane widths.
        neighbour_share: Share of the path along which a neighbouring line must be seen.
    """

    cell_heights: float = Field(default=0.03, gt=0.0)
    side_heights: float = Field(default=8.0, gt=0.0)
    min_side: float = Field(default=0.75, gt=0.0, lt=1.0)
    tape_heights: tuple[float, float] = (0.05, 0.6)
    lane_heights: tuple[float, float] = (0.8, 6.5)
    smoothness: float = Field(default=0.04, gt=0.0)
    sideways: float = Field(default=0.3, ge=0.0)
    second_line: float = Field(default=0.08, gt=0.0, le=1.0)
    inside: float = Field(default=0.17, ge=0.0)
    min_support: float = Field(default=0.4, gt=0.0)
    width_share: float = Field(default=0.15, gt=0.0, lt=0.5)
    neighbours: int = Field(default=1, ge=0)
    neighbour_lanes: float = Field(default=4.0, gt=0.0)
    neighbour_share: float = Field(default=0.35, ge=0.0, le=1.0)


@dataclass(frozen=True)
class TracedLane:
    """The lines of the driven lane and beside it, in path coordinates.

    Attributes:
        left_cm: Offset of the left line's middle at each path sample; NaN where nothing supports it.
        right_cm: Offset of the right line's middle.
        centre_cm: Offset of the lane's centre as found from both, everywhere.
        lane_cm: Lane width.
        tape_cm: Width of the markings.
        beside_cm: Further lines likewise, by side and rank from 1, counted outwards.
    """

    left_cm: Float[np.ndarray, "m"]
    right_cm: Float[np.ndarray, "m"]
    centre_cm: Float[np.ndarray, "m"]
    lane_cm: float
    tape_cm: float
    beside_cm: dict[tuple[Side, int], Float[np.ndarray, "m"]] = field(default_factory=dict)


def trace_lane(
    path: Path,
    edges: PathEdges,
    camera_height_cm: float,
    lane_width_cm: float | None,
    settings: TraceSettings,
) -> TracedLane:
    """Find the lines that bound the driven lane, and those of the lanes beside it.

    Args:
        path: The driven path.
        edges: Edge points in its coordinates.
        camera_height_cm: Sets the scale of cells and bounds.
        lane_width_cm: Distance between the lines where the scale is known; None looks for it.
        settings: Cell sizes and bounds.

    Raises:
        TrackingLostError: If no pair of lines runs along the path.
    """
    cell = settings.cell_heights * camera_height_cm
    half = int(settings.side_heights / settings.cell_heights)
    profile = edge_profile(path, edges, cell, half, 0.25 * camera_height_cm, settings.min_side)
    driven = len(path.xy_cm)
    if not path.closed:
        driven = round(float(path.s_frames_cm[-1]) / path.step_cm) + 1
    tape = _tape_width(profile, driven, camera_height_cm, settings)
    tapes = profile.tapes(tape)
    if lane_width_cm is None:
        lane_width_cm = _lane_width(path, tapes, profile, driven, camera_height_cm, settings)
    lane, centre = _best_lane(path, tapes, profile, lane_width_cm, settings)
    band = settings.width_share * lane
    left = _follow(path, tapes, profile, centre + 0.5 * lane, band, settings)
    right = _follow(path, tapes, profile, centre - 0.5 * lane, band, settings)
    left, right = (_known_middle(profile, line, tape, settings) for line in (left, right))
    if np.isfinite(left[:driven]).mean() + np.isfinite(right[:driven]).mean() < 0.3:
        raise TrackingLostError(
            f"no pair of lines about {lane_width_cm:.0f} cm apart runs along the drive: check the lane width "
            "and the camera's height, and look at the map's picture"
        )
    beside: dict[tuple[Side, int], Float[np.ndarray, "m"]] = {}
    sides: list[tuple[Side, float, Float[np.ndarray, "m"]]] = [("left", 1.0, left), ("right", -1.0, right)]
    for side, sign, line in sides:
        guess = np.where(np.isfinite(line), line, centre + 0.5 * sign * lane)
        for rank in range(1, settings.neighbours + 1):
            found = _follow(path, tapes, profile, guess + sign * lane, 2.0 * band, settings)
            known = _known_middle(profile, found, tape, settings)
            if not _is_line(path, known, lane, settings):
                break
            beside[side, rank] = known
            guess = np.where(np.isfinite(known), known, found)
    return TracedLane(left, right, centre, lane, tape, beside)


def _tape_width(profile: EdgeProfile, driven: int, camera_height_cm: float, settings: TraceSettings) -> float:
    """Width at which left and right edges pair up best, over the driven stretch."""
    low, high = (t * camera_height_cm for t in settings.tape_heights)
    widths = np.arange(low, high, 0.5 * profile.cell_cm)
    # The best pairing at each path position, on either side; a wrong width pairs by chance only.
    scores = [np.sort(profile.tapes(w)[:driven], axis=1)[:, -6:].mean() for w in widths]
    return float(widths[int(np.argmax(gaussian_filter1d(np.array(scores), 1.0)))])


def _lane_width(
    path: Path,
    tapes: Float[np.ndarray, "m c"],
    profile: EdgeProfile,
    driven: int,
    camera_height_cm: float,
    settings: TraceSettings,
) -> float:
    """Distance at which two markings run side by side along the path, one on either side of it.

    Where a line runs in the middle between the two, the car drives in one of two lanes.
    """
    low, high = (w * camera_height_cm for w in settings.lane_heights)
    widths = np.arange(low, high, 2.0 * profile.cell_cm)
    scores = []
    for width in widths:
        pair = _pair_score(tapes[:driven], width / profile.cell_cm)
        within = int(_OFF_CENTRE * width / profile.cell_cm)
        scores.append(
            np.sqrt(pair[:, profile.half_cells - within : profile.half_cells + within + 1]).max(axis=1).mean()
        )
    score = gaussian_filter1d(np.array(scores), 1.5)
    peaks = [i for i in range(1, len(score) - 1) if score[i] >= score[i - 1] and score[i] > score[i + 1]]
    if not peaks:
        raise TrackingLostError("no two lines run side by side along the drive, so that its scale is unknown")
    best = max(peaks, key=lambda i: score[i])
    whole = float(widths[best])
    low, high = (share * whole for share in _HALF)
    halves = [i for i in peaks if low < widths[i] < high and score[i] >= _MIDDLE_LINE * score[best]]
    if not halves:
        return whole
    # On a mottled floor the followed specks of any place across the road look half like a line.
    _, centre = _best_lane(path, tapes, profile, whole, settings)
    left, middle, right = (
        _followed_support(path, tapes, profile, centre + share * whole, whole, settings)
        for share in (0.25, 0.0, -0.25)
    )
    if middle < _CLEAR_MIDDLE * max(left, right):
        return whole
    return float(widths[max(halves, key=lambda i: score[i])])


def _followed_support(
    path: Path,
    tapes: Float[np.ndarray, "m c"],
    profile: EdgeProfile,
    guess_cm: Float[np.ndarray, "m"],
    whole_cm: float,
    settings: TraceSettings,
) -> float:
    """Mean support of the marking, or what looks most like one, that runs about these offsets."""
    followed = _follow(path, tapes, profile, guess_cm, (max(_HALF) - 0.5) * whole_cm, settings)
    column = np.rint(followed / profile.cell_cm).astype(np.intp) + profile.half_cells
    return float(tapes[np.arange(len(tapes)), np.clip(column, 0, tapes.shape[1] - 1)].mean())


def _pair_score(tapes: Float[np.ndarray, "m c"], width_cells: float) -> Float[np.ndarray, "m c"]:
    """Product of left and right support for a lane centred at each offset."""
    return shifted(tapes, 0.5 * width_cells) * shifted(tapes, -0.5 * width_cells)


def _best_lane(
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


def _car_outside(path: Path, profile: EdgeProfile, lane_cm: float) -> Float[np.ndarray, "m c"]:
    """How far outside a lane centred at each offset the car is, 1 from a lane away, mean of all visits."""
    m, columns = profile.left.shape
    at = (np.arange(columns) - profile.half_cells) * profile.cell_cm
    d = np.zeros(len(path.s_frames_cm)) if path.d_frames_cm is None else path.d_frames_cm
    forward = np.ones(len(d), dtype=bool) if path.forward is None else path.forward
    rows = np.rint(path.s_frames_cm / path.step_cm).astype(np.intp) % m
    total, visits = np.zeros((m, columns)), np.zeros(m)
    for row, offset in zip(rows[forward], d[forward], strict=True):
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


def _follow(
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


def _known_middle(
    profile: EdgeProfile, line_cm: Float[np.ndarray, "m"], tape_cm: float, settings: TraceSettings
) -> Float[np.ndarray, "m"]:
    """Keep a followed line where both edges of its marking are seen; NaN elsewhere."""
    edges = []
    for density, offset in ((profile.left, 0.5 * tape_cm), (profile.right, -0.5 * tape_cm)):
        column = np.rint((line_cm + offset) / profile.cell_cm).astype(np.intp) + profile.half_cells
        window = np.clip(column[:, None] + np.arange(-1, 2), 0, density.shape[1] - 1)
        edges.append(np.take_along_axis(density, window, axis=1).max(axis=1))
    return np.where(np.minimum(*edges) >= settings.min_support, line_cm, np.nan)


def _is_line(path: Path, line_cm: Float[np.ndarray, "m"], lane_cm: float, settings: TraceSettings) -> bool:
    """Tell a painted line from clutter: enough of it, in runs rather than in specks."""
    seen = _in_runs(np.isfinite(line_cm), max(2, int(0.1 * lane_cm / path.step_cm)))
    length = float(seen.sum()) * path.step_cm
    return length >= settings.neighbour_lanes * lane_cm and float(seen.mean()) >= settings.neighbour_share


def _in_runs(seen: Bool[np.ndarray, "m"], shortest: int) -> Bool[np.ndarray, "m"]:
    """Drop runs of fewer samples."""
    kept = np.zeros(len(seen), dtype=bool)
    for run in np.split(np.arange(len(seen)), np.flatnonzero(np.diff(seen.astype(np.int8))) + 1):
        kept[run] = seen[run[0]] and len(run) >= shortest
    return kept
