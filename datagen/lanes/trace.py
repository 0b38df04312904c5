"""From edges along the path to the offsets of the lane lines.

A marking shows as two edges of opposite direction, a tape's width apart. The driven lane is the pair of
markings a lane's width apart that runs along the whole path, with the car inside it most of the way; both are
found together by dynamic programming, so that a dashed line and an interrupted one are carried by the other.
The lines of the neighbouring lanes follow in :mod:`datagen.lanes.beside`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from datagen.lanes.follow import TraceSettings, best_lane, follow_line
from datagen.lanes.path import Path, PathEdges
from datagen.lanes.profile import EdgeProfile, edge_profile
from datagen.lanes.width import find_lane_width, find_tape_width
from lanenet.data.maps.line import Side
from lanenet.data.segments import true_runs
from lanenet.errors import CalibrationError, TrackingLostError

__all__ = ["TraceSettings", "TracedLane", "trace_known_lane", "trace_lane"]


#: How far a line may lie beside its usual offset, as a share of the lane's width: beyond the first, what is
#: off by the second goes as well; and how far around the usual offset is looked for, in lane widths.
_STRAY, _BESIDE, _STRAY_REACH_LANES = 0.08, 0.04, 1.5

#: A line that is there along less of the way than this does not bound a lane.
LEAST_SEEN = 0.2
#: Less than this of a line is clutter that happens to lie along the way.
MAYBE_LINE = 0.5
#: A line of the given lane that is seen along less than this share of the way along which one of another
#: width is: gaps between dashes leave more.
_HARDLY = 0.4


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
    profile = profile_along(path, edges, camera_height_cm, settings)
    driven = len(path.xy_cm)
    if not path.closed:
        driven = round(float(path.s_frames_cm[-1]) / path.step_cm) + 1
    tape = find_tape_width(profile, driven, camera_height_cm, settings)
    tapes = profile.tapes(tape)
    if lane_width_cm is None:
        lane_width_cm = find_lane_width(path, tapes, profile, driven, camera_height_cm, settings)
    lane, centre = best_lane(path, tapes, profile, lane_width_cm, settings)
    band = settings.width_share * lane
    left = follow_line(path, tapes, profile, centre + 0.5 * lane, band, settings)
    right = follow_line(path, tapes, profile, centre - 0.5 * lane, band, settings)
    left, right = (
        _without_strays(path, known_middle(profile, line, tape, settings), centre, lane)
        for line in (left, right)
    )
    if np.isfinite(left[:driven]).mean() + np.isfinite(right[:driven]).mean() < 0.3:
        raise TrackingLostError(
            f"no pair of lines about {lane_width_cm:.0f} cm apart runs along the drive: check the lane width "
            "and the camera's height, and look at the map's picture"
        )
    return TracedLane(left, right, centre, lane, tape)


def profile_along(
    path: Path, edges: PathEdges, camera_height_cm: float, settings: TraceSettings
) -> EdgeProfile:
    """Density of edges beside the path in which lines are followed."""
    cell = settings.cell_heights * camera_height_cm
    half = int(settings.side_heights / settings.cell_heights)
    return edge_profile(path, edges, cell, half, 0.25 * camera_height_cm, settings.min_side)


def known_middle(
    profile: EdgeProfile, line_cm: Float[np.ndarray, "m"], tape_cm: float, settings: TraceSettings
) -> Float[np.ndarray, "m"]:
    """Keep a followed line where both edges of its marking are seen; NaN elsewhere."""
    edges = []
    for density, offset in ((profile.left, 0.5 * tape_cm), (profile.right, -0.5 * tape_cm)):
        column = np.rint((line_cm + offset) / profile.cell_cm).astype(np.intp) + profile.half_cells
        window = np.clip(column[:, None] + np.arange(-1, 2), 0, density.shape[1] - 1)
        edges.append(np.take_along_axis(density, window, axis=1).max(axis=1))
    return np.where(np.minimum(*edges) >= settings.min_support, line_cm, np.nan)


def _without_strays(
    path: Path, line_cm: Float[np.ndarray, "m"], centre_cm: Float[np.ndarray, "m"], lane_cm: float
) -> Float[np.ndarray, "m"]:
    """Drop short stretches that bulge out of the way of the line before and after them.

    Where a line is hidden or worn away, a strip of tape on the floor is followed instead. Dashes lie on one
    way, all of them, and a lane becomes wider over more than its own width.
    """
    offset, m = line_cm - centre_cm, len(line_cm)
    reach = round(_STRAY_REACH_LANES * lane_cm / path.step_cm)
    index = np.arange(m)[:, None] + np.arange(-reach, reach + 1)
    around = offset[index % m]
    if not path.closed:
        around[(index < 0) | (index >= m)] = np.nan
    usual = np.full(m, np.nan)
    some = np.isfinite(around).any(axis=1)
    usual[some] = np.nanmedian(around[some], axis=1)
    off = np.nan_to_num(np.abs(offset - usual)) / lane_cm
    kept = line_cm.copy()
    for piece in true_runs(off > _BESIDE, path.closed):
        if off[piece].max() > _STRAY:
            kept[piece] = np.nan
    return kept


def trace_known_lane(
    path: Path, edges: PathEdges, height_cm: float, lane_width_cm: float, settings: TraceSettings
) -> tuple[TracedLane, float | None]:
    """Trace the lane of the given width, and look for the lane's width without that number too.

    Returns:
        The lane, and the width of the lane that is found freely; None where none is, or where the lane of the
        given width fits the road as well.

    Raises:
        CalibrationError: If there is no lane of this width but one of another; names both.
        TrackingLostError: If there is no lane.
    """
    try:
        free: TracedLane | None = trace_lane(path, edges, height_cm, None, settings)
    except TrackingLostError:
        free = None
    lane: TracedLane | None
    try:
        lane = trace_lane(path, edges, height_cm, lane_width_cm, settings)
    except TrackingLostError:
        if free is None:
            raise
        lane = None
    if (
        free is not None
        # Clutter that lies along the way makes pairs of any width.
        and min(_seen(free)) >= MAYBE_LINE
        and (lane is None or min(_seen(lane)) < LEAST_SEEN)
    ):
        raise other_lane(lane_width_cm, free.lane_cm)
    if lane is None:
        raise TrackingLostError(f"no two lines {lane_width_cm:g} cm apart run along the drive")
    return lane, free.lane_cm if free is not None and _fits_better(free, lane) else None


def other_lane(given_cm: float, found_cm: float) -> CalibrationError:
    return CalibrationError(
        f"no two lines {given_cm:g} cm apart run along the drive, but two that are {found_cm:.0f} cm apart "
        "with this camera: check the lane width and the camera's height"
    )


def _fits_better(free: TracedLane, lane: TracedLane) -> bool:
    """Whether the lane that was found freely is more likely the driven one than that of the given width.

    The free search alone is no proof: clutter beside a line makes a narrower lane, and the far line of a road
    of two lanes, where the one in its middle is dashed, a wider one. It counts where the weaker line of the
    given lane is hardly seen beside its own, or where the car keeps to its middle and not to that of the
    given lane, as on a road of two lanes whose whole width was given.
    """
    if min(_seen(lane)) < _HARDLY * min(_seen(free)):
        return True
    aside = [abs(float(np.median(one.centre_cm))) / one.lane_cm for one in (lane, free)]
    return min(_seen(free)) >= LEAST_SEEN and aside[0] > 0.15 and aside[1] < 0.5 * aside[0]


def _seen(lane: TracedLane) -> tuple[float, float]:
    """Share of the way along which the left and the right line were seen."""
    return float(np.isfinite(lane.left_cm).mean()), float(np.isfinite(lane.right_cm).mean())
