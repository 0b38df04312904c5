"""Lines that a network found, fitted to the edge points of their markings.

A network says about where a line is and how it bends; where the frame shows the marking's two borders, its
middle is known more closely than a raster of 1 cm cells tells. A line whose borders are not found keeps the
network's answer, and says that nothing of it was seen.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network import compiled

#: Edge points that count, ahead of the front axle. Chosen: beyond the label rows by half a row, where the
#: parabola through them still holds.
_NEAR_CM, _FAR_CM = -4.0, 42.0
#: Distance from the expected border up to which edge points count, at first and at last, and by how much that
#: shrinks from step to step. The first was tried from 3.5 to 9 cm, see :func:`refine_lines`.
_FIRST_CM, _LAST_CM, _SHRINK, _STEPS = 9.0, 1.2, 0.6, 2
#: The same for what a line has beyond its parabola: distance at first, the largest, steps, sigmas of its
#: place that it spans, and the distance above which a border may have any direction near the line's. Tried.
_BENT_FIRST_CM, _BENT_CM, _BENT_STEPS, _BENT_SIGMAS, _LOOSE_CM = 3.5, 9.0, 4, 2.5, 3.0
#: Least cosine between a line's normal and that of an edge point of its borders. Chosen: 37 degrees.
_COSINE = 0.8
#: Sigma of an edge point across its line, at y = 0 and its growth per cm ahead; distance at which its weight
#: is halved; and edge points that count as independent, for all of a line: neighbours share their errors.
_EDGE_CM, _EDGE_GROWTH, _CAUCHY_CM, _INDEPENDENT = 0.5, 0.02, 0.5, 40.0
#: Difference of hues that takes three quarters of an edge point's weight. Tried from 0.2 to 0.4, and with the
#: square: on 24 simulated drives 29 of 1000 points lie more than 3 cm off with it, 33 without.
_HUE = 0.3
#: Correlation of the errors of neighbouring label rows in a network's answer, and their least variance, as
#: tried.
_CORRELATION, _LEAST_VARIANCE = 0.5, 0.05
#: Least and largest number of edge points of a line, and width of markings.
_LEAST, _MOST, _MARKING_CM = 6, 128, (0.8, 9.0)
#: A line is seen in a bin along the road that has a border within this of its place, and length of a bin.
_SEEN_CM, BIN_CM = 0.8, 3.0
_BINS = int((_FAR_CM - _NEAR_CM) / BIN_CM) + 1
#: Nodes of what a line has beyond its parabola, in half rows, and sigma of its third differences: 0 of a
#: parabola, 5 cm where tape is laid with a kink of 35 degrees. Tried from 0.3 to 2.5.
_NODE_CM = 7.5
_NODES_CM = np.arange(-_NODE_CM, 45.1, _NODE_CM)
_THIRD_CM = 1.5
_ROWS_AT: Int[np.ndarray, "3"] = np.searchsorted(_NODES_CM, ROWS_CM)

#: Cosine below which an edge point belongs to no line near that one, chosen; the golden ratio, by which any
#: part of a series is spread evenly.
_ROUGHLY, _GOLDEN = 0.6, 0.6180339887

#: Bins within 6 cm of each label row: none where a line's place is a guess.
_BESIDE = np.stack(
    [
        np.floor((np.arange(-2, 2) * BIN_CM + y - _NEAR_CM) / BIN_CM).clip(0.0).astype(np.int64)
        for y in ROWS_CM
    ]
)

#: (a, b, c) = x at the label rows @ BASIS, by Lagrange: the same bits on all machines.
BASIS = np.array(
    [
        [1.0 / ((y - p) * (y - q)), -(p + q) / ((y - p) * (y - q)), p * q / ((y - p) * (y - q))]
        for y, p, q in (np.roll(ROWS_CM, -i).tolist() for i in range(3))
    ]
)
_ROW_CORRELATION = _CORRELATION ** np.abs(np.subtract.outer(range(3), range(3)))
_THIRD = np.diff(np.eye(len(_NODES_CM)), n=3, axis=0)
_SMOOTH = _THIRD.T @ _THIRD / _THIRD_CM**2
#: Gates and Cauchy distances of the parabola's steps.
_GATES_CM = [_FIRST_CM * _SHRINK**step for step in range(_STEPS)]
_CAUCHIES_CM = [0.5 * _FIRST_CM, *[_CAUCHY_CM] * (_STEPS - 1)]
#: All of the above, as ``Numbers`` of ``_kernels.cpp`` has them.
_NUMBERS = np.concatenate(
    [
        np.ravel(values)
        for values in (
            *(BASIS, _ROW_CORRELATION, _SMOOTH, _NODES_CM, _ROWS_AT, _BESIDE, _GATES_CM, _CAUCHIES_CM),
            *(_NEAR_CM, _FAR_CM, _FIRST_CM, _LAST_CM, _BENT_FIRST_CM, _BENT_CM, _BENT_SIGMAS, _LOOSE_CM),
            *(_COSINE, _ROUGHLY, _EDGE_CM, _EDGE_GROWTH, _CAUCHY_CM, _INDEPENDENT, _HUE, _LEAST, _MOST),
            *(_MARKING_CM, _SEEN_CM, BIN_CM, _NODE_CM, _GOLDEN, _LEAST_VARIANCE, _BENT_STEPS),
        )
    ]
).astype(np.float64)


class RefinedLines(NamedTuple):
    """Lines on their markings.

    Attributes:
        points_cm: x at the label rows, frame car.
        sigma_cm: Their standard deviations.
        marking_cm: Width of the marking, negative for one that is darker than the floor.
        seen_cm: Length along the road in which the borders are where they should be, the mean of the two; 0
            where the line was not found, and its points are those that were given.
        seen_at: Whether a border lies beside each label row, within ``_BESIDE_CM`` along the road.
        look: By how much the marking is yellower and redder than the floor, as a share of the contrast, and
            the share of gaps between its nearest and its farthest border; NaN where nothing was seen.
        seen_to_cm: y, frame car, where the farthest bin along the road ends that has a border; where the
            first one begins if nothing was seen.
    """

    points_cm: Float[np.ndarray, "m 3"]
    sigma_cm: Float[np.ndarray, "m 3"]
    marking_cm: Float[np.ndarray, "m"]
    seen_cm: Float[np.ndarray, "m"]
    seen_at: Bool[np.ndarray, "m 3"]
    look: Float[np.ndarray, "m 3"]
    seen_to_cm: Float[np.ndarray, "m"]


class _NearEdges(NamedTuple):
    """Edge points of a frame that may be borders of a line within the label rows."""

    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    normal_x: Float[np.ndarray, "n"]
    normal_y: Float[np.ndarray, "n"]
    hues: Float[np.ndarray, "n 2"]
    key: Float[np.ndarray, "n"]


class RoadBorders:
    """Edge points of a frame, for lines to be compared with.

    Attributes:
        edges: All of the frame.
    """

    def __init__(self, edges: RoadEdges) -> None:
        self.edges = edges

    @cached_property
    def near(self) -> _NearEdges:
        """The edge points within the label rows; ``key`` puts them in an order that is spread evenly."""
        edges = self.edges
        near = (edges.points_cm[:, 1] > _NEAR_CM) & (edges.points_cm[:, 1] < _FAR_CM)
        hues = np.zeros_like(edges.points_cm) if edges.hues is None else edges.hues
        points, normals, hues = (x[near].astype(np.float64) for x in (edges.points_cm, edges.normals, hues))
        key = (np.arange(len(points)) * _GOLDEN) % 1.0
        return _NearEdges(points[:, 0], points[:, 1], normals[:, 0], normals[:, 1], hues, key)

    def off_cm(
        self, points_cm: Float[np.ndarray, "m 3"]
    ) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n"]]:
        """Distance of each edge point of ``near`` to the right of each line, and cosine of the normals."""
        edges = self.near
        x_cm, slope = line_at(points_cm, edges.y)
        across = 1.0 / np.sqrt(1.0 + slope * slope)
        return (edges.x - x_cm) * across, (edges.normal_x - edges.normal_y * slope) * across

    def beside(
        self, points_cm: Float[np.ndarray, "m 3"], reach_cm: Float[np.ndarray, "m"]
    ) -> tuple[Int[np.ndarray, "m k"], Bool[np.ndarray, "m k"]]:
        """Indices of the edge points near each line, at most ``_MOST`` of them; false beyond their number."""
        edges = self.near
        x_cm, slope = line_at(points_cm, edges.y)
        # As of off_cm(), but squares save the roots.
        steep, off = 1.0 + slope * slope, edges.x - x_cm
        facing, reach2 = edges.normal_x - edges.normal_y * slope, (reach_cm * reach_cm)[:, None]
        near = (off * off < reach2 * steep) & (facing * facing > _ROUGHLY * _ROUGHLY * steep)
        key = np.where(near, edges.key, 2.0)
        most = min(_MOST, key.shape[1])
        index = np.sort(np.argpartition(key, most - 1, axis=1)[:, :most], axis=1)
        return index, np.take_along_axis(key, index, axis=1) < 1.5


def refine_lines(
    points_cm: Float[np.ndarray, "m 3"],
    sigma_cm: Float[np.ndarray, "m 3"],
    borders: RoadBorders,
    marking_cm: Float[np.ndarray, "m"],
    marking_sigma_cm: Float[np.ndarray, "m"],
    hues: Float[np.ndarray, "m 2"] | None = None,
) -> RefinedLines:
    """Fit lines and the widths of their markings to edge points.

    Each line is a parabola with its own marking; edge points that face its middle lie half a width beside it.
    The points that are given are a prior with their sigmas, and so is the width. Around the parabola the line
    then bends further where its borders do: tape is laid in straight pieces as well. Where no border is near,
    sigma grows with the distance to the next.

    Args:
        points_cm: x of each line at the label rows, frame car.
        sigma_cm: Their standard deviations.
        borders: The frame's edge points.
        marking_cm: Expected widths, negative for markings that are darker than the floor.
        marking_sigma_cm: Their standard deviations.
        hues: By how much each marking is yellower and redder than the floor, as in ``look``;
            NaN while unknown. Edge points of another hue count less.

    Returns:
        The lines in the order given.

    Source:
        Iteratively reweighted least squares with Cauchy weights (Holland and Welsch 1977), gated; then the
        same for a smoothing spline. The numbers were tried on nine drives, eight of them simulated.
    """
    if hues is None:
        hues = np.full((len(points_cm), 2), np.nan)
    found = refined(np.column_stack([points_cm, sigma_cm, marking_cm, marking_sigma_cm, hues]), borders)
    return RefinedLines(
        *(found[:, :3], found[:, 3:6], found[:, 6], found[:, 7]),
        *(found[:, 8:11] > 0.0, found[:, 11:14], found[:, 14]),
    )


def refined(asked: Float[np.ndarray, "m 10"], borders: RoadBorders) -> Float[np.ndarray, "m 15"]:
    """Do :func:`refine_lines` for a table of lines, each apart from the others.

    Args:
        asked: Of each line its points, their sigmas, the marking's width and its sigma, and its two hues.
        borders: The frame's edge points.

    Returns:
        Of each line what :class:`RefinedLines` holds, in that order.
    """
    if compiled.is_here():
        return compiled.refine(asked, borders.edges, _NUMBERS)
    return np.column_stack(_refine(asked, borders))


def _refine(asked: Float[np.ndarray, "m 10"], borders: RoadBorders) -> RefinedLines:
    """Do :func:`refined` without compiled loops; every sum is taken in the order in which they do."""
    points_cm, sigma_cm, hues = asked[:, :3], asked[:, 3:6], asked[:, 8:]
    marking_cm, marking_sigma_cm = asked[:, 6], asked[:, 7]
    edges, m = borders.near, len(points_cm)
    prior = sigma_cm[:, :, None] * sigma_cm[:, None, :] * _ROW_CORRELATION + _LEAST_VARIANCE * np.eye(3)
    by_prior = _inverse(prior)
    start = np.concatenate([points_cm, marking_cm[:, None]], axis=1)
    if len(edges.x) < _LEAST:
        return _unseen(start, prior)
    index, there = borders.beside(points_cm, _FIRST_CM + _BENT_CM + np.abs(marking_cm))
    x, y, normal_x, normal_y = (each[index] for each in edges[:4])
    spread_cm = _EDGE_CM + _EDGE_GROWTH * np.maximum(y, 0.0)
    certain = there / (spread_cm * spread_cm)
    off = np.sign(marking_cm)[:, None, None] * edges.hues[index] - hues[:, None]
    unlike = 1.0 + (off[..., 0] * off[..., 0] + off[..., 1] * off[..., 1]) / (_HUE * _HUE)
    certain /= np.where(np.isnan(unlike), 1.0, unlike * unlike)

    # 1. The parabola and the width of the marking.
    information = np.zeros((m, 4, 4))
    information[:, :3, :3] = by_prior
    information[:, 3, 3] = 1.0 / (marking_sigma_cm * marking_sigma_cm)
    sign, (least, most) = np.sign(marking_cm), _MARKING_CM
    found, enough = start.copy(), np.zeros(m, dtype=bool)
    change = np.empty((*y.shape, 4))
    at = (y[..., None] * BASIS[:, 0] + BASIS[:, 1]) * y[..., None] + BASIS[:, 2]
    for most_cm, cauchy_cm in zip(_GATES_CM, _CAUCHIES_CM, strict=True):
        line_cm, slope = line_at(found[:, :3], y)
        across = 1.0 / np.sqrt(1.0 + slope * slope)
        agree = (normal_x - normal_y * slope) * across
        side = np.sign(agree)
        gap_cm = (x - line_cm) * across + 0.5 * side * found[:, 3:]
        near = there & (np.abs(agree) > _COSINE) & (np.abs(gap_cm) < most_cm)
        count = near.sum(axis=1)
        enough = count >= _LEAST
        share = gap_cm * (1.0 / cauchy_cm)
        weight = near * certain / (1.0 + share * share)
        weight /= np.maximum(1.0, count / _INDEPENDENT)[:, None]
        # Change of the gap with the line's points and with the width.
        np.multiply(at, -across[:, :, None], out=change[..., :3])
        np.multiply(side, 0.5, out=change[..., 3])
        weighted = change * weight[:, :, None]
        pull = _times(information, start - found) - _sum(weighted * gap_cm[:, :, None], 1)
        told = _sum(weighted[:, :, :, None] * change[:, :, None], 1)
        moved = found + _times(_inverse(information + told), pull)
        moved[:, 3] = sign * np.clip(sign * moved[:, 3], least, most)
        found = np.where(enough[:, None], moved, start)

    # 2. What it has beyond the parabola, linear between nodes along the road.
    line_cm, slope = line_at(found[:, :3], y)
    beyond_cm = x - line_cm
    ahead = (_NODES_CM - y[..., None]) / _NODE_CM
    share = np.maximum(1.0 - np.abs(ahead), 0.0)
    lean = np.sign(ahead) * (share > 0.0) / _NODE_CM

    def beside(extra_cm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Distance of the edge points from their borders, cosines of normals and slope, and the bend."""
        steep = slope + _sum(lean * extra_cm[:, None], 2)
        across = 1.0 / np.sqrt(1.0 + steep * steep)
        agree = (normal_x - normal_y * steep) * across
        bent_cm = _sum(share * extra_cm[:, None], 2)
        off_cm = (beyond_cm - bent_cm) * across
        return off_cm + 0.5 * np.sign(agree) * found[:, 3:], agree, across, bent_cm

    information = np.repeat(_SMOOTH[None], m, axis=0)
    information[:, _ROWS_AT[:, None], _ROWS_AT] += by_prior
    wanted = np.zeros((m, len(_NODES_CM)))
    wanted[:, _ROWS_AT] = _times(by_prior, points_cm - found[:, :3])
    extra_cm, covariance = np.zeros((m, len(_NODES_CM))), information
    gate_cm = np.full(y.shape, _BENT_FIRST_CM)
    for _ in range(_BENT_STEPS):
        gap_cm, agree, across, bent_cm = beside(extra_cm)
        cosine = np.where(gate_cm > _LOOSE_CM, _ROUGHLY, _COSINE)
        near = there & (np.abs(agree) > cosine) & (np.abs(gap_cm) < gate_cm)
        far = gap_cm * (1.0 / _CAUCHY_CM)
        weight = near * certain / (1.0 + far * far)
        weight /= np.maximum(1.0, near.sum(axis=1) / _INDEPENDENT)[:, None]
        weighted = share * (weight * across)[:, :, None]
        told = _sum((weighted * across[:, :, None])[:, :, :, None] * share[:, :, None], 1)
        covariance = _inverse(information + told)
        pull = _sum(weighted * (gap_cm + bent_cm * across)[:, :, None], 1)
        extra_cm = _times(covariance, pull + wanted)
        # Where the line is known the next border is near; beyond, it may be anywhere that tape may bend to.
        reach_cm = _BENT_SIGMAS * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        gate_cm = _sum(share * np.clip(reach_cm, _LAST_CM, _BENT_CM)[:, None], 2)
    gap_cm, agree, _, _ = beside(extra_cm)
    met = there & (np.abs(agree) > _COSINE) & (np.abs(gap_cm) < _SEEN_CM) & enough[:, None]
    # The two borders apart: on a marking of the other polarity, a line meets only one of them.
    seen = np.zeros((m, 2, _BINS), dtype=bool)
    row, column = np.nonzero(met)
    seen[
        row,
        (agree[row, column] > 0.0).astype(np.int64),
        ((y[row, column] - _NEAR_CM) / BIN_CM).astype(np.int64),
    ] = True
    filled = np.asarray(seen.any(axis=1))
    points = np.where(enough[:, None], found[:, :3] + extra_cm[:, _ROWS_AT], start[:, :3])
    variance = np.diagonal(covariance, axis1=1, axis2=2)[:, _ROWS_AT]
    variance = np.where(enough[:, None], variance, np.diagonal(prior, axis1=1, axis2=2))
    return RefinedLines(
        points,
        np.sqrt(variance),
        found[:, 3],
        0.5 * BIN_CM * seen.sum(axis=(1, 2)),
        np.any(seen[:, :, _BESIDE], axis=(1, 3)),
        _look(
            sign[:, None] * _sum(met[:, :, None] * edges.hues[index], 1),
            met.sum(axis=1),
            filled,
        ),
        _NEAR_CM + BIN_CM * np.where(filled.any(axis=1), _last(filled), 0),
    )


def line_at(
    points_cm: Float[np.ndarray, "m 3"], y: Float[np.ndarray, "*m n"]
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n"]]:
    """Return x of lines at y, and their slopes dx/dy."""
    a, b, c = (_sum(points_cm * column, 1)[:, None] for column in BASIS.T)
    return (a * y + b) * y + c, 2.0 * a * y + b


def _sum(terms: Float[np.ndarray, "*shape"], axis: int) -> Float[np.ndarray, "*left"]:
    """Return the sum from first to last, without the partial sums of ``numpy.sum``."""
    # Not -0.
    return np.add.accumulate(terms, axis=axis).take(-1, axis=axis) + 0.0


def _times(
    matrices: Float[np.ndarray, "m n n"], vectors: Float[np.ndarray, "m n"]
) -> Float[np.ndarray, "m n"]:
    return _sum(matrices * vectors[:, None], 2)


def _inverse(matrices: Float[np.ndarray, "m n n"]) -> Float[np.ndarray, "m n n"]:
    """Return the inverses of symmetric, positive definite matrices, by Gauss and Jordan."""
    inverse = matrices.copy()
    for i in range(inverse.shape[1]):
        scale = 1.0 / inverse[:, i, i]
        row, column = inverse[:, i] * scale[:, None], inverse[:, :, i].copy()
        row[:, i] = scale
        inverse[:, :, i] = 0.0
        inverse -= column[:, :, None] * row[:, None]
        inverse[:, i] = row
    return inverse


def _look(
    hues: Float[np.ndarray, "m 2"], count: Int[np.ndarray, "m"], filled: Bool[np.ndarray, "m b"]
) -> Float[np.ndarray, "m 3"]:
    """Mean hues of lines, from their sums over the borders, and the share of gaps among their bins."""
    first, last = filled.argmax(axis=1), _last(filled)
    look = np.column_stack([hues / np.maximum(count, 1)[:, None], 1.0 - filled.sum(axis=1) / (last - first)])
    return np.where(count[:, None] > 0, look, np.nan)


def _last(filled: Bool[np.ndarray, "m b"]) -> Int[np.ndarray, "m"]:
    """Return the index after the last true one."""
    return filled.shape[1] - filled[:, ::-1].argmax(axis=1)


def _unseen(start: Float[np.ndarray, "m 4"], prior: Float[np.ndarray, "m 3 3"]) -> RefinedLines:
    sigma_cm = np.sqrt(np.diagonal(prior, axis1=1, axis2=2))
    m = len(start)
    nothing = np.zeros(m), np.zeros((m, 3), dtype=bool), np.full((m, 3), np.nan), np.full(m, _NEAR_CM)
    return RefinedLines(start[:, :3], sigma_cm, start[:, 3], *nothing)
