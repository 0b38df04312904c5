"""Edge points of an image: where, and in which direction the image gets brighter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, Int16, UInt8

_TAN_22_5 = float(np.tan(np.pi / 8.0))
_MOST_BYTE = 255
_BEFORE_AND_AFTER = np.array([-1, 1]).reshape(2, 1, 1)

#: Sobel responses of a channel along u and v.
Slopes = tuple[Int16[np.ndarray, "h w"], Int16[np.ndarray, "h w"]]


@dataclass(frozen=True)
class EdgePixels:
    """Edge points of one frame.

    Attributes:
        uv_px: Positions u, v, frame image.
        normals: Unit gradient at each edge, towards the brighter side, in image axes.
        hues: By how much the image gets yellower, and redder, along the normal, as a share of the gradient,
            from -1 to 1; None where colours were not looked at.
    """

    uv_px: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]
    hues: Float[np.ndarray, "n 2"] | None = None

    def towards_dark(self) -> EdgePixels:
        """Return the points with normals to the darker side: dark markings look like bright ones."""
        return replace(self, normals=-self.normals)


def gradients(
    gray: UInt8[np.ndarray, "h w"], blur_px: int
) -> tuple[Int16[np.ndarray, "h w"], Int16[np.ndarray, "h w"]]:
    """Return the Sobel responses along u and v after a Gauss blur of ``blur_px`` (0 for none)."""
    if blur_px:
        gray = cv2.GaussianBlur(gray, (blur_px, blur_px), 0)
    if min(gray.shape) < 3:
        return cv2.Sobel(gray, cv2.CV_16S, 1, 0), cv2.Sobel(gray, cv2.CV_16S, 0, 1)
    # The same numbers as two calls of Sobel, in the time of one.
    dx, dy = cv2.spatialGradient(gray)
    return dx, dy


def prefer_stronger(
    dx: Int16[np.ndarray, "h w"],
    dy: Int16[np.ndarray, "h w"],
    other_dx: Int16[np.ndarray, "h w"],
    other_dy: Int16[np.ndarray, "h w"],
    weight: float,
    least: float,
) -> None:
    """Replace Sobel responses, in place, where others are stronger.

    Args:
        dx: Responses along u, changed.
        dy: Responses along v, changed.
        other_dx: The others along u.
        other_dy: The others along v.
        weight: By which the others are multiplied first; above 0.
        least: Responses below this give no edge, so that they are not looked at.

    Source:
        The gradient of the strongest channel is that of Dalal and Triggs 2005; the weight is our own.
    """
    # Few pixels are left: the sum of both responses is no less than the length of the gradient. In bytes, of
    # which larger ones are 255, that takes a quarter of the time.
    total = cv2.add(cv2.convertScaleAbs(other_dx), cv2.convertScaleAbs(other_dy))
    at = np.flatnonzero(total.reshape(-1) > min(int(least / weight), _MOST_BYTE - 1))
    strength = np.abs(other_dx.reshape(-1).take(at)) + np.abs(other_dy.reshape(-1).take(at))
    flat_dx, flat_dy = dx.reshape(-1), dy.reshape(-1)
    at = at[weight * strength > np.abs(flat_dx.take(at)) + np.abs(flat_dy.take(at))]
    flat_dx[at] = np.rint(weight * other_dx.reshape(-1).take(at))
    flat_dy[at] = np.rint(weight * other_dy.reshape(-1).take(at))


def edge_pixels(
    edges: UInt8[np.ndarray, "h w"],
    dx: Int16[np.ndarray, "h w"],
    dy: Int16[np.ndarray, "h w"],
    subpixel: bool,
    hues: Sequence[Slopes] = (),
) -> EdgePixels:
    """Collect the marked pixels with their directions.

    Args:
        edges: Nonzero where there is an edge.
        dx: Sobel response along u.
        dy: Sobel response along v.
        subpixel: Move each point along its gradient to where the gradient peaks.
        hues: Sobel responses of yellow and of red; empty where colours are not looked at.

    Returns:
        The points in rows from top to bottom.

    Source:
        Sub-pixel step: parabola through the gradient magnitude at the edge and at its two neighbours along
        the gradient (Devernay 1995).
    """
    width = edges.shape[1]
    at = np.flatnonzero(edges.reshape(-1) != 0)
    # Columns of u and v (or dx and dy) side by side: on so few numbers it is the calls that cost.
    places = np.empty((2, len(at)), np.intp)
    np.floor_divide(at, width, out=places[1])
    np.subtract(at, places[1] * width, out=places[0])
    slopes = np.empty((2, len(at)))
    slopes[0], slopes[1] = dx.reshape(-1).take(at), dy.reshape(-1).take(at)
    strength = np.sqrt(slopes[0] * slopes[0] + slopes[1] * slopes[1])
    normals = slopes * (1.0 / np.maximum(strength, 1e-9))
    uv = places.astype(np.float64)
    if subpixel and len(at):
        uv += _subpixel_offset(dx, dy, places, normals, strength) * normals
    points, directions = np.ascontiguousarray(uv.T), np.ascontiguousarray(normals.T)
    return EdgePixels(points, directions, _hue_shares(hues, at, normals, strength) if hues else None)


def _hue_shares(
    hues: Sequence[Slopes],
    at: Int[np.ndarray, "n"],
    normals: Float[np.ndarray, "2 n"],
    strength: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n k"]:
    """Responses of hues along the normals, as shares of the gradient."""
    shares = np.empty((len(at), len(hues)))
    for column, (hue_dx, hue_dy) in enumerate(hues):
        along = hue_dx.reshape(-1).take(at) * normals[0]
        along += hue_dy.reshape(-1).take(at) * normals[1]
        shares[:, column] = along
    shares /= np.maximum(strength, 1.0)[:, None]
    np.maximum(shares, -1.0, out=shares)
    return np.minimum(shares, 1.0, out=shares)


def _subpixel_offset(
    dx: Int16[np.ndarray, "h w"],
    dy: Int16[np.ndarray, "h w"],
    places: Int[np.ndarray, "2 n"],
    normals: Float[np.ndarray, "2 n"],
    strength: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n"]:
    """Offset along the normal, within half a step to the neighbour, where the gradient magnitude peaks."""
    height, width = dx.shape
    # The neighbour that Canny compared with: beside, above or diagonal, whichever the gradient is closest to.
    sizes = np.abs(normals)
    steps = (np.sign(normals) * (sizes > _TAN_22_5 * sizes[::-1])).astype(np.intp)
    neighbours = places + _BEFORE_AND_AFTER * steps
    # Not np.clip, which costs several times as much on so few numbers.
    np.maximum(neighbours, 0, out=neighbours)
    np.minimum(neighbours, [[width - 1], [height - 1]], out=neighbours)
    at = neighbours[:, 1] * width + neighbours[:, 0]
    # Only gradients of the same direction count: the other edge of a thin line must not pull this one.
    along = dx.reshape(-1).take(at) * normals[0] + dy.reshape(-1).take(at) * normals[1]
    before, after = np.maximum(along, 0.0, out=along)
    curvature = before - 2.0 * strength + after
    # Where the magnitude does not peak the offset is none.
    offset = 0.5 * (before - after) / np.where(curvature < 0.0, curvature, -np.inf)
    # That neighbour is so far along the normal.
    reach = steps * normals
    return np.minimum(np.maximum(offset, -0.5), 0.5) * np.abs(reach[0] + reach[1])
