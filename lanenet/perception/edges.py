"""Edge pixels of a frame, with the direction of their gradient and sub-pixel positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import DriveFormatError

_TAN_22_5 = float(np.tan(np.pi / 8.0))


class EdgeSettings(Settings):
    """How edges are found in a frame.

    ``canny`` is the paper's detector: fixed thresholds, whole pixels. ``directional`` raises the thresholds
    with the contrast of the frame, so that soft mirror images of lamps fall below them where the tape is
    bright, and moves each edge along its gradient to the sub-pixel maximum.

    Attributes:
        method: The detector.
        blur_px: Size of the Gauss kernel; 0 for none.
        low: Lower threshold of the hysteresis on Sobel responses.
        high: Upper threshold.
        contrast_share: ``directional``: the upper threshold is at least this share of the 99th percentile of
            the frame's Sobel responses; the lower one keeps its ratio.
    """

    method: Literal["canny", "directional"] = "directional"
    blur_px: Literal[0, 3, 5] = 3
    low: float = Field(default=40.0, gt=0.0)
    high: float = Field(default=80.0, gt=0.0)
    contrast_share: float = Field(default=0.3, ge=0.0, lt=1.0)


@dataclass(frozen=True)
class EdgePixels:
    """Edge points of one frame.

    Attributes:
        uv_px: Positions u, v, frame image.
        normals: Unit gradient at each edge, towards the brighter side, in image axes.
    """

    uv_px: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]


def find_edges(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    settings: EdgeSettings,
    keep: UInt8[np.ndarray, "h w"] | None = None,
) -> EdgePixels:
    """Find the edge points of a frame.

    Args:
        frame_bgr: Colour or gray image.
        settings: The detector and its thresholds (of OpenCV's Canny, on Sobel responses).
        keep: Mask of pixels that may be edges (0 elsewhere).

    Returns:
        Edge points with directions; empty when the frame has none.

    Source:
        Canny 1986; sub-pixel step: parabola through the gradient magnitude at the edge and at its two
        neighbours along the gradient (Devernay 1995).
    """
    gray = to_gray(frame_bgr)
    if settings.blur_px:
        gray = cv2.GaussianBlur(gray, (settings.blur_px, settings.blur_px), 0)
    dx = cv2.Sobel(gray, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(gray, cv2.CV_16S, 0, 1)
    raised = 1.0
    if settings.method == "directional":
        raised = max(1.0, settings.contrast_share * _strong_response(dx, dy, keep) / settings.high)
    edges = cv2.Canny(dx, dy, raised * settings.low, raised * settings.high, L2gradient=True)
    if keep is not None:
        cv2.bitwise_and(edges, keep, dst=edges)
    found = cv2.findNonZero(edges)
    if found is None:
        return EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
    # OpenCV 4 answers (n, 1, 2), OpenCV 5 (n, 2).
    u, v = found.reshape(-1, 2).T.astype(np.intp)
    gradient = np.stack([dx[v, u], dy[v, u]], axis=1).astype(np.float64)
    strength = np.linalg.norm(gradient, axis=1)
    normals = gradient / np.maximum(strength, 1e-9)[:, None]
    uv = np.stack([u, v], axis=1).astype(np.float64)
    if settings.method == "directional":
        uv += _subpixel_offset(dx, dy, u, v, normals, strength)[:, None] * normals
    return EdgePixels(uv, normals)


def _strong_response(dx: np.ndarray, dy: np.ndarray, keep: np.ndarray | None) -> float:
    """99th percentile of the Sobel magnitude over the kept pixels, from every third row and column."""
    gx, gy = dx[::3, ::3], dy[::3, ::3]
    if keep is not None:
        inside = keep[::3, ::3] > 0
        gx, gy = gx[inside], gy[inside]
    squared = gx.ravel().astype(np.float32) ** 2 + gy.ravel().astype(np.float32) ** 2
    if squared.size == 0:
        return 0.0
    rank = int(0.99 * (squared.size - 1))
    return float(np.sqrt(np.partition(squared, rank)[rank]))


def to_gray(frame_bgr: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w"]:
    """Return the frame as gray uint8.

    Raises:
        DriveFormatError: If the array is not an image of one or three uint8 channels.
    """
    if frame_bgr.dtype != np.uint8 or frame_bgr.ndim not in (2, 3) or frame_bgr.size == 0:
        raise DriveFormatError(
            f"frame: expected a uint8 image (h, w) or (h, w, 3), found {frame_bgr.dtype} {frame_bgr.shape}"
        )
    if frame_bgr.ndim == 2:
        return frame_bgr
    if frame_bgr.shape[2] != 3:
        raise DriveFormatError(f"frame: expected 3 channels (BGR), found {frame_bgr.shape[2]}")
    return np.asarray(cv2.cvtColor(frame_bgr, cv2.COLOR_BGR2GRAY))


def _subpixel_offset(
    dx: np.ndarray, dy: np.ndarray, u: np.ndarray, v: np.ndarray, normals: np.ndarray, strength: np.ndarray
) -> np.ndarray:
    """Offset along the normal, within half a step to the neighbour, where the gradient magnitude peaks."""
    height, width = dx.shape
    # The neighbour that Canny compared with: beside, above or diagonal, whichever the gradient is closest to.
    size_u, size_v = np.abs(normals[:, 0]), np.abs(normals[:, 1])
    step_u = (np.sign(normals[:, 0]) * (size_u > _TAN_22_5 * size_v)).astype(np.intp)
    step_v = (np.sign(normals[:, 1]) * (size_v > _TAN_22_5 * size_u)).astype(np.intp)

    def magnitude(sign: int) -> np.ndarray:
        uu = np.clip(u + sign * step_u, 0, width - 1)
        vv = np.clip(v + sign * step_v, 0, height - 1)
        gx, gy = dx[vv, uu].astype(np.float64), dy[vv, uu].astype(np.float64)
        # Only what points the same way counts: the other edge of a thin line must not pull this one.
        return np.maximum(gx * normals[:, 0] + gy * normals[:, 1], 0.0)

    before, after = magnitude(-1), magnitude(1)
    curvature = before - 2.0 * strength + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(curvature < 0.0, 0.5 * (before - after) / curvature, 0.0)
    # That neighbour is so far along the normal.
    reach = np.abs(step_u * normals[:, 0] + step_v * normals[:, 1])
    return np.clip(offset, -0.5, 0.5) * reach
