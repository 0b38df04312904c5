"""The lines of the lanes beside the driven one, looked for from there outwards, one after the other.

From its own lane a car sees the far line of the next one only from afar, or not at all. Where it drives in
that lane itself, it sees the line as well as any: a line that is seen there is one, however little of it is
seen along the rest of the way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from datagen.lanes.follow import TraceSettings, follow_line
from datagen.lanes.path import Path, PathEdges
from datagen.lanes.trace import TracedLane, known_middle, profile_along
from lanenet.data.maps.line import Side
from lanenet.data.segments import true_runs

#: How far from the line between two lanes a car is that drives in the further one, in lane widths.
_VISITS = (0.1, 1.0)
#: Shortest piece of paint that counts, in lane widths.
_SPECK = 0.1


def trace_beside(
    path: Path, edges: PathEdges, lane: TracedLane, camera_height_cm: float, settings: TraceSettings
) -> TracedLane:
    """Find the lines beyond those of the driven lane.

    Args:
        path: The driven path.
        edges: Edge points in its coordinates, up to where the next lane's far line comes into view.
        lane: The driven lane.
        camera_height_cm: Sets the scale of cells.
        settings: Cell sizes and bounds.

    Returns:
        The driven lane, with the lines beside it.
    """
    profile = profile_along(path, edges, camera_height_cm, settings)
    tapes = profile.tapes(lane.tape_cm)
    band = 2.0 * settings.width_share * lane.lane_cm
    beside: dict[tuple[Side, int], Float[np.ndarray, "m"]] = {}
    sides: list[tuple[Side, float, Float[np.ndarray, "m"]]] = [
        ("left", 1.0, lane.left_cm),
        ("right", -1.0, lane.right_cm),
    ]
    for side, sign, line in sides:
        inner = np.where(np.isfinite(line), line, lane.centre_cm + 0.5 * sign * lane.lane_cm)
        for rank in range(1, settings.neighbours + 1):
            found = follow_line(path, tapes, profile, inner + sign * lane.lane_cm, band, settings)
            known = known_middle(profile, found, lane.tape_cm, settings)
            visits = _visits(path, sign * inner, sign, lane.lane_cm)
            if not _is_line(path, known, visits, lane.lane_cm, settings):
                break
            beside[side, rank] = known
            inner = np.where(np.isfinite(known), known, found)
    return replace(lane, beside_cm=beside)


def _visits(
    path: Path, outwards_cm: Float[np.ndarray, "m"], sign: float, lane_cm: float
) -> Bool[np.ndarray, "n"]:
    """Tell which frames drive in the lane beyond a line; outwards, its offset is positive."""
    line = np.interp(path.s_frames_cm, path.s_cm, outwards_cm, period=path.period_cm)
    beyond = (sign * path.offsets_cm - line) / lane_cm
    return (beyond > _VISITS[0]) & (beyond < _VISITS[1])


def _is_line(
    path: Path,
    line_cm: Float[np.ndarray, "m"],
    visits: Bool[np.ndarray, "n"],
    lane_cm: float,
    settings: TraceSettings,
) -> bool:
    """Tell a painted line from clutter: enough of it, in runs rather than in specks."""
    shortest = max(2, int(_SPECK * lane_cm / path.step_cm))
    seen = _in_runs(np.isfinite(line_cm), shortest, path.closed)
    if float(seen.sum()) * path.step_cm < settings.neighbour_lanes * lane_cm:
        return False
    if float(seen.mean()) >= settings.neighbour_share:
        return True
    row = np.rint(path.s_frames_cm[visits] / path.step_cm).astype(np.intp)
    row = row % len(seen) if path.closed else np.clip(row, 0, len(seen) - 1)
    if _way_cm(path)[visits].sum() < settings.visit_lanes * lane_cm:
        return False
    return float(seen[row].mean()) >= settings.visit_share


def _way_cm(path: Path) -> Float[np.ndarray, "n"]:
    """Way that each frame stands for, all laps and both directions."""
    step = np.diff(path.s_frames_cm, append=path.s_frames_cm[-1:])
    if path.period_cm is not None:
        step = np.mod(step + 0.5 * path.period_cm, path.period_cm) - 0.5 * path.period_cm
    return np.abs(step)


def _in_runs(seen: Bool[np.ndarray, "m"], shortest: int, closed: bool) -> Bool[np.ndarray, "m"]:
    """Drop runs of fewer samples."""
    kept = np.zeros(len(seen), dtype=bool)
    for run in true_runs(seen, closed):
        kept[run] = len(run) >= shortest
    return kept
