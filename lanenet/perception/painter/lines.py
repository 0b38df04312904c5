"""Pentek's lane lines: from edges to segments, from segments to solid lines, and the evidence for each line.

The edges are those of Canny on the V channel, inside the trapezoid that may hold a lane.

The best of all lines through a carpet, leaves or noise has edges along it too. A marking differs in four
respects: the edges along it run in its direction, few parallel lines beside it have as many, it continues
over a long section, and on the road its partner runs beside it. The evidence is not in the paper, and it can
be switched off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera
from lanenet.perception.image_lane import Polyline

#: Shares of width and height, clockwise from the top left corner as in the paper: a road seen by a level
#: camera, with its horizon a little above the middle.
_ROAD_TRAPEZOID = ((0.42, 0.62), (0.58, 0.62), (0.96, 0.94), (0.04, 0.94))
#: With a camera the region reaches this many camera heights ahead. Chosen: 120 cm from a height of 20 cm, as
#: far as ``RangeSettings``.
_FAR_HEIGHTS = 6.0


class PainterEdgeSettings(Settings):
    """How the painter's edges are found (sections 3 and 4 of the paper).

    Attributes:
        contrast: Factor alpha of ``convertScaleAbs``; the paper raises it "a little bit". More
            than that saturates bright concrete, and the markings on it are lost.
        blur_px: Size of the Gauss kernel, the first step of Canny as the paper describes it.
        low: Lower threshold of Canny.
        high: Upper threshold.
        trapezoid: Four corners as shares of width and height, clockwise from the top left; None takes them
            from the camera's horizon, or without a camera from the proportions of a road image.
        max_edge_share: With more edges than this share of the region there is nothing to be recognised.
    """

    contrast: float = Field(default=1.1, gt=0.0)
    blur_px: int = Field(default=5, ge=1, le=31)
    low: float = Field(default=70.0, gt=0.0)
    high: float = Field(default=100.0, gt=0.0)
    trapezoid: tuple[tuple[float, float], ...] | None = None
    max_edge_share: float = Field(default=0.15, gt=0.0, le=1.0)

    @model_validator(mode="after")
    def _is_sound(self) -> PainterEdgeSettings:
        if self.blur_px % 2 == 0:
            raise ConfigError(f"painter edges: blur_px {self.blur_px}, expected an odd number")
        if self.high < self.low:
            raise ConfigError(f"painter edges: high {self.high:g} is below low {self.low:g}")
        if self.trapezoid is not None:
            corners = self.trapezoid
            sound = len(corners) == 4 and all(len(c) == 2 for c in corners)
            if not sound or not _is_trapezoid(corners):
                raise ConfigError(
                    f"painter edges: trapezoid {corners}, expected four corners (u, v) from 0 to 1, "
                    "clockwise from the top left, its top and bottom level"
                )
        return self


def _is_trapezoid(corners: tuple[tuple[float, float], ...]) -> bool:
    top_left, top_right, bottom_right, bottom_left = corners
    return (
        all(0.0 <= v <= 1.0 for corner in corners for v in corner)
        and top_left[1] == top_right[1] < bottom_right[1] == bottom_left[1]
        and top_left[0] < top_right[0]
        and bottom_left[0] < bottom_right[0]
    )


def find_trapezoid(
    width: int, height: int, camera: Camera | None, settings: PainterEdgeSettings
) -> Float[np.ndarray, "4 2"]:
    """Return the corners of the region of interest, clockwise from the top left, [px], frame image.

    With a camera the top lies where the road is six camera heights ahead, and the sides run from there to the
    bottom corners, wide enough at the top for a lane that turns. Without one the proportions of a road
    image are taken.
    """
    scale = np.array([width - 1.0, height - 1.0])
    if settings.trapezoid is not None:
        return np.array(settings.trapezoid) * scale
    if camera is None:
        return np.array(_ROAD_TRAPEZOID) * scale
    far_cm = _FAR_HEIGHTS * camera.mounting.height_cm
    v = float(camera.project_ground(np.array([[0.0, far_cm]]))[0, 1])
    top = min(max(v, 0.0), 0.9 * scale[1]) if np.isfinite(v) else _ROAD_TRAPEZOID[0][1] * scale[1]
    return np.array([[0.15 * scale[0], top], [0.85 * scale[0], top], scale, [0.0, scale[1]]])


def value_channel(
    frame_bgr: UInt8[np.ndarray, "h w 3"], settings: PainterEdgeSettings
) -> UInt8[np.ndarray, "h w"]:
    """Raise the contrast and return V of HSV.

    Source:
        Pentek, section 3, image preprocessing.
    """
    # V of HSV is the largest of the three channels, and stays that when all are raised alike.
    largest = np.maximum(np.maximum(frame_bgr[..., 0], frame_bgr[..., 1]), frame_bgr[..., 2])
    return np.asarray(cv2.convertScaleAbs(largest, alpha=settings.contrast, beta=0.0))


def find_painter_edges(
    frame_bgr: UInt8[np.ndarray, "h w 3"],
    trapezoid_px: Float[np.ndarray, "4 2"],
    settings: PainterEdgeSettings,
) -> UInt8[np.ndarray, "h w"]:
    """Return the Canny edges within the trapezoid, 0 and 255; none where edges are everywhere.

    Source:
        Pentek, sections 3 and 4: thresholds 70 and 100, Gauss first; ``get_roi`` after Canny, so that the
        region's own border is no edge.
    """
    value = value_channel(frame_bgr, settings)
    blurred = cv2.GaussianBlur(value, (settings.blur_px, settings.blur_px), 0)
    edges = cv2.Canny(blurred, settings.low, settings.high)
    region = np.zeros(edges.shape, np.uint8)
    cv2.fillConvexPoly(region, np.rint(trapezoid_px).astype(np.int32), 255)
    inside = cv2.bitwise_and(edges, region)
    share = int(np.count_nonzero(inside)) / max(1, int(np.count_nonzero(region)))
    return np.zeros_like(edges) if share > settings.max_edge_share else np.asarray(inside)


#: Places of the strips, in half widths beside the line: its own, and those in which clutter is counted.
#: Chosen: beyond the other border of the marking, on both sides.
_STRIPS = np.array([0.0, -8.0, -6.0, -4.0, 4.0, 6.0, 8.0])
#: Keeps the contrast of a line without clutter finite; chosen: one supported row in fifty.
_LEAST_CLUTTER = 0.02


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

    def between(self, old: Float[np.ndarray, "4 2"], new: Float[np.ndarray, "4 2"]) -> SolidLine:
        """Return the same line of the old region between the rows of the new one."""
        slope = (self.bottom_px - self.top_px) / (old[2, 1] - old[0, 1])
        ends = (self.top_px + slope * (row - old[0, 1]) for row in (new[2, 1], new[0, 1]))
        return SolidLine(*map(float, ends))


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

    Each segment's line y = m x + b has an x at the region's bottom and top. The segment with the most
    agreeing length is chosen, and the line is the length-weighted mean of those that agree with it; a mean
    over all would lie between a marking and the kerb beside it. Further lines come from the other segments.

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
        # A line that is too short is left out; the others may still be long enough.
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
    the region, to the right side if it falls and ends in the
    right half.

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
        line if are_close(line, known, tolerance) else None
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


def are_close(one: SolidLine, other: SolidLine | None, tolerance_px: float) -> bool:
    """Return whether the other line is known and lies near this one, at the region's top and bottom."""
    return (
        other is not None
        and abs(one.bottom_px - other.bottom_px) <= tolerance_px
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


class EvidenceSettings(Settings):
    """What a line has to show; the defaults were chosen on frames of texture, roads and three tubs.

    Two parallel lines are answered if both reach the ``min`` figures, each is strong or long or has a strong
    partner, and together they reach the score or have no clutter beside them. A line is answered alone if it
    is strong over most of its rows.

    Attributes:
        required: False answers every line that segments can be joined to, as the paper does.
        candidates: Lines per side that are looked at; the most convincing pair is taken.
        half_width_top: Half the width of the strip that belongs to a line at the region's top, as a share of
            the width of the region's bottom.
        half_width_bottom: The same at its bottom.
        max_angle_rad: Greatest angle between an edge and the line that it supports.
        min_aligned: Least share of the edges in the strip that run along it.
        min_support: Least share of the visible rows in which such an edge is found.
        min_contrast: The support over that of the parallel strips beside it is at least this.
        min_extent: Least distance between the first and the last supported row, as a share of the rows.
        min_pair_score: Least sum of support times aligned over both lines.
        clear_contrast: Two lines with this contrast are answered whatever their score: dashes on a bare road.
        strong_aligned: As ``min_aligned``, for a strong line.
        strong_support: As ``min_support``.
        strong_contrast: As ``min_contrast``.
        strong_extent: As ``min_extent``.
        alone_support: As ``min_support``, for a line without a partner.
        known_share: Share of the first three ``min`` figures that is enough for a line of the frame before.
        curve_share: A curve is taken instead of its straight line from this share of the latter's score on.
        inner_share: A narrower lane is taken instead of a wider one from this share of the latter's score on.
        max_width_ratio: The lane's width at its far end may differ by this factor from that at its near end.
        max_width_heights: With a camera: the widest lane, in camera heights. A line that comes no
            nearer than that to the car does not bound the lane that the car is in.
    """

    required: bool = True
    candidates: int = Field(default=3, ge=1, le=10)
    half_width_top: float = Field(default=0.015, gt=0.0)
    half_width_bottom: float = Field(default=0.04, gt=0.0)
    max_angle_rad: float = Field(default=0.25, gt=0.0, lt=0.5 * math.pi)
    min_aligned: float = Field(default=0.35, ge=0.0, le=1.0)
    min_support: float = Field(default=0.15, ge=0.0, le=1.0)
    min_contrast: float = Field(default=2.5, ge=0.0)
    min_extent: float = Field(default=0.5, ge=0.0, le=1.0)
    min_pair_score: float = Field(default=0.42, ge=0.0, le=2.0)
    clear_contrast: float = Field(default=11.0, ge=0.0)
    strong_aligned: float = Field(default=0.7, ge=0.0, le=1.0)
    strong_support: float = Field(default=0.45, ge=0.0, le=1.0)
    strong_contrast: float = Field(default=8.0, ge=0.0)
    strong_extent: float = Field(default=0.3, ge=0.0, le=1.0)
    alone_support: float = Field(default=0.58, ge=0.0, le=1.0)
    known_share: float = Field(default=0.7, ge=0.0, le=1.0)
    curve_share: float = Field(default=0.8, ge=0.0)
    inner_share: float = Field(default=0.75, gt=0.0, le=1.0)
    max_width_ratio: float = Field(default=2.5, gt=1.0)
    max_width_heights: float = Field(default=6.0, gt=0.0)


@dataclass(frozen=True)
class EdgeField:
    """The edge pixels of the region with their directions.

    Attributes:
        points_px: Pixels (u, v), row by row from the top, frame image.
        across: Unit gradient of V at each.
        trapezoid_px: The region, clockwise from the top left.
        width_px: Width of the frame.
    """

    points_px: Float[np.ndarray, "n 2"]
    across: Float[np.ndarray, "n 2"]
    trapezoid_px: Float[np.ndarray, "4 2"]
    width_px: int


@dataclass(frozen=True)
class LineEvidence:
    """Evidence for one line, from the edges.

    Attributes:
        support: Share of the visible rows with an edge along the line.
        clutter: Mean of that share over parallel strips beside it.
        aligned: Share of the edges in the line's strip that run along it.
        extent: Distance between the first and the last supported row, as a share of the visible rows.
        far_px: The first supported row of the image; NaN without one.
    """

    support: float = 0.0
    clutter: float = 0.0
    aligned: float = 0.0
    extent: float = 0.0
    far_px: float = float("nan")

    @property
    def contrast(self) -> float:
        """The support over the clutter beside the line."""
        return self.support / (self.clutter + _LEAST_CLUTTER)

    @property
    def score(self) -> float:
        """By which lines are compared."""
        return self.support * self.aligned

    def is_likely(self, settings: EvidenceSettings, known: bool = False) -> bool:
        """Whether the line may bound a lane together with another one."""
        share = settings.known_share if known else 1.0
        return (
            self.aligned >= share * settings.min_aligned
            and self.support >= share * settings.min_support
            and self.contrast >= share * settings.min_contrast
        )

    def is_strong(self, settings: EvidenceSettings) -> bool:
        """Whether the line is a marking, whatever its partner is."""
        return (
            self.aligned >= settings.strong_aligned
            and self.support >= settings.strong_support
            and self.contrast >= settings.strong_contrast
            and self.extent >= settings.strong_extent
        )


def find_edge_field(
    frame_bgr: UInt8[np.ndarray, "h w 3"],
    edges: UInt8[np.ndarray, "h w"],
    trapezoid_px: Float[np.ndarray, "4 2"],
    settings: PainterEdgeSettings,
) -> EdgeField:
    """Find the direction of each edge pixel from the gradient that Canny saw."""
    height, width = edges.shape
    found = cv2.findNonZero(edges)
    if found is None or len(found) == 0:
        return EdgeField(np.empty((0, 2)), np.empty((0, 2)), trapezoid_px, width)
    points = found.reshape(-1, 2)
    u, v = points.T
    # Only the rows that hold edges, with a margin for the kernels.
    first, last = max(0, int(v.min()) - settings.blur_px), min(height, int(v.max()) + settings.blur_px + 1)
    value = value_channel(np.ascontiguousarray(frame_bgr[first:last]), settings)
    blurred = cv2.GaussianBlur(value, (settings.blur_px, settings.blur_px), 0)
    gradient = np.stack(
        [cv2.Sobel(blurred, cv2.CV_16S, *order)[v - first, u] for order in ((1, 0), (0, 1))], axis=1
    ).astype(np.float64)
    length = np.maximum(np.hypot(gradient[:, 0], gradient[:, 1]), 1e-9)
    return EdgeField(points.astype(np.float64), gradient / length[:, None], trapezoid_px, width)


def measure_evidence(line_px: Polyline, field: EdgeField, settings: EvidenceSettings) -> LineEvidence:
    """Count the edges along a line and beside it.

    Args:
        line_px: The line, [px], frame image.
        field: Edge pixels of the region.
        settings: Widths and angle.

    Returns:
        The figures; all zero where the line is not visible or there are no edges.

    Source:
        Own derivation; tested with drawn lines and with frames of texture.
    """
    v_line, index = np.unique(line_px[:, 1], return_index=True)
    top, bottom = float(field.trapezoid_px[0, 1]), float(field.trapezoid_px[2, 1])
    if len(v_line) < 2 or len(field.points_px) == 0:
        return LineEvidence()
    u_line = line_px[index, 0]
    rows = np.arange(math.ceil(max(top, v_line[0])), math.floor(min(bottom, v_line[-1])) + 1)
    u_rows = np.interp(rows, v_line, u_line)
    visible = rows[(u_rows >= 0.0) & (u_rows <= field.width_px - 1.0)]
    if len(visible) < 2:
        return LineEvidence()
    first, last = np.searchsorted(field.points_px[:, 1], (rows[0], rows[-1] + 1))
    (u, v), across = field.points_px[first:last].T, field.across[first:last]
    # Computed once per row, since several edge pixels share a row.
    row = (v - rows[0]).astype(np.intp)
    share = (rows - top) / max(bottom - top, 1.0)
    half_width = (
        settings.half_width_top + (settings.half_width_bottom - settings.half_width_top) * share
    ) * (field.trapezoid_px[2, 0] - field.trapezoid_px[3, 0])
    # At least one pixel beside the line on small frames.
    half_width = np.maximum(half_width, 1.0)
    slope = np.interp(rows, v_line, _slope(u_line, v_line))
    least = math.cos(settings.max_angle_rad) * np.hypot(1.0, slope)
    along = np.abs(across[:, 0] - slope[row] * across[:, 1]) >= least[row]
    beside = (u - u_rows[row]) / half_width[row]

    near = np.abs(beside) <= 1.0
    supported = v[near & along]
    if len(supported) == 0:
        return LineEvidence()
    # Rows with an edge, for the line's own strip and for each one beside it.
    strip, k = np.nonzero(np.abs(beside[along] - _STRIPS[:, None]) <= 1.0)
    filled = np.zeros((len(_STRIPS), len(rows)), bool)
    filled[strip, row[along][k]] = True
    shares = filled.sum(axis=1) / len(visible)
    return LineEvidence(
        support=min(float(shares[0]), 1.0),
        clutter=float(shares[1:].mean()),
        aligned=len(supported) / int(np.count_nonzero(near)),
        extent=min(float(np.ptp(supported)) / (len(visible) - 1), 1.0),
        far_px=float(supported.min()),
    )


def _slope(u: Float[np.ndarray, "n"], v: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """du/dv at each point: ``np.gradient`` in a third of its time."""
    step = v[1:] - v[:-1]
    secant = (u[1:] - u[:-1]) / step
    inner = (step[1:] * secant[:-1] + step[:-1] * secant[1:]) / (step[1:] + step[:-1])
    return np.concatenate([secant[:1], inner, secant[-1:]])
