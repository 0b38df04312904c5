"""Where a line was seen, which gaps in its paint are bridged, and how much of it is unpainted."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter1d

from datagen.lanes.path import Path, SampleMask

#: Weight of one border's edge points per path sample above which it counts as seen: absolute, and relative to
#: the line's median. Chosen: paint shows several points per sample and frame, clutter one now and then.
_SEEN, _SEEN_SHARE = 0.5, 0.15
#: Weight of a gap's length where a parallel line is seen. Chosen: that line fixes the offset, not the kinks.
_GUIDED_GAP = 0.4
#: Least number of painted cells in a frame for its share without paint to count. Chosen: two dashes.
_MIN_CELLS = 4


def seen_samples(
    path: Path,
    s_cm: Float[np.ndarray, "n"],
    border: Float[np.ndarray, "n"],
    weight: Float[np.ndarray, "n"],
    along_cm: float,
    alone_cm: float,
) -> SampleMask:
    """Return at which path samples a marking is seen.

    A single border counts only close to a place where both are seen: elsewhere it may be a joint or a shadow.

    Args:
        path: The path.
        s_cm: Position of the marking's edge points.
        border: 1 for points of the left border, -1 for the right one.
        weight: Weight of each point.
        along_cm: Smoothing along the path.
        alone_cm: Largest distance of a single border from a place with both.
    """
    m = len(path.xy_cm)
    row = np.clip(np.rint(s_cm / path.step_cm).astype(np.intp), 0, m)
    row = row % m if path.closed else np.minimum(row, m - 1)
    mode: Literal["wrap", "constant"] = "wrap" if path.closed else "constant"
    left, right = (
        gaussian_filter1d(
            np.bincount(row[border == sign], weight[border == sign], minlength=m).astype(np.float64),
            along_cm / path.step_cm,
            mode=mode,
        )
        for sign in (1.0, -1.0)
    )
    weaker = np.minimum(left, right)
    both = weaker > _SEEN
    if not both.any():
        return both
    enough = max(_SEEN, _SEEN_SHARE * float(np.median(weaker[both])))
    both = weaker > enough
    lead = m if path.closed else 0
    apart = distance_transform_edt(~np.pad(both, lead, mode="wrap"))[lead : lead + m]
    return both | ((np.maximum(left, right) > enough) & (apart * path.step_cm <= alone_cm))


def supported_sections(
    path: Path, seen: SampleMask, bridge_cm: float, extend_cm: float, guided: SampleMask | None = None
) -> Float[np.ndarray, "g 2"]:
    """Join seen samples to sections, across gaps that are no longer than the bridge.

    Args:
        path: The path.
        seen: Where the marking was seen.
        bridge_cm: Longest gap, with the marking seen on both sides.
        extend_cm: Extension beyond either end. A section shorter than this is dropped: it is as likely
            clutter as line.
        guided: Where a parallel line is seen; gaps count less there.

    Returns:
        (from, to); on a closed path a section across the seam ends beyond the period.
    """
    period, at = path.period_cm, path.s_cm[seen]
    if at.size < 2:
        return np.empty((0, 2))
    weight = np.ones(len(seen)) if guided is None else np.where(guided, _GUIDED_GAP, 1.0)
    cost = weight * path.step_cm
    travelled = np.cumsum(cost)[seen]
    if period is None:
        cuts = np.flatnonzero(np.diff(travelled) > bridge_cm)
        first, last = np.concatenate([[0], cuts + 1]), np.concatenate([cuts, [len(at) - 1]])
        found = np.stack([at[first], at[last]], axis=1)
    else:
        cuts = np.flatnonzero(np.diff(travelled, append=travelled[0] + cost.sum()) > bridge_cm)
        if not cuts.size:
            return np.array([[0.0, period]])
        first, last = (cuts + 1) % len(at), np.roll(cuts, -1)
        found = np.stack([at[first], at[first] + np.mod(at[last] - at[first], period)], axis=1)
    found = found[found[:, 1] - found[:, 0] > extend_cm] + [-extend_cm, extend_cm]
    return found if period is not None else np.clip(found, 0.0, path.s_cm[-1])


def unpainted_share(
    s_cm: Float[np.ndarray, "n"], frame: Int[np.ndarray, "n"], cell_cm: float, reach_cm: float
) -> float:
    """Share of a line without paint, as single frames see it.

    On the map, the dashes of several laps need not coincide; in one frame they do not move.

    Args:
        s_cm: Position of the line's edge points along the path.
        frame: Frame that saw each.
        cell_cm: Length without edge points that counts as unpainted.
        reach_cm: Largest length that a frame sees.

    Returns:
        0..1; NaN if no frame sees enough of the line.
    """
    seen = np.unique(np.stack([frame, np.floor(s_cm / cell_cm).astype(np.int64)], axis=1), axis=0)
    if not len(seen):
        return float("nan")
    first = np.flatnonzero(np.diff(seen[:, 0], prepend=seen[0, 0] - 1))
    cells = np.diff(first, append=len(seen))
    length = seen[first + cells - 1, 1] - seen[first, 1] + 1
    # A frame that sees both sides of a lap's seam appears to see a whole lap.
    counts = (cells >= _MIN_CELLS) & (length * cell_cm <= reach_cm)
    return 1.0 - float(cells[counts].sum() / length[counts].sum()) if counts.any() else float("nan")


def within(path: Path, sections_cm: Float[np.ndarray, "g 2"]) -> SampleMask:
    """Return which path samples lie in any of the sections."""
    inside = np.zeros(len(path.xy_cm), dtype=bool)
    for start, end in sections_cm:
        past = path.s_cm - start
        inside |= (past >= 0.0) & (past <= end - start)
        if path.period_cm is not None:
            inside |= np.mod(past, path.period_cm) <= end - start
    return inside
