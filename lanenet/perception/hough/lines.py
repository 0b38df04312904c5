"""Second and third stage of Suto's tracker: line segments of both sides, and of these the lane's lines.

Coordinates are those of the region of interest: x to the right, y down, the origin at its top left corner.
c1 = (width / 2, height) is the bottom end of the vertical centre line, c2 = (width / 2, 0) its top end. A
left line rises to the right and has a negative slope; a right line has a positive one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.perception.hough.edges import Contours, crowded_share

Point = tuple[float, float]


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
        """The straight line through both ends; its slope must be finite."""
        m = slope_of(self)
        return Line(m, intercept_of(self, m))


def slope_of(segment: Segment) -> float:
    """Return m = (y2 - y1) / (x2 - x1); infinite for a vertical segment.

    Source:
        Suto 2021, eq. 2.
    """
    if segment.x2 == segment.x1:
        return math.inf
    return (segment.y2 - segment.y1) / (segment.x2 - segment.x1)


def intercept_of(segment: Segment, m: float) -> float:
    """Return b = y2 - m x2.

    Source:
        Suto 2021, eq. 3.
    """
    return segment.y2 - m * segment.x2


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


def pair_cost(dn: float, dp: float, dc: float, settings: HoughLineSettings) -> float:
    """Return 0.7 (dn + dp) + 0.3 dc, which the best pair minimises.

    Source:
        Suto 2021, eq. 5.
    """
    return settings.line_weight * (dn + dp) + settings.centre_weight * dc


def single_cost(dnp: float, dp1: float, settings: HoughLineSettings) -> float:
    """Return 0.7 dnp + 0.3 dp1, which the best line minimises where only one side has any.

    Source:
        Suto 2021, eq. 7.
    """
    return settings.line_weight * dnp + settings.centre_weight * dp1


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
    costs = [
        (cost_of_single(segment, line, width, height, settings), side, segment)
        for side, (segments, line) in enumerate(zip((left, right), earlier, strict=True))
        for segment in segments
        if line is not None or not known
    ]
    if not costs:
        return None, None
    _, side, chosen = min(costs, key=lambda entry: entry[:2])
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
        return pair_cost(dn, dp, dc, settings)

    limit = settings.max_vanishing_share
    pairs = [
        (a, b)
        for a in left
        for b in right
        if limit is None or vanishing_point(a.line, b.line)[1] <= limit * height
    ]
    return min(pairs, key=cost, default=None)


def cost_of_single(
    segment: Segment, earlier: Line | None, width: float, height: float, settings: HoughLineSettings
) -> float:
    """Return the cost of a line where no pair is; dp1 is the distance between c1 and its lower end.

    Source:
        Suto 2021, eq. 7.
    """
    dp1 = math.dist((segment.x1, segment.y1), (0.5 * width, height))
    return single_cost(line_distance(segment.line, earlier, height), dp1, settings)
