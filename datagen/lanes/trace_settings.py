"""How lane lines are looked for."""

from __future__ import annotations

from pydantic import Field

from lanenet.config import Settings


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
            more than a second line brings, so that a lane beside it with two solid lines does not take over;
            not much more, or the lane changes sides with a car that does.
        min_support: Density of edges from which a marking counts as seen, 0..1.
        width_share: How much the lane's width may vary along the road.
        neighbours: Lines to look for on each side beyond those of the driven lane.
        neighbour_lanes: Length of paint that makes a neighbouring line, in lane widths.
        neighbour_share: Share of the path along which a neighbouring line must be seen,
        visit_share: or of the way that the car drives in the lane before it,
        visit_lanes: where that is so long at least, in lane widths.
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
