"""Second and third stage of Suto's tracker: line segments of both sides, and of these the lane's lines.

Coordinates are those of the region of interest: x to the right, y down, the origin at its top left corner.
c1 = (width / 2, height) is the bottom end of the vertical centre line, c2 = (width / 2, 0) its top end. A
left line rises to the right and has a negative slope; a right line has a positive one.

The paper steers by whichever edge of a marking it found. Here a chosen line is moved to the middle of its
marking. Along a row of the image a marking has two edges of opposite sign. Without roll, a row is a line of
equal y on the road, and its pixels are equally wide: the middle between the edges in the image is that on the
road.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.perception.hough.edges import Contours, crowded_share

Point = tuple[float, float]

# The constants of finding the middle of a marking. Half and double of each, one at a time, change the RMSE of
# hough-value on a synthetic drive by less than 0.1 cm, except for _WEAK: 1 instead of 0.5 adds 0.24 cm.
#: How far beside the line an edge is searched, and how near an edge belongs to the line, [px]. Chosen: the
#: error of a Hough line of one degree over the region, and of an edge pixel.
_SEARCH_PX, _NEAR_PX = 3, 1.0
#: Least response of the other edge as a share of the threshold: the floors on both sides can differ.
_WEAK = 0.5
#: A gap of more rows than this ends a line. Chosen: a third of the region, more than between dashes.
_LONGEST_GAP_PX = 25
#: Fewest rows of a fit, and the share of them that must show the other edge.
_LEAST_ROWS, _LEAST_SHARE = 6, 0.5
#: Rounds of a robust fit, and of following an edge.
_ROUNDS = 3


class HoughLineSettings(Settings):
    """Which segments count as lane lines, and how one of each side is chosen (sections 4.2 and 4.3).

    The Hough transform's own parameters are not in the paper.

    Attributes:
        votes: Votes that a line needs.
        min_length_px: Shortest segment.
        max_gap_px: Longest gap within a segment.
        by_sign: Search rising and falling contours separately. Along an edge of a marking the channel only
            rises or only falls; along a line through a texture it does both. Not in the paper.
        min_support: Least share of a segment's pixels that are contour; segments through clutter are full of
            gaps. Not in the paper; 0 is the paper's.
        crowded_length_px: Least length of the contours along a segment's line, times the share of the
            region's blocks of 10 x 10 px that hold a contour: in clutter a line needs more. Not in the paper;
            0 is the paper's.
        min_angle_deg: Least angle to the x axis.
        max_angle_deg: Largest angle to the x axis.
        lowest_share: The lower end must lie below this share of the height.
        line_weight: Weight of the distance to the earlier lines, eq. 5 and 7.
        centre_weight: Weight of the distance to the bottom of the centre line, eq. 5 and 7.
        max_vanishing_share: The two lines of a pair must meet above this share of the height. Not in the
            paper; None is the paper's.
        middle: A chosen line is moved to the middle of its marking. Not in the paper.
        max_marking_px: Largest width of a marking, along x.
    """

    votes: int = Field(default=15, ge=1)
    min_length_px: float = Field(default=15.0, gt=0.0)
    max_gap_px: float = Field(default=3.0, ge=0.0)
    by_sign: bool = True
    min_support: float = Field(default=0.7, ge=0.0, le=1.0)
    crowded_length_px: float = Field(default=80.0, ge=0.0)
    min_angle_deg: float = Field(default=10.0, ge=0.0, lt=90.0)
    max_angle_deg: float = Field(default=80.0, gt=0.0, lt=90.0)
    lowest_share: float = Field(default=0.4, ge=0.0, le=1.0)
    line_weight: float = Field(default=0.7, ge=0.0)
    centre_weight: float = Field(default=0.3, ge=0.0)
    max_vanishing_share: float | None = Field(default=0.3, ge=-100.0, le=100.0)
    middle: bool = True
    max_marking_px: float = Field(default=20.0, ge=2.0)


@dataclass(frozen=True)
class Line:
    """y = m x + b."""

    m: float
    b: float


@dataclass(frozen=True)
class Segment:
    """A straight segment from p1 to p2 with y1 >= y2: p1 is the lower end in the image."""

    x1: float
    y1: float
    x2: float
    y2: float

    @staticmethod
    def between(p: Point, q: Point) -> Segment:
        """Order two points so that the lower one comes first."""
        return Segment(*p, *q) if p[1] >= q[1] else Segment(*q, *p)

    @property
    def line(self) -> Line:
        """The straight line through both ends, b = y2 - m x2 (eq. 3); its slope must be finite."""
        m = slope_of(self)
        return Line(m, self.y2 - m * self.x2)


def slope_of(segment: Segment) -> float:
    """Return m = (y2 - y1) / (x2 - x1); infinite for a vertical segment.

    Source:
        Suto 2021, eq. 2.
    """
    if segment.x2 == segment.x1:
        return math.inf
    return (segment.y2 - segment.y1) / (segment.x2 - segment.x1)


def angle_deg(m: float) -> float:
    """Return the angle to the x axis, |180 / pi * arctan(m)|, 0 to 90.

    Source:
        Suto 2021, eq. 4.
    """
    return abs(math.degrees(math.atan(m)))


def x_at(line: Line, y: float) -> float:
    """Return x = (y - b) / m.

    Source:
        Suto 2021, eq. 6.
    """
    return (y - line.b) / line.m


def vanishing_point(one: Line, other: Line) -> Point:
    """Intersect two lines of different slope: x = (b_j - b_i) / (m_i - m_j), y = m_i x + b_i.

    Source:
        Suto 2021, eq. 9.
    """
    x = (other.b - one.b) / (one.m - other.m)
    return x, one.m * x + one.b


def is_lane_like(segment: Segment, height: float, settings: HoughLineSettings) -> bool:
    """Whether a segment passes the gates: its angle, and its lower end in the lower region.

    Source:
        Suto 2021, section 4.2: 10 <= alpha <= 80 degrees, y1 >= 0.4 y_c1.
    """
    alpha = angle_deg(slope_of(segment))
    return (
        settings.min_angle_deg <= alpha <= settings.max_angle_deg
        and segment.y1 >= settings.lowest_share * height
    )


def find_lane_segments(contours: Contours, settings: HoughLineSettings) -> list[Segment]:
    """Find the segments that pass the gates, in the contours of each sign separately or in all together."""
    images = contours.by_sign if settings.by_sign else (contours.binary,)
    least_px = settings.crowded_length_px * crowded_share(contours.binary)
    return [
        segment
        for image in images
        for segment in find_segments(image, settings)
        if is_lane_like(segment, float(image.shape[0]), settings) and length_along(segment, image) >= least_px
    ]


def find_segments(binary: UInt8[np.ndarray, "r c"], settings: HoughLineSettings) -> list[Segment]:
    """Find straight segments of contours by the probabilistic Hough transform."""
    found = cv2.HoughLinesP(
        binary,
        1.0,
        math.pi / 180.0,
        settings.votes,
        minLineLength=settings.min_length_px,
        maxLineGap=settings.max_gap_px,
    )
    if found is None:
        return []
    # OpenCV 4 answers (n, 1, 4), OpenCV 5 (n, 4).
    segments = []
    for x1, y1, x2, y2 in np.asarray(found).reshape(-1, 4).tolist():
        if support((x1, y1, x2, y2), binary) >= settings.min_support:
            segments.append(Segment.between((float(x1), float(y1)), (float(x2), float(y2))))
    return segments


def support(ends: tuple[int, int, int, int], binary: UInt8[np.ndarray, "r c"]) -> float:
    """Return the share of a segment's pixels that are contour, ends included."""
    x1, y1, x2, y2 = ends
    steps = max(abs(x2 - x1), abs(y2 - y1)) + 1
    k = np.arange(steps) / max(steps - 1, 1)
    x, y = np.rint(x1 + k * (x2 - x1)).astype(np.intp), np.rint(y1 + k * (y2 - y1)).astype(np.intp)
    return float(np.count_nonzero(binary[y, x])) / steps


def length_along(segment: Segment, binary: UInt8[np.ndarray, "r c"]) -> float:
    """Return how much of a segment's whole line through the region is contour, [px]: all dashes of a line."""
    dx, dy = segment.x2 - segment.x1, segment.y2 - segment.y1
    steps = max(abs(dx), abs(dy), 1.0)
    reach = float(sum(binary.shape))
    k = np.arange(-reach, reach + 1.0) / steps
    x, y = np.rint(segment.x1 + k * dx).astype(np.intp), np.rint(segment.y1 + k * dy).astype(np.intp)
    inside = (x >= 0) & (x < binary.shape[1]) & (y >= 0) & (y < binary.shape[0])
    return float(np.count_nonzero(binary[y[inside], x[inside]])) * math.hypot(dx, dy) / steps


def split_sides(
    segments: Sequence[Segment], width: float, height: float, settings: HoughLineSettings
) -> tuple[list[Segment], list[Segment]]:
    """Sort the segments that pass the gates into the left (negative slope) and the right list.

    A segment is on the left side of the image if its lower end p1 lies left of the centre line.

    Source:
        Suto 2021, section 4.2.
    """
    kept = [s for s in segments if is_lane_like(s, height, settings)]
    left = [s for s in kept if slope_of(s) < 0.0 and s.x1 <= 0.5 * width]
    right = [s for s in kept if slope_of(s) > 0.0 and s.x1 >= 0.5 * width]
    return left, right


def line_distance(line: Line, earlier: Line | None, height: float) -> float:
    """Return dn or dp: how far a line lies from the earlier, averaged one of its side.

    The paper compares the points at the top (pa, y = 0) and at the bottom (pb, y = height) of both lines but
    does not say how the two distances become one; here they are added. Without an earlier line it is 0.

    Source:
        Suto 2021, section 4.3, below eq. 5.
    """
    if earlier is None:
        return 0.0
    return sum(abs(x_at(line, y) - x_at(earlier, y)) for y in (0.0, height))


def weighted_cost(line_px: float, centre_px: float, settings: HoughLineSettings) -> float:
    """Return what the best pair, or the best single line, minimises: 0.7 (dn + dp) + 0.3 dc.

    Args:
        line_px: Distance to the earlier lines: dn + dp of a pair, dnp of a single line.
        centre_px: Distance to c1: dc of a pair, dp1 of a single line.
        settings: Both weights.

    Source:
        Suto 2021, eq. 5 and 7.
    """
    return settings.line_weight * line_px + settings.centre_weight * centre_px


def choose_lines(
    left: Sequence[Segment],
    right: Sequence[Segment],
    earlier: tuple[Line | None, Line | None],
    width: float,
    height: float,
    settings: HoughLineSettings,
) -> tuple[Segment | None, Segment | None]:
    """Choose the lane's lines: a pair, else the single line of least cost, else none.

    Of two lines that are no pair, one of a side that earlier frames showed is preferred.

    Source:
        Suto 2021, section 4.3; lines that cannot be a pair count as single ones.
    """
    pair = choose_pair(left, right, earlier, width, height, settings)
    if pair is not None:
        return pair
    known = bool(left and earlier[0]) or bool(right and earlier[1])

    def cost(single: tuple[Segment, int]) -> float:
        segment, side = single
        centre_px = math.dist((segment.x1, segment.y1), (0.5 * width, height))
        return weighted_cost(line_distance(segment.line, earlier[side], height), centre_px, settings)

    singles = [
        (segment, side)
        for side, segments in enumerate((left, right))
        for segment in segments
        if earlier[side] is not None or not known
    ]
    chosen, side = min(singles, key=cost, default=(None, 0))
    return (chosen, None) if side == 0 else (None, chosen)


def choose_pair(
    left: Sequence[Segment],
    right: Sequence[Segment],
    earlier: tuple[Line | None, Line | None],
    width: float,
    height: float,
    settings: HoughLineSettings,
) -> tuple[Segment, Segment] | None:
    """Choose the pair of one left and one right line with the least cost; None if no pair can be a lane.

    The point c of the paper's text below eq. 5 is taken for c1: dc is the distance between c1 and the middle
    of the line that joins the lower ends of the pair.

    Source:
        Suto 2021, eq. 5.
    """

    def cost(pair: tuple[Segment, Segment]) -> float:
        negative, positive = pair
        pc = (0.5 * (negative.x1 + positive.x1), 0.5 * (negative.y1 + positive.y1))
        dc = math.dist(pc, (0.5 * width, height))
        dn = line_distance(negative.line, earlier[0], height)
        dp = line_distance(positive.line, earlier[1], height)
        return weighted_cost(dn + dp, dc, settings)

    limit = settings.max_vanishing_share
    pairs = [
        (a, b)
        for a in left
        for b in right
        if limit is None or vanishing_point(a.line, b.line)[1] <= limit * height
    ]
    return min(pairs, key=cost, default=None)


def centre_on_marking(
    segment: Segment, contours: Contours, threshold: float, settings: HoughLineSettings
) -> Segment:
    """Move a segment from an edge of a marking to its middle, as far as the marking is straight.

    The edge is followed beyond the segment's ends, across the gaps of a dashed line, while it stays within a
    pixel of a straight line. Without a second edge the segment stays on the first one.

    Args:
        segment: A segment of the region of interest.
        contours: Of the same region.
        threshold: T of eq. 1.
        settings: The widest marking.

    Returns:
        The middle line between its lowest and its highest row that were seen. The segment itself, if its edge
        cannot be followed.

    Source:
        Own derivation; tested in centimetres on rendered markings.
    """
    response = contours.response.astype(np.float64)
    response *= _sign_along(segment, contours)
    edge = _follow(segment, response, threshold)
    if edge is None:
        return segment
    rows, x = edge
    offsets = [
        0.5 * side * _width_px(rows, x, response, side, _WEAK * threshold, settings.max_marking_px)
        for side in (-1, 1)
    ]
    # The other edge is on the side where more rows show one.
    offset = max(offsets, key=lambda o: int(np.isfinite(o).sum()))
    seen = np.isfinite(offset)
    if seen.mean() >= _LEAST_SHARE:
        rows, x = rows[seen], (x + offset)[seen]
    fit = _fit(rows, x)
    if fit is None:
        return segment
    (p, q), kept = fit
    low, high = float(rows[kept].max()), float(rows[kept].min())
    moved = Segment(p * low + q, low, p * high + q, high)
    same_side = np.isfinite(slope_of(moved)) and slope_of(moved) * slope_of(segment) > 0.0
    return moved if same_side else segment


def _sign_along(segment: Segment, contours: Contours) -> float:
    """1 if the channel rises to the right along most of a segment, else -1."""
    n = int(max(abs(segment.x2 - segment.x1), segment.y1 - segment.y2)) + 1
    x = np.rint(np.linspace(segment.x1, segment.x2, n)).astype(np.intp)
    y = np.rint(np.linspace(segment.y1, segment.y2, n)).astype(np.intp)
    return 1.0 if np.sign(contours.response[y, x]).sum() >= 0 else -1.0


def _follow(
    segment: Segment, response: Float[np.ndarray, "r c"], threshold: float
) -> tuple[Int[np.ndarray, "rows"], Float[np.ndarray, "rows"]] | None:
    """Find rows and x of the edge, [px], to a fraction of a pixel, along a segment and beyond its ends."""
    p = (segment.x1 - segment.x2) / max(segment.y1 - segment.y2, 1.0)
    q = segment.x2 - p * segment.y2
    low, high = segment.y1, segment.y2
    found: tuple[Int[np.ndarray, "rows"], Float[np.ndarray, "rows"]] | None = None
    for _ in range(_ROUNDS):
        rows = np.arange(max(int(high), 0), min(int(low), response.shape[0] - 1) + 1)
        x = _peak(response, rows, p * rows + q, threshold)
        rows, x = rows[np.isfinite(x)], x[np.isfinite(x)]
        fit = _fit(rows, x)
        if fit is None:
            return found
        (p, q), kept = fit
        kept &= _joined(rows, kept, 0.5 * (segment.y1 + segment.y2))
        found = rows[kept], x[kept]
        length = float(found[0][-1] - found[0][0])
        # A line that was followed over some length is known well enough to be followed as far again.
        low, high = found[0][-1] + length, found[0][0] - length
    return found


def _joined(
    rows: Int[np.ndarray, "rows"], kept: Bool[np.ndarray, "rows"], start: float
) -> Bool[np.ndarray, "rows"]:
    """True for the rows connected to the kept one nearest to a start, without a long gap of kept ones."""
    seen = rows[kept]
    group = np.concatenate([[0], np.cumsum(np.diff(seen) > _LONGEST_GAP_PX)])
    own = seen[group == group[np.abs(seen - start).argmin()]]
    return (rows >= own[0]) & (rows <= own[-1])


def _peak(
    response: Float[np.ndarray, "r c"],
    rows: Int[np.ndarray, "rows"],
    x: Float[np.ndarray, "rows"],
    threshold: float,
) -> Float[np.ndarray, "rows"]:
    """Find the strongest response near x on each row; NaN where it is weak or no peak."""
    columns = np.rint(x).astype(np.intp)[:, None] + np.arange(-_SEARCH_PX, _SEARCH_PX + 1)
    inside = (columns >= 1) & (columns < response.shape[1] - 1)
    columns = np.clip(columns, 1, response.shape[1] - 2)
    values = np.where(inside, response[rows[:, None], columns], -np.inf)
    best = columns[np.arange(len(rows)), values.argmax(axis=1)]
    result = best + _fraction(response, rows, best)
    result[values.max(axis=1) < threshold] = np.nan
    return result


def _fraction(
    response: Float[np.ndarray, "r c"], rows: Int[np.ndarray, "rows"], columns: Int[np.ndarray, "rows"]
) -> Float[np.ndarray, "rows"]:
    """Place of the peak between pixels: the parabola through three responses; NaN where there is no peak."""
    before, at, after = (response[rows, columns + k] for k in (-1, 0, 1))
    curvature = before - 2.0 * at + after
    peak = (curvature < 0.0) & (at >= before) & (at >= after)
    return np.where(peak, 0.5 * (before - after) / np.where(peak, curvature, 1.0), np.nan)


def _width_px(
    rows: Int[np.ndarray, "rows"],
    x: Float[np.ndarray, "rows"],
    response: Float[np.ndarray, "r c"],
    side: int,
    threshold: float,
    widest_px: float,
) -> Float[np.ndarray, "rows"]:
    """Distance to the nearest edge of opposite sign on one side, [px]; NaN where there is none."""
    opposite = -response
    columns = np.rint(x).astype(np.intp)[:, None] + side * np.arange(1, int(widest_px) + 1)
    inside = (columns >= 1) & (columns < response.shape[1] - 1)
    columns = np.clip(columns, 1, response.shape[1] - 2)
    at = opposite[rows[:, None], columns]
    before, after = (opposite[rows[:, None], columns + k] for k in (-1, 1))
    peaks: Bool[np.ndarray, "rows columns"] = (
        inside & (at >= threshold) & (at >= before) & (at >= after) & (2.0 * at > before + after)
    )
    first = columns[np.arange(len(rows)), peaks.argmax(axis=1)]
    width = side * (first + _fraction(opposite, rows, first) - x)
    width[~peaks.any(axis=1)] = np.nan
    return width


def _fit(
    rows: Int[np.ndarray, "rows"], x: Float[np.ndarray, "rows"]
) -> tuple[tuple[float, float], Bool[np.ndarray, "rows"]] | None:
    """Fit x = p row + q to what lies near a straight line; also what was kept. None for too few rows."""
    kept = np.ones(len(rows), bool)
    p = q = 0.0
    for _ in range(_ROUNDS):
        n = np.count_nonzero(kept)
        if n < _LEAST_ROWS:
            return None
        y_kept, x_kept = rows[kept], x[kept]
        mean_row, mean_x = float(y_kept.sum()) / n, float(x_kept.sum()) / n
        centred = y_kept - mean_row
        p = float(centred @ x_kept) / float(centred @ centred)
        q = mean_x - p * mean_row
        residual = np.abs(x - p * rows - q)
        # Outliers still bias the first fits, hence the limit by the median; sorting is faster on few values.
        kept = residual <= max(_NEAR_PX, 2.0 * float(np.sort(residual)[len(residual) // 2]))
    return ((p, q), kept) if np.count_nonzero(kept) >= _LEAST_ROWS else None
