"""Settings of the lane filter, and its first step: edge points of a row paired to markings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field

from lanenet.config import Settings

#: Settings that switch off every check which is not in the paper.
PAPER: dict[str, Any] = {
    "polarity": "ignored",
    "agreement_share": 0.0,
    "clear_share": 0.0,
    "max_pairs": None,
    "max_centre_jump": None,
    "max_edge_share": 1.0,
}


class LaneFilterSettings(Settings):
    """What the filter accepts as a lane.

    The paper's filter uses distances between edge points alone. In textured images some points have these
    distances by chance. The checks that were added look at the directions of the edges, at neighbouring rows
    and at contradictions; :data:`PAPER` switches them off. On three simulated drives they reduce the RMSE
    from 3.78 to 0.99 cm, and 70 instead of 62 % of the points are answered
    (``tests/sim/test_lane_filter_on_simulated_drives.py``).

    Attributes:
        lane_width_cm: Distance between the middles of the two lines of the driven lane.
        lane_width_tolerance_cm: How far a pair of markings may be from that.
        marking_cm: Thickness of a marking (tape).
        marking_tolerance_cm: How far a pair of edges may be from that; edges are a pixel of road uncertain.
        grid_cm: Grid to whose nodes the points are moved; the paper's 2 mm.
        row_cm: Extent along y of one row: a pixel of the paper's camera, 6 mm. The paper's rows of 2 mm
            seldom hold all four edges.
        row_tolerance_cm: How far from the wanted row the search goes if that one has no lane.
        look_ahead_cm: Distance of the aim point A; the paper's 15 cm.
        max_edge_share: Frames with more edge points than this share of the road's pixels have no lane, since
            every distance occurs by chance. Not in the paper; 1 switches it off.
        polarity: The two edges of a ``bright`` marking face each other, those of a ``dark`` one away;
            ``any`` takes both, but never one of each in a pair. ``ignored``, as in the paper, uses edges
            without direction and measures distances along the row instead of across the lines.
        parallel_rad: Largest difference in direction of the two edges of a marking, and of the two lines of a
            lane, which differ along a row of a curve. Not used with ``ignored``.
        agreement_cm: Extent along y, before and behind a row, in which its two lines have to continue. Not in
            the paper.
        agreement_share: Share of that extent in which both have to be seen; about a half at the end of a dash
            and at the border of the image. 0 switches it off, as does ``ignored``.
        clear_share: A row has no lane if less than this share of the edge points between its lines, over the
            same extent, lies on the two lines: the floor of a lane is empty, a texture is not. Not in the
            paper; 0 switches it off.
        max_pairs: A row with more pairs that satisfy all conditions is ambiguous and has no lane; three lanes
            side by side are three pairs. Not in the paper; null switches it off.
        max_centre_jump: The far row is dropped if its centre is further than this share of the lane width to
            the side of the near row's, or if the widths differ by more than their tolerance. Not in the
            paper; null switches it off.
    """

    lane_width_cm: float = Field(gt=0.0)
    lane_width_tolerance_cm: float = Field(default=4.0, gt=0.0)
    marking_cm: float = Field(default=2.0, gt=0.0)
    marking_tolerance_cm: float = Field(default=0.8, gt=0.0)
    grid_cm: float = Field(default=0.2, gt=0.0)
    row_cm: float = Field(default=0.6, gt=0.0)
    row_tolerance_cm: float = Field(default=2.4, ge=0.0)
    look_ahead_cm: float = Field(default=15.0, gt=0.0)
    max_edge_share: float = Field(default=0.10, gt=0.0, le=1.0)
    polarity: Literal["any", "bright", "dark", "ignored"] = "any"
    parallel_rad: float = Field(default=0.5, gt=0.0, lt=1.57)
    agreement_cm: float = Field(default=8.0, gt=0.0, le=60.0)
    agreement_share: float = Field(default=0.4, ge=0.0, le=1.0)
    clear_share: float = Field(default=0.5, ge=0.0, le=1.0)
    max_pairs: int | None = Field(default=4, ge=1)
    max_centre_jump: float | None = Field(default=0.5, gt=0.0)


#: A line at a larger angle from straight ahead is not used. Chosen: at 60 degrees an error of the direction
#: of 3 degrees changes a width by a tenth.
MAX_OBLIQUE_RAD = math.pi / 3.0
#: A marking that only confirms a line may miss the thickness by this many tolerances, since far from the car
#: it is a few pixels thick.
_SLACK = 2.0


@dataclass(frozen=True)
class Markings:
    """Pairs of edges whose spacing is about a marking's thickness, sorted by row and middle.

    Attributes:
        row: Index of the row of each, counted from the wanted row.
        middle_cm: x of its middle, frame car.
        direction_rad: Direction of its line, from straight ahead, positive right; 0 where it is ignored.
        polarity: 1 for brighter than the floor, -1 for darker, 0 where that is ignored.
        exact: True where the thickness lies within its tolerance.
    """

    row: Int[np.ndarray, "n"]
    middle_cm: Float[np.ndarray, "n"]
    direction_rad: Float[np.ndarray, "n"]
    polarity: Int[np.ndarray, "n"]
    exact: Bool[np.ndarray, "n"]

    def subset(self, keep: Bool[np.ndarray, "n"] | Int[np.ndarray, "m"]) -> Markings:
        """Return some of them, in the order asked for."""
        return Markings(
            self.row[keep],
            self.middle_cm[keep],
            self.direction_rad[keep],
            self.polarity[keep],
            self.exact[keep],
        )


def find_markings(
    points_cm: Float[np.ndarray, "n 2"],
    normals: Float[np.ndarray, "n 2"] | None,
    y_cm: float,
    reach_cm: float,
    settings: LaneFilterSettings,
) -> Markings:
    """Find all markings near a row.

    Args:
        points_cm: Edge points, [cm], frame car; points that are not finite are ignored.
        normals: Unit vectors across the edges, towards the brighter side. With them the two edges have to
            face each other or point apart, and the thickness is measured across the line; without them it is
            measured along the row, as in the paper.
        y_cm: The row from which the others are counted, ``row_cm`` apart.
        reach_cm: How far from it markings are looked for.
        settings: Thickness, grid, polarity and their tolerances.

    Returns:
        The markings; one edge may belong to several.
    """
    near = (np.abs(points_cm[:, 1] - y_cm) <= reach_cm + settings.row_cm) & np.isfinite(points_cm[:, 0])
    x, y = points_cm[near].T
    rows = np.rint((y - y_cm) / settings.row_cm).astype(np.int64)
    nodes = np.rint(x / settings.grid_cm).astype(np.int64)
    order = np.lexsort((nodes, rows))
    rows, nodes = rows[order], nodes[order]
    widest_cm = settings.marking_cm + settings.marking_tolerance_cm + 1e-9
    if normals is not None:
        widest_cm = settings.marking_cm + _SLACK * settings.marking_tolerance_cm
        widest_cm /= math.cos(MAX_OBLIQUE_RAD)
    # All rows on one axis, far apart, so that one search serves them all.
    reach = widest_cm / settings.grid_cm
    span = int(np.ptp(nodes)) + int(reach) + 2 if nodes.size else 1
    keys = rows * span + nodes
    first, second = index_ranges(
        np.arange(1, keys.size + 1), np.searchsorted(keys, keys + reach, side="right")
    )
    gap_cm = (nodes[second] - nodes[first]) * settings.grid_cm
    middle_cm = (nodes[first] + nodes[second]) * (0.5 * settings.grid_cm)
    apart = gap_cm > 0.0
    first, second, gap_cm, middle_cm = first[apart], second[apart], gap_cm[apart], middle_cm[apart]
    row = rows[first]
    if normals is None:
        exact = np.abs(gap_cm - settings.marking_cm) <= settings.marking_tolerance_cm + 1e-9
        nothing = np.zeros(row.size)
        found = Markings(row, middle_cm, nothing, nothing.astype(np.int64), exact).subset(exact)
    else:
        across = normals[near][order]
        found = _facing_edges(row, middle_cm, gap_cm, across[first], across[second], settings)
    return found.subset(np.lexsort((found.middle_cm, found.row)))


def _facing_edges(
    row: Int[np.ndarray, "n"],
    middle_cm: Float[np.ndarray, "n"],
    gap_cm: Float[np.ndarray, "n"],
    left_normals: Float[np.ndarray, "n 2"],
    right_normals: Float[np.ndarray, "n 2"],
    settings: LaneFilterSettings,
) -> Markings:
    """Keep the pairs of edges that are parallel, of opposite normals and the right distance apart."""
    # From the left edge to the right one on a bright marking, and back on a dark one.
    facing = left_normals - right_normals
    side = np.copysign(1.0, facing[:, 0])
    direction = np.arctan2(-facing[:, 1] * side, np.abs(facing[:, 0]))
    off_cm = np.abs(gap_cm * np.cos(direction) - settings.marking_cm)
    slack_cm = settings.marking_tolerance_cm + 1e-9
    # The difference of unit vectors at an angle of pi - a has the length 2 cos(a / 2).
    length = np.hypot(facing[:, 0], facing[:, 1])
    good = (length >= 2.0 * math.cos(0.5 * settings.parallel_rad)) & (off_cm <= _SLACK * slack_cm)
    good &= np.abs(direction) <= MAX_OBLIQUE_RAD
    if settings.polarity in ("bright", "dark"):
        good &= side == (1.0 if settings.polarity == "bright" else -1.0)
    return Markings(row, middle_cm, direction, side.astype(np.int64), off_cm <= slack_cm).subset(good)


def index_ranges(
    first: Int[np.ndarray, "n"], last: Int[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Pair each index i with first[i], ..., last[i] - 1."""
    counts = np.maximum(last - first, 0)
    one = np.repeat(np.arange(first.size), counts)
    within = np.arange(one.size) - np.repeat(np.cumsum(counts) - counts, counts)
    return one, first[one] + within
