"""From an edge of a marking to its middle. Not in the paper, which steers by whichever edge it found.

Along a row of the image a marking has two edges of opposite sign. Without roll, a row is a line of equal y on
the road, and its pixels are equally wide: the middle between the edges in the image is that on the road.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.perception.hough.edges import Contours
from lanenet.perception.hough.lines import HoughLineSettings, Segment, slope_of

# Half and double of each of these, one at a time, change the RMSE of hough-value on a synthetic drive by less
# than 0.1 cm, except for _WEAK: 1 instead of 0.5 adds 0.24 cm.
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
