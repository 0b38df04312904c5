"""First steps of Pentek's painter: contrast, V channel, Canny, and the trapezoid that may hold a lane."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera

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
            from the camera's horizon, or without a camera from the proportions of a road picture.
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
    picture are taken.
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
