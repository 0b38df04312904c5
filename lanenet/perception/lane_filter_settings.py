"""What the lane filter takes for a lane: the paper's distances, and the checks that were added to them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from lanenet.config import Settings

#: Values that leave out every check which is not in the paper.
PAPER: dict[str, Any] = {
    "polarity": "ignored",
    "agreement_share": 0.0,
    "clear_share": 0.0,
    "max_pairs": None,
    "max_centre_jump": None,
    "max_edge_share": 1.0,
}


class LaneFilterSettings(Settings):
    """What the filter takes for a lane.

    The paper's filter knows distances between edge points and nothing else. In a picture full of texture
    some points have these distances by chance, so that checks were added: by the directions of the edges,
    by agreement over neighbouring rows, and by what contradicts itself. :data:`PAPER` switches them off.

    Attributes:
        lane_width_cm: Distance between the middles of the two lines of the driven lane.
        lane_width_tolerance_cm: How far a pair of markings may be from that.
        marking_cm: Thickness of a marking (tape).
        marking_tolerance_cm: How far a pair of edges may be from that; edges are a pixel of road uncertain.
        grid_cm: Grid to whose nodes the points are moved.
        row_cm: Extent along y of the points that count as one row. The paper's grid rows are finer than a
            pixel (6 mm), so a single one seldom holds all four edges.
        row_tolerance_cm: How far from the wanted row a row is looked for when that one has no lane.
        look_ahead_cm: Distance of the point A that is steered at.
        max_edge_share: With more edge points than this share of the pixels that see the road, every distance
            occurs by chance, and a frame gives no lane. Not in the paper; 1 leaves it out.
        polarity: The two edges of a ``bright`` marking face each other, those of a ``dark`` one away;
            ``any`` takes both, but one of them in a pair. ``ignored``, as in the paper, takes edges for
            points without direction, and measures distances along the row instead of across the lines.
        parallel_rad: Edges of one marking differ in direction by at most this, and so do the two lines of a
            lane, which are not parallel along a row of a curve. Left out with ``ignored``.
        agreement_cm: Extent along y, before and behind a row, in which its two lines have to go on. Not in
            the paper.
        agreement_share: Share of that extent in which both have to be seen; at the end of a dash, and where
            the picture ends, it is about a half. 0 leaves it out, as does ``ignored``.
        clear_share: A row gives nothing if less than this share of the edge points from its left line to its
            right one, over the same extent, lies on the two lines: the floor of a lane is empty beside what
            bounds it, a texture is not. Not in the paper; 0 leaves it out.
        max_pairs: A row with more pairs of markings that satisfy all conditions is ambiguous and gives
            nothing; three lanes beside each other are three pairs. Not in the paper; null leaves it out.
        max_centre_jump: The far row is dropped if its centre is further than this share of the lane's width
            to the side of the near row's, or if the widths differ by more than their tolerance. Not in the
            paper; null leaves it out.
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
