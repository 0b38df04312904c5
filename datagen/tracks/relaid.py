"""Lines that were laid anew between two drives: places where their maps contradict each other.

Each drive's lines are fitted to its own edges, in the common map frame. Where they differ by more than the
maps know, or one has a line where the other saw none, the tape lay elsewhere; such places are not averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from datagen.tracks.align import distances
from datagen.tracks.shape import STEP_CM, TrackShape
from lanenet.data.maps.line import LaneLine
from lanenet.data.segments import true_runs

#: Lines of two drives that were adjusted together differ where they are further apart than so many sigmas of
#: both, and at least this, [cm]. Chosen: what makes a label wrong; on two halves of ``garage_tape`` no place
#: is that far apart.
_SIGMAS, _LEAST_CM = 4.0, 1.5
#: Least length of a place, [cm], and gap across which two places are one. Chosen: shorter ones are ends of
#: dashes and kinks.
_SHORTEST_CM, _GAP_CM = 12.0, 10.0
#: Margin of a place along the line, [cm]. Chosen: a cubic bends over this length.
_MARGIN_CM = 8.0
#: A place belongs to a line of the joined map within this distance, in lane widths.
_OF_LINE_LANES = 0.4


@dataclass(frozen=True)
class RelaidPlace:
    """A section of a line that lies elsewhere on another drive.

    Attributes:
        drives: Names of the two drives.
        at_cm: Its middle, common map frame.
        points_cm: The section as the first of the drives has it.
        length_cm: Its length.
        apart_cm: Median distance between both lines; None where the second drive saw no line near.
    """

    drives: tuple[str, str]
    at_cm: tuple[float, float]
    points_cm: Float[np.ndarray, "k 2"]
    length_cm: float
    apart_cm: float | None

    @property
    def text(self) -> str:
        """The place in words."""
        first, second = self.drives
        where = f"{self.length_cm:.0f} cm of a line near x {self.at_cm[0]:.0f}, y {self.at_cm[1]:.0f} cm"
        if self.apart_cm is None:
            return f"{where}: {first} has it, {second} saw none there"
        return f"{where}: {self.apart_cm:.1f} cm between {first} and {second}"


def relaid_places(shapes: Sequence[TrackShape]) -> list[RelaidPlace]:
    """Find the places where lines of drives that lie in one map frame contradict each other.

    Args:
        shapes: Lines of each drive, from its own edges, in the common frame.
    """
    found = []
    for a in shapes:
        for b in shapes:
            if a is not b:
                found += _differing(a, b)
    return found


def _differing(a: TrackShape, b: TrackShape) -> list[RelaidPlace]:
    places = []
    sigma_b = b.sigma_cm
    for line in a.lines:
        off, nearest = distances(b, line.xy_cm, line.tangent)
        sigma = np.hypot(np.nan_to_num(line.sigma_cm), sigma_b[nearest])
        differs = np.isnan(off) | (np.abs(off) > np.maximum(_LEAST_CM, _SIGMAS * sigma))
        differs &= line.known & ~np.isinf(off)
        for run in true_runs(_closed_gaps(differs), line.closed):
            length_cm = STEP_CM * len(run)
            if length_cm < _SHORTEST_CM or np.mean(differs[run]) < 0.6:
                continue
            met = off[run][np.isfinite(off[run])]
            apart = float(np.median(np.abs(met))) if len(met) > 0.3 * len(run) else None
            middle = line.xy_cm[run[len(run) // 2]]
            at = float(middle[0]), float(middle[1])
            places.append(RelaidPlace((a.name, b.name), at, line.xy_cm[run], length_cm, apart))
    return places


def _closed_gaps(flags: Bool[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """Fill short gaps between places."""
    filled = flags.copy()
    for run in true_runs(~flags):
        inner = run[0] > 0 and run[-1] < len(flags) - 1
        if inner and STEP_CM * len(run) <= _GAP_CM:
            filled[run] = True
    return filled


def masked_lines(lines: Sequence[LaneLine], places: Sequence[RelaidPlace], lane_cm: float) -> list[LaneLine]:
    """Withhold the places from lines, as if images contradicted them: labels have no points there.

    Args:
        lines: Lines of the joined map.
        places: Where drives contradict each other, in its scale.
        lane_cm: Lane width.
    """
    if not places:
        return list(lines)
    points = np.concatenate([place.points_cm for place in places])
    positions = [np.arange(*line.span_cm, STEP_CM) for line in lines]
    found = [
        cKDTree(line.everywhere(s_cm)).query(points) for line, s_cm in zip(lines, positions, strict=True)
    ]
    apart_cm = np.stack([apart for apart, _ in found])
    owner = np.where(apart_cm.min(axis=0) < _OF_LINE_LANES * lane_cm, np.argmin(apart_cm, axis=0), -1)
    nearest = np.stack([row for _, row in found])
    return [
        _withheld(line, s_cm, np.unique(nearest[number, owner == number]))
        for number, (line, s_cm) in enumerate(zip(lines, positions, strict=True))
    ]


def _withheld(line: LaneLine, s_cm: Float[np.ndarray, "m"], rows: Int[np.ndarray, "k"]) -> LaneLine:
    """Withhold a line around some of its positions."""
    if not len(rows):
        return line
    away_cm = np.abs(s_cm[:, None] - s_cm[rows])
    if line.period_cm is not None:
        away_cm = np.minimum(away_cm, line.period_cm - away_cm)
    sections = []
    for run in true_runs(away_cm.min(axis=1) <= _MARGIN_CM, line.period_cm is not None):
        start, end = float(s_cm[run[0]]), float(s_cm[run[-1]])
        # On a lap, a section across the seam ends beyond the period.
        sections.append((start, end if end >= start else end + float(line.period_cm or 0.0)))
    return replace(line, contradicted_cm=np.concatenate([line.contradicted_cm, np.array(sections)]))
