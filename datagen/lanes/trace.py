"""Trace lane lines: from edges along the path to the offsets of the lines.

A marking shows as two edges of opposite direction, its width apart. The driven lane is the pair of markings,
a lane's width apart, that runs along the whole path with the car inside it most of the time. Dynamic
programming finds both together, so that one line carries the other through gaps. The lines of adjacent lanes
follow from there outwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from datagen.lanes.markings import (
    Markings,
    TraceSettings,
    darker_than_floor,
    find_lane_width,
    find_tape_width,
)
from datagen.lanes.path import Path, PathEdges, Samples
from datagen.lanes.profile import EdgeProfile, edge_profile, long_runs
from lanenet.data.maps.line import Side
from lanenet.data.segments import true_runs
from lanenet.errors import CalibrationError, NoLaneError

#: Deviations from the line's median offset, in lane widths: a run beyond the second is dropped as a bulge if
#: it exceeds the first. The third is half the length of the median's window. Chosen: dashes lie on one curve,
#: and lanes widen over more than their own width.
_BULGE, _BULGE_BASE, _BULGE_WINDOW_LANES = 0.08, 0.04, 1.5
#: Least share of the path along which a line is seen that bounds a lane. Chosen: short dashes leave a third.
LEAST_SEEN = 0.2
#: Share of the path below which a line may be clutter. Chosen: clutter rarely lies along half of a path.
MAYBE_LINE = 0.5
#: Least visibility of the given lane's weaker line relative to that of a lane of another width. Chosen: gaps
#: between dashes leave more.
_WEAKER = 0.4
#: Offsets from a line between two lanes at which a car drives in the further lane, in lane widths. Chosen:
#: clearly beyond the line, and not beyond that lane.
_VISITS = (0.1, 1.0)
#: Shortest piece of paint that counts, in lane widths. Chosen: 3 to 4 cm, shorter than any
#: dash.
_SPECK = 0.1
#: How far a line is followed away from its place in a lane of constant width, in lane widths: the lane is up
#: to half as wide again in a bend, and one line may take all of that.
_WIDENS = 0.5
#: Steepest course of a line away from that place, and the length over which it is measured, in lane widths.
#: Derived: a lane that is half as wide again after its own width, and margin; a track that jumps to another
#: strip is steeper.
_STEEPEST, _STEEP_OVER = 0.6, 0.25
#: Least share of such a section along which the line is seen, and its shortest length, in lane widths.
#: Chosen: a tape that goes on, not dashes that may be something else.
_GOES_ON, _SHORTEST_SECTION = 0.75, 0.5


@dataclass(frozen=True)
class TracedLane:
    """The lines of the driven lane and of adjacent lanes, as offsets from the path.

    Attributes:
        left_cm: Offset of the left line's middle at each path sample; NaN where it is not supported.
        right_cm: Offset of the right line's middle.
        centre_cm: Offset of the lane's centre, without gaps.
        lane_cm: Lane width.
        tape_cm: Width of the markings.
        adjacent_cm: Further lines, by side and rank; ranks count outwards from 1.
    """

    left_cm: Samples
    right_cm: Samples
    centre_cm: Samples
    lane_cm: float
    tape_cm: float
    adjacent_cm: dict[tuple[Side, int], Samples] = field(default_factory=dict)

    @property
    def seen(self) -> tuple[float, float]:
        """Share of the path along which the left and the right line were seen."""
        return float(np.isfinite(self.left_cm).mean()), float(np.isfinite(self.right_cm).mean())


def has_dark_markings(path: Path, edges: PathEdges, camera_height_cm: float, settings: TraceSettings) -> bool:
    """Whether the markings along the path are darker than the floor; arguments as for :func:`trace_lane`."""
    profile = _profile_along(path, edges, camera_height_cm, settings)
    return darker_than_floor(profile, _driven_samples(path), camera_height_cm, settings)


def trace_lane(
    path: Path,
    edges: PathEdges,
    camera_height_cm: float,
    lane_width_cm: float | None,
    settings: TraceSettings,
    least: tuple[float, float] = (0.0, 0.0),
) -> TracedLane:
    """Find the lines that bound the driven lane.

    Args:
        path: The driven path.
        edges: Edge points in its coordinates, with normals into the markings.
        camera_height_cm: Sets the scale of cells and bounds.
        lane_width_cm: Distance between the lines; None if it is to be found.
        settings: Cell sizes and bounds.
        least: Narrowest lane that is found, see :func:`find_lane_width`.

    Raises:
        NoLaneError: If no pair of lines runs along the path.
    """
    profile = _profile_along(path, edges, camera_height_cm, settings)
    driven = _driven_samples(path)
    tape = find_tape_width(profile, driven, camera_height_cm, settings)
    markings = Markings(path, profile, tape, settings)
    if lane_width_cm is None:
        lane_width_cm = find_lane_width(markings, driven, camera_height_cm, least)
    lane, centre = markings.best_lane(lane_width_cm)
    band = settings.width_share * lane
    left, right = (
        _followed_on(markings, _without_bulges(path, markings.seen(found), centre, lane), centre, lane)
        for found in (markings.follow(centre + share * lane, band) for share in (0.5, -0.5))
    )
    if np.isfinite(left[:driven]).mean() + np.isfinite(right[:driven]).mean() < 0.3:
        raise NoLaneError("no pair of lines at one distance runs along the drive")
    return TracedLane(left, right, centre, lane, tape)


def trace_known_lane(
    path: Path, edges: PathEdges, height_cm: float, lane_width_cm: float, settings: TraceSettings
) -> tuple[TracedLane, float | None]:
    """Trace the lane of the given width, and compare it with a search without that width.

    Returns:
        The lane, and the width that the free search found; None if it found none, or if the given width fits
        the road as well. Where two lines of the given width bound several lanes, of which the car keeps to
        one, that one is the lane, and its own width is the free one.

    Raises:
        CalibrationError: If there is no lane of this width but one of another; names both.
        NoLaneError: If there is no lane.
    """
    try:
        free: TracedLane | None = trace_lane(path, edges, height_cm, None, settings)
    except NoLaneError:
        free = None
    lane: TracedLane | None
    try:
        lane = trace_lane(path, edges, height_cm, lane_width_cm, settings)
    except NoLaneError:
        lane = None
    if (
        free is not None
        # Clutter along the path makes pairs of any width.
        and min(free.seen) >= MAYBE_LINE
        and (lane is None or min(lane.seen) < LEAST_SEEN)
    ):
        raise other_lane(lane_width_cm, free.lane_cm)
    if lane is None:
        raise NoLaneError(f"no two lines {lane_width_cm:g} cm apart run along the drive")
    if free is None or not _fits_better(free, lane):
        return lane, None
    within = free.lane_cm < lane.lane_cm and min(*lane.seen, *free.seen) >= MAYBE_LINE
    return free if within and _is_kept_to(free, lane) else lane, free.lane_cm


def other_lane(given_cm: float, found_cm: float) -> CalibrationError:
    """Return the error for a lane of another width than the given one."""
    return CalibrationError(
        f"no two lines {given_cm:g} cm apart run along the drive, but two that are {found_cm:.0f} cm apart "
        "with this camera; check the lane width and the camera's height"
    )


def _fits_better(free: TracedLane, lane: TracedLane) -> bool:
    """Whether the freely found lane is more likely the driven one than the lane of the given width.

    The free search alone is no proof: clutter beside a line makes a narrower lane, and a dashed line in the
    middle of the road a wider one. Two things count against the given width: its weaker line is seen much
    less than that of the free lane, or the car keeps to the centre of the free lane and not to that of the
    given one, as on a road of two lanes whose whole width was given.
    """
    return min(lane.seen) < _WEAKER * min(free.seen) or (
        min(free.seen) >= LEAST_SEEN and _is_kept_to(free, lane)
    )


def _is_kept_to(free: TracedLane, lane: TracedLane) -> bool:
    """Whether the car keeps to the centre of the first lane, and beside that of the second."""
    aside = [abs(float(np.median(one.centre_cm))) / one.lane_cm for one in (lane, free)]
    return aside[0] > 0.15 and aside[1] < 0.5 * aside[0]


def trace_adjacent(
    path: Path, edges: PathEdges, lane: TracedLane, camera_height_cm: float, settings: TraceSettings
) -> TracedLane:
    """Find the lines of adjacent lanes, from the driven lane outwards.

    From its own lane, a car sees the far line of the next one only from afar or not at all. Where it drives
    in that lane, it sees the line well; then the line counts however little of it is seen elsewhere.

    Args:
        path: The driven path.
        edges: Edge points in its coordinates, up to where the next lane's far line comes into view.
        lane: The driven lane.
        camera_height_cm: Sets the scale of cells.
        settings: Cell sizes and bounds.

    Returns:
        The driven lane, with the lines of adjacent lanes.
    """
    profile = _profile_along(path, edges, camera_height_cm, settings)
    markings = Markings(path, profile, lane.tape_cm, settings)
    band = 2.0 * settings.width_share * lane.lane_cm
    adjacent: dict[tuple[Side, int], Samples] = {}
    sides: list[tuple[Side, float, Samples]] = [
        ("left", 1.0, lane.left_cm),
        ("right", -1.0, lane.right_cm),
    ]
    for side, sign, line in sides:
        inner = np.where(np.isfinite(line), line, lane.centre_cm + 0.5 * sign * lane.lane_cm)
        for rank in range(1, settings.neighbours + 1):
            found = markings.follow(inner + sign * lane.lane_cm, band)
            known = markings.seen(found)
            visits = _visits(path, sign * inner, sign, lane.lane_cm)
            if not _is_line(markings, known, visits, lane.lane_cm):
                break
            adjacent[side, rank] = known
            inner = np.where(np.isfinite(known), known, found)
    return replace(lane, adjacent_cm=adjacent)


def _visits(path: Path, outwards_cm: Samples, sign: float, lane_cm: float) -> Bool[np.ndarray, "n"]:
    """Return which frames drive in the lane beyond a line; ``outwards_cm`` is the line's offset outwards."""
    line = np.interp(path.s_frames_cm, path.s_cm, outwards_cm, period=path.period_cm)
    beyond = (sign * path.offsets_cm - line) / lane_cm
    return (beyond > _VISITS[0]) & (beyond < _VISITS[1])


def _is_line(markings: Markings, line_cm: Samples, visits: Bool[np.ndarray, "n"], lane_cm: float) -> bool:
    """Whether it is a painted line rather than clutter: enough of it, in runs rather than specks."""
    path, settings = markings.path, markings.settings
    shortest = max(2, int(_SPECK * lane_cm / path.step_cm))
    seen = long_runs(np.isfinite(line_cm)[:, None], shortest, path.closed)[:, 0]
    if float(seen.sum()) * path.step_cm < settings.neighbour_lanes * lane_cm:
        return False
    if float(seen.mean()) >= settings.neighbour_share:
        return True
    row = np.rint(path.s_frames_cm[visits] / path.step_cm).astype(np.intp)
    row = row % len(seen) if path.closed else np.clip(row, 0, len(seen) - 1)
    if _driven_cm(path)[visits].sum() < settings.visit_lanes * lane_cm:
        return False
    return float(seen[row].mean()) >= settings.visit_share


def _driven_cm(path: Path) -> Float[np.ndarray, "n"]:
    """Distance to each next frame along the path."""
    step = np.diff(path.s_frames_cm, append=path.s_frames_cm[-1:])
    if path.period_cm is not None:
        step = np.mod(step + 0.5 * path.period_cm, path.period_cm) - 0.5 * path.period_cm
    return np.abs(step)


def _driven_samples(path: Path) -> int:
    """Number of path samples that the car has driven over."""
    return len(path.xy_cm) if path.closed else round(float(path.s_frames_cm[-1]) / path.step_cm) + 1


def _profile_along(
    path: Path, edges: PathEdges, camera_height_cm: float, settings: TraceSettings
) -> EdgeProfile:
    """Density of edges along the path, in which lines are followed."""
    cell = settings.cell_heights * camera_height_cm
    half = int(settings.side_heights / settings.cell_heights)
    return edge_profile(path, edges, cell, half, 0.25 * camera_height_cm, settings.min_side)


def _without_bulges(path: Path, line_cm: Samples, centre_cm: Samples, lane_cm: float) -> Samples:
    """Drop short sections that bulge out of the line before and after them.

    Where a line is hidden or worn away, another strip on the floor may have been followed instead.
    """
    offset, m = line_cm - centre_cm, len(line_cm)
    reach = round(_BULGE_WINDOW_LANES * lane_cm / path.step_cm)
    index = np.arange(m)[:, None] + np.arange(-reach, reach + 1)
    around = offset[index % m]
    if not path.closed:
        around[(index < 0) | (index >= m)] = np.nan
    median = np.full(m, np.nan)
    some = np.isfinite(around).any(axis=1)
    median[some] = np.nanmedian(around[some], axis=1)
    off = np.nan_to_num(np.abs(offset - median)) / lane_cm
    kept = line_cm.copy()
    for run in true_runs(off > _BULGE_BASE, path.closed):
        if off[run].max() > _BULGE:
            kept[run] = np.nan
    return kept


def _followed_on(markings: Markings, line_cm: Samples, centre_cm: Samples, lane_cm: float) -> Samples:
    """Follow a line also where the lane widens or narrows by more than lines usually vary.

    A section is added only where the tape goes on from where the line was seen before, or after it.
    """
    path, m = markings.path, len(line_cm)
    known = np.isfinite(line_cm)
    if known.all() or not known.any():
        return line_cm
    aside = np.interp(path.s_cm, path.s_cm[known], (line_cm - centre_cm)[known], period=path.period_cm)
    guess = np.where(known, line_cm, centre_cm + aside)
    found = markings.follow(guess, _WIDENS * lane_cm)
    seen = np.isfinite(markings.seen(found)) & (known | _gentle(path, found - centre_cm, lane_cm))
    # Where the line is known, the track has to be on it.
    seen &= ~known | (np.abs(found - guess) < 0.5 * markings.tape_cm)
    followed = line_cm.copy()
    for run in true_runs(~known, path.closed):
        if len(run) * path.step_cm < _SHORTEST_SECTION * lane_cm or seen[run].mean() < _GOES_ON:
            continue
        ends = np.array([run[0] - 1, run[-1] + 1])
        ends = ends % m if path.closed else ends[(ends >= 0) & (ends < m)]
        if seen[ends].all():
            followed[run] = np.where(seen[run], found[run], np.nan)
    return followed


def _gentle(path: Path, aside_cm: Samples, lane_cm: float) -> Bool[np.ndarray, "m"]:
    """Return where a track approaches or leaves the lane's centre no faster than lanes change their width."""
    reach = max(1, round(0.5 * _STEEP_OVER * lane_cm / path.step_cm))
    index = np.arange(len(aside_cm))
    before, after = index - reach, index + reach
    if path.closed:
        before, after = before % len(index), after % len(index)
    else:
        before, after = np.maximum(before, 0), np.minimum(after, len(index) - 1)
    return np.abs(aside_cm[after] - aside_cm[before]) <= _STEEPEST * 2 * reach * path.step_cm
