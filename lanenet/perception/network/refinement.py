"""Lines that a network found, fitted to the edge points of their markings.

A network says about where a line is and how it bends; where the frame shows the marking's two borders, its
middle is known more closely than a raster of 1 cm cells tells. A line whose borders are not found keeps the
network's answer, and says that nothing of it was seen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lanenet.geometry.lane import PARABOLA_FROM_POINTS
from lanenet.perception.edges.road import RoadEdges

#: Edge points that count, ahead of the front axle. Chosen: beyond the label rows by half a row, where the
#: parabola through them still holds.
_NEAR_CM, _FAR_CM = -4.0, 42.0
#: Distance from the expected border up to which edge points count, at first and at last, and by how much that
#: shrinks from step to step. The first was tried from 3.5 to 9 cm, see :func:`refine_lines`.
_FIRST_CM, _LAST_CM, _SHRINK, _STEPS = 9.0, 1.2, 0.6, 4
#: Least cosine between a line's normal and that of an edge point of its borders. Chosen: 37 degrees.
_COSINE = 0.8
#: Sigma of an edge point across its line, at y = 0 and its growth per cm ahead; distance at which its weight
#: is halved; and edge points that count as independent, for all of a line: neighbours share their errors.
_EDGE_CM, _EDGE_GROWTH, _CAUCHY_CM, _INDEPENDENT = 0.5, 0.02, 0.5, 40.0
#: Correlation of the errors of neighbouring label rows in a network's answer, as tried.
_CORRELATION = 0.5
#: Least number of edge points of a line, and width of markings.
_LEAST, _MARKING_CM = 6, (0.8, 9.0)
#: A line is seen in a bin along the road that has a border within this of its place, and length of a bin.
_SEEN_CM, _BIN_CM = 0.8, 3.0

_ROW_CORRELATION = _CORRELATION ** np.abs(np.subtract.outer(range(3), range(3)))


class RefinedLines(NamedTuple):
    """Lines on their markings.

    Attributes:
        points_cm: x at the label rows, frame car.
        sigma_cm: Their standard deviations.
        marking_cm: Width of the marking, negative for one that is darker than the floor.
        seen_cm: Length along the road in which the borders are where they should be, the mean of the two; 0
            where the line was not found, and its points are those that were given.
    """

    points_cm: Float[np.ndarray, "m 3"]
    sigma_cm: Float[np.ndarray, "m 3"]
    marking_cm: Float[np.ndarray, "m"]
    seen_cm: Float[np.ndarray, "m"]


class RoadBorders:
    """Edge points of a frame that may be borders of a line within the label rows, ready to be compared."""

    def __init__(self, edges: RoadEdges) -> None:
        y = edges.points_cm[:, 1]
        near = (y > _NEAR_CM) & (y < _FAR_CM)
        self.x, self.y = edges.points_cm[near].T.astype(np.float64)
        self.normal_x, self.normal_y = edges.normals[near].T.astype(np.float64)
        ones = np.ones_like(self.y)
        # x of a line and its slope at these y, from its points at the label rows.
        self.at = np.stack([self.y * self.y, self.y, ones], axis=1) @ PARABOLA_FROM_POINTS
        self.slope = np.stack([2.0 * self.y, ones, 0.0 * ones], axis=1) @ PARABOLA_FROM_POINTS
        self.weight = 1.0 / (_EDGE_CM + _EDGE_GROWTH * np.maximum(self.y, 0.0)) ** 2
        self.bin: Int[np.ndarray, "n"] = ((self.y - _NEAR_CM) / _BIN_CM).astype(np.int64)

    def off_cm(
        self, points_cm: Float[np.ndarray, "m 3"]
    ) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n"], Float[np.ndarray, "m n"]]:
        """Distance of each edge point to the right of each line, cosine of the normals, and of the slope."""
        slope = points_cm @ self.slope.T
        across = 1.0 / np.sqrt(1.0 + slope * slope)
        return (
            (self.x - points_cm @ self.at.T) * across,
            (self.normal_x - self.normal_y * slope) * across,
            across,
        )


def refine_lines(
    points_cm: Float[np.ndarray, "m 3"],
    sigma_cm: Float[np.ndarray, "m 3"],
    borders: RoadBorders,
    marking_cm: Float[np.ndarray, "m"],
    marking_sigma_cm: Float[np.ndarray, "m"],
) -> RefinedLines:
    """Fit lines and the widths of their markings to edge points.

    Each line is a parabola with its own marking; edge points that face its middle lie half a width beside it.
    The points that are given are a prior with their sigmas, and so is the width.

    Args:
        points_cm: x of each line at the label rows, frame car.
        sigma_cm: Their standard deviations.
        borders: The frame's edge points.
        marking_cm: Expected widths, negative for markings that are darker than the floor.
        marking_sigma_cm: Their standard deviations.

    Returns:
        The lines in the order given.

    Source:
        Iteratively reweighted least squares with Cauchy weights (Holland and Welsch 1977), gated. The numbers
        were tried on nine drives, eight of them simulated.
    """
    m = len(points_cm)
    prior = sigma_cm[:, :, None] * sigma_cm[:, None, :] * _ROW_CORRELATION + 0.05 * np.eye(3)
    information = np.zeros((m, 4, 4))
    information[:, :3, :3] = np.linalg.inv(prior)
    information[:, 3, 3] = marking_sigma_cm**-2
    start = np.concatenate([points_cm, marking_cm[:, None]], axis=1)
    least, most = _MARKING_CM
    found, hessian = start.copy(), information
    if len(borders.x) < _LEAST:
        return _unseen(start, prior)
    enough = np.zeros(m, dtype=bool)
    for step in range(_STEPS):
        off_cm, agree, across = borders.off_cm(found[:, :3])
        side = np.sign(agree)
        gap_cm = off_cm + 0.5 * side * found[:, 3:]
        gate_cm = max(_LAST_CM, _FIRST_CM * _SHRINK**step)
        near = (np.abs(agree) > _COSINE) & (np.abs(gap_cm) < gate_cm)
        count = near.sum(axis=1)
        enough = count >= _LEAST
        soft_cm = _CAUCHY_CM if step else 0.5 * gate_cm
        weight = near * borders.weight / (1.0 + (gap_cm / soft_cm) ** 2)
        weight /= np.maximum(1.0, count / _INDEPENDENT)[:, None]
        # Change of the gap with the line's points and with the width.
        change = np.concatenate([-across[:, :, None] * borders.at, 0.5 * side[:, :, None]], axis=2)
        weighted = change * weight[:, :, None]
        hessian = information + weighted.transpose(0, 2, 1) @ change
        pull = (information @ (start - found)[:, :, None])[:, :, 0]
        pull -= (weighted * gap_cm[:, :, None]).sum(axis=1)
        moved = found + np.linalg.solve(hessian, pull[:, :, None])[:, :, 0]
        sign = np.where(marking_cm < 0.0, -1.0, 1.0)
        moved[:, 3] = sign * np.clip(sign * moved[:, 3], least, most)
        found = np.where(enough[:, None], moved, start)
    if not enough.any():
        return _unseen(start, prior)
    off_cm, agree, _ = borders.off_cm(found[:, :3])
    gap_cm = np.abs(off_cm + 0.5 * np.sign(agree) * found[:, 3:])
    met = (np.abs(agree) > _COSINE) & (gap_cm < _SEEN_CM) & enough[:, None]
    # The two borders apart: on a marking of the other polarity, a line meets only one of them.
    seen = np.zeros((m, 2, int((_FAR_CM - _NEAR_CM) / _BIN_CM) + 1), dtype=bool)
    row, column = np.nonzero(met)
    seen[row, (agree[row, column] > 0.0).astype(np.int64), borders.bin[column]] = True
    variance = np.diagonal(np.linalg.inv(hessian), axis1=1, axis2=2)[:, :3]
    variance = np.where(enough[:, None], variance, np.diagonal(prior, axis1=1, axis2=2))
    return RefinedLines(found[:, :3], np.sqrt(variance), found[:, 3], 0.5 * _BIN_CM * seen.sum(axis=(1, 2)))


def _unseen(start: Float[np.ndarray, "m 4"], prior: Float[np.ndarray, "m 3 3"]) -> RefinedLines:
    sigma_cm = np.sqrt(np.diagonal(prior, axis1=1, axis2=2))
    return RefinedLines(start[:, :3], sigma_cm, start[:, 3], np.zeros(len(start)))
