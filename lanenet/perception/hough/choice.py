"""Third stage of Suto's tracker: of the left and the right lines of a frame, those of the lane.

Coordinates as in :mod:`lanenet.perception.hough.lines`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from lanenet.perception.hough.lines import HoughLineSettings, Line, Segment, vanishing_point, x_at

Earlier = tuple[Line | None, Line | None]
Chosen = tuple[Segment | None, Segment | None]


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
    earlier: Earlier,
    width: float,
    height: float,
    settings: HoughLineSettings,
) -> Chosen:
    """Choose the lane's lines: a pair, else the single line of least cost, else none.

    Of two lines that are no pair, one of a side that earlier frames showed comes first.

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
    earlier: Earlier,
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
