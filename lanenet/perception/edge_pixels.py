"""Edge points of an image: where, and in which direction the image gets brighter."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int16, UInt8

_TAN_22_5 = float(np.tan(np.pi / 8.0))


@dataclass(frozen=True)
class EdgePixels:
    """Edge points of one frame.

    Attributes:
        uv_px: Positions u, v, frame image.
        normals: Unit gradient at each edge, towards the brighter side, in image axes.
    """

    uv_px: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]


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


def edge_pixels(
    edges: UInt8[np.ndarray, "h w"],
    dx: Int16[np.ndarray, "h w"],
    dy: Int16[np.ndarray, "h w"],
    subpixel: bool,
) -> EdgePixels:
    """Collect the marked pixels with their directions.

    Args:
        edges: Nonzero where there is an edge.
        dx: Sobel response along u.
        dy: Sobel response along v.
        subpixel: Move each point along its gradient to where the gradient peaks.

    Returns:
        The points in rows from top to bottom.

    Source:
        Sub-pixel step: parabola through the gradient magnitude at the edge and at its two neighbours along
        the gradient (Devernay 1995).
    """
    width = edges.shape[1]
    at = np.flatnonzero(edges.reshape(-1) != 0)
    v = at // width
    u = at - v * width
    gx = dx.reshape(-1).take(at).astype(np.float64)
    gy = dy.reshape(-1).take(at).astype(np.float64)
    strength = np.sqrt(gx * gx + gy * gy)
    shrink = 1.0 / np.maximum(strength, 1e-9)
    nu, nv = gx * shrink, gy * shrink
    uv, normals = np.empty((len(at), 2)), np.empty((len(at), 2))
    normals[:, 0], normals[:, 1] = nu, nv
    uv[:, 0], uv[:, 1] = u, v
    if subpixel and len(at):
        offset = _subpixel_offset(dx, dy, u, v, nu, nv, strength)
        uv[:, 0] += offset * nu
        uv[:, 1] += offset * nv
    return EdgePixels(uv, normals)


def _subpixel_offset(
    dx: np.ndarray,
    dy: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    nu: np.ndarray,
    nv: np.ndarray,
    strength: np.ndarray,
) -> np.ndarray:
    """Offset along the normal, within half a step to the neighbour, where the gradient magnitude peaks."""
    height, width = dx.shape
    # The neighbour that Canny compared with: beside, above or diagonal, whichever the gradient is closest to.
    size_u, size_v = np.abs(nu), np.abs(nv)
    step_u = (np.sign(nu) * (size_u > _TAN_22_5 * size_v)).astype(np.intp)
    step_v = (np.sign(nv) * (size_v > _TAN_22_5 * size_u)).astype(np.intp)
    flat_dx, flat_dy = dx.reshape(-1), dy.reshape(-1)

    def magnitude(uu: np.ndarray, vv: np.ndarray) -> np.ndarray:
        # Not np.clip, which costs several times as much on so few numbers.
        vv = np.minimum(np.maximum(vv, 0), height - 1)
        at = vv * width + np.minimum(np.maximum(uu, 0), width - 1)
        # Only what points the same way counts: the other edge of a thin line must not pull this one.
        return np.maximum(flat_dx.take(at) * nu + flat_dy.take(at) * nv, 0.0)

    before, after = magnitude(u - step_u, v - step_v), magnitude(u + step_u, v + step_v)
    curvature = before - 2.0 * strength + after
    # Where the magnitude does not peak the offset is none.
    offset = 0.5 * (before - after) / np.where(curvature < 0.0, curvature, -np.inf)
    # That neighbour is so far along the normal.
    reach = np.abs(step_u * nu + step_v * nv)
    return np.minimum(np.maximum(offset, -0.5), 0.5) * reach
