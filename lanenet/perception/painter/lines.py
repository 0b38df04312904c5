"""Pentek's lane lines: segments of the probabilistic Hough transform joined to one solid line per side."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field

from lanenet.config import Settings


class PainterLineSettings(Settings):
    """How segments become two lines; lengths are shares of the region's height, so that any size will do.

    The Hough transform's own parameters are not in the paper.

    Attributes:
        votes_share: Votes that a line needs, as a share of the region's height in pixels.
        min_length_share: Shortest segment.
        max_gap_share: Longest gap within a segment.
        min_slope: Least rise over run of a lane line.
        agree_share: Segments whose lines lie so near to each other at the region's top and bottom, as a share
            of its bottom width, belong to one line.
        min_support_share: Length of all segments of a line that is needed.
        min_width_share: Least distance of the lines at the bottom, as a share of the bottom width.
    """

    votes_share: float = Field(default=0.08, gt=0.0)
    min_length_share: float = Field(default=0.1, gt=0.0)
    max_gap_share: float = Field(default=0.1, ge=0.0)
    min_slope: float = Field(default=0.35, gt=0.0)
    agree_share: float = Field(default=0.06, gt=0.0)
    min_support_share: float = Field(default=0.2, ge=0.0)
    min_width_share: float = Field(default=0.25, ge=0.0)


@dataclass(frozen=True)
class SolidLine:
    """One side's line between the bottom and the top of the region.

    Attributes:
        bottom_px: x at the region's bottom row, [px].
        top_px: x at its top row.
    """

    bottom_px: float
    top_px: float


def find_painter_segments(
    edges: UInt8[np.ndarray, "h w"], region_height_px: float, settings: PainterLineSettings
) -> Float[np.ndarray, "n 4"]:
    """Return the segments x1, y1, x2, y2 of an edge image, [px]; empty when there is none."""
    found = cv2.HoughLinesP(
        edges,
        1.0,
        np.pi / 180.0,
        max(8, round(settings.votes_share * region_height_px)),
        minLineLength=settings.min_length_share * region_height_px,
        maxLineGap=settings.max_gap_share * region_height_px,
    )
    # OpenCV 4 answers (n, 1, 4), OpenCV 5 (n, 4).
    return np.empty((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)


def join_side(
    segments_px: Float[np.ndarray, "n 4"],
    rows_px: tuple[float, float],
    bottom_width_px: float,
    earlier: SolidLine | None,
    settings: PainterLineSettings,
    count: int = 1,
) -> list[SolidLine]:
    """Join the segments of one side to solid lines (the paper's ``getLeftRoadLine``), the best one first.

    Each segment's line y = m x + b gives x at the region's bottom and top. The segment that most length
    agrees with counts, and the line is the mean of those that agree with it, weighted by length: a mean over
    all of them would lie between a marking and the kerb beside it. Further lines are joined in the same way
    from the segments that are left.

    Args:
        segments_px: Segments of this side; none is level.
        rows_px: Bottom and top row of the region.
        bottom_width_px: Width of the region's bottom.
        earlier: The side's line of the frame before; agreement with it counts as much as the longest
            agreement of this frame.
        settings: Tolerances.
        count: Lines that are wanted at most.

    Returns:
        The lines; none if the segments that agree are too short together.

    Source:
        Pentek, section 3: "slope-intercept equation from two points". The agreement is not in the paper.
    """
    lines: list[SolidLine] = []
    x1, y1, x2, y2 = segments_px.T
    inverse = (x2 - x1) / (y2 - y1)
    ends = np.stack([x1 + inverse * (row - y1) for row in rows_px], axis=1)
    length = np.abs(y2 - y1)
    tolerance = settings.agree_share * bottom_width_px
    near = _agree(ends[:, None, :], ends[None, :, :], tolerance)
    while len(lines) < count and len(length):
        score = near @ length
        if earlier is not None:
            known = np.array([earlier.bottom_px, earlier.top_px])
            score = score + score.max() * _agree(ends, known, tolerance)
        chosen = near[int(np.argmax(score))]
        total = float(length[chosen].sum())
        # Too short where the line before was, perhaps, but not elsewhere: go on with the others.
        if total >= settings.min_support_share * (rows_px[0] - rows_px[1]):
            bottom, top = (length[chosen] / total) @ ends[chosen]
            lines.append(SolidLine(float(bottom), float(top)))
        ends, length, near = ends[~chosen], length[~chosen], near[~chosen][:, ~chosen]
    return lines


def _agree(
    ends: Float[np.ndarray, "*n 2"], other: Float[np.ndarray, "*m 2"], tolerance_px: float
) -> Bool[np.ndarray, "*k"]:
    return np.asarray((np.abs(ends - other) <= tolerance_px).all(axis=-1))


def find_side_lines(
    segments_px: Float[np.ndarray, "n 4"],
    trapezoid_px: Float[np.ndarray, "4 2"],
    earlier: tuple[SolidLine | None, SolidLine | None],
    settings: PainterLineSettings,
    count: int = 1,
) -> tuple[list[SolidLine], list[SolidLine]]:
    """Find solid lines of the left and of the right side, the best ones first.

    A segment belongs to the left side if it rises to the right and its lower end lies in the left half of
    the region, to the right side if it is the other way round.

    Args:
        segments_px: All segments.
        trapezoid_px: The region, clockwise from the top left.
        earlier: Lines of the frame before.
        settings: Tolerances.
        count: Lines per side that are wanted at most.
    """
    top, bottom = float(trapezoid_px[0, 1]), float(trapezoid_px[2, 1])
    left_end, right_end = float(trapezoid_px[3, 0]), float(trapezoid_px[2, 0])
    middle = 0.5 * (left_end + right_end)
    x1, y1, x2, y2 = segments_px.T
    dx, dy = x2 - x1, y2 - y1
    steep = np.abs(dy) >= np.maximum(settings.min_slope * np.abs(dx), 1e-6)
    lower_x = np.where(y1 >= y2, x1, x2)
    left, right = (
        join_side(
            segments_px[steep & rising & half],
            (bottom, top),
            right_end - left_end,
            known,
            settings,
            count,
        )
        for rising, half, known in (
            (dx * dy < 0.0, lower_x <= middle, earlier[0]),
            (dx * dy > 0.0, lower_x >= middle, earlier[1]),
        )
    )
    return left, right


def find_two_lines(
    segments_px: Float[np.ndarray, "n 4"],
    trapezoid_px: Float[np.ndarray, "4 2"],
    earlier: tuple[SolidLine | None, SolidLine | None],
    settings: PainterLineSettings,
) -> tuple[SolidLine | None, SolidLine | None]:
    """Find the solid left and right line of a frame by the segments alone, as the paper does.

    Two lines that cross within the region, or nearly meet at its bottom, are no lane; then the one that
    agrees with the frame before stays, or none.

    Args:
        segments_px: All segments.
        trapezoid_px: The region, clockwise from the top left.
        earlier: Lines of the frame before.
        settings: Tolerances.
    """
    sides = find_side_lines(segments_px, trapezoid_px, earlier, settings)
    left, right = (side[0] if side else None for side in sides)
    if left is None or right is None or are_apart(left, right, trapezoid_px, settings):
        return left, right
    tolerance = agree_px(trapezoid_px, settings)
    stays = [
        line if known is not None and are_close(line, known, tolerance) else None
        for line, known in zip((left, right), earlier, strict=True)
    ]
    return (stays[0], stays[1]) if stays.count(None) == 1 else (None, None)


def are_apart(
    left: SolidLine, right: SolidLine, trapezoid_px: Float[np.ndarray, "4 2"], settings: PainterLineSettings
) -> bool:
    """Return whether two lines leave room for a lane: they neither cross nor nearly meet in the region."""
    width = float(trapezoid_px[2, 0] - trapezoid_px[3, 0])
    apart = right.bottom_px - left.bottom_px >= settings.min_width_share * width
    return apart and right.top_px > left.top_px


def agree_px(trapezoid_px: Float[np.ndarray, "4 2"], settings: PainterLineSettings) -> float:
    """Return how near lines lie that are one, [px]."""
    return settings.agree_share * float(trapezoid_px[2, 0] - trapezoid_px[3, 0])


def are_close(one: SolidLine, other: SolidLine, tolerance_px: float) -> bool:
    """Return whether two lines lie near to each other at the region's top and bottom."""
    return (
        abs(one.bottom_px - other.bottom_px) <= tolerance_px
        and abs(one.top_px - other.top_px) <= tolerance_px
    )


def blend(current: SolidLine, earlier: SolidLine | None, weight: float) -> SolidLine:
    """Average a line with that of the frames before, for video; the current one where there is none."""
    if earlier is None:
        return current
    return SolidLine(
        weight * current.bottom_px + (1.0 - weight) * earlier.bottom_px,
        weight * current.top_px + (1.0 - weight) * earlier.top_px,
    )
