"""Edges of lane markings only: strips brighter or yellower than the road beside them, told by their shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.perception.edge_pixels import EdgePixels, edge_pixels, gradients

#: Sides of the top-hat's square, [px]; each row takes the smallest that the widest marking fits into.
_KERNELS_PX = (7, 11, 17, 25, 37, 55)
#: Sobel response of a step of one gray level, without blur.
_SOBEL_GAIN = 4.0


class ColourSettings(Settings):
    """What counts as a marking; thresholds follow the frame's own contrast down to the given floors.

    Attributes:
        markings: ``light`` markings on a darker road, ``dark`` ones on a lighter road, or ``both``.
        thickest_cm: Markings are at most so thick.
        white_floor: Smallest response that counts, in levels of Lab's L (0-255): brighter than the road
            beside.
        yellow_floor: The same in levels of Lab's b (0-255): yellower than the road beside.
        contrast_share: The threshold is at least this share of the 99th percentile of the responses.
        least_area_px: Smaller components are dropped.
        least_elongation: Length over thickness; a disk has 2 to 3, a square 4 (by its boundary).
        least_sharpness: Mean gradient on a component's boundary over that of a sharp step of its contrast.
        yellow: Look for yellow at all.
    """

    markings: Literal["light", "dark", "both"] = "light"
    thickest_cm: float = Field(default=6.0, gt=0.0)
    white_floor: int = Field(default=12, ge=1, le=255)
    yellow_floor: int = Field(default=8, ge=1, le=255)
    contrast_share: float = Field(default=0.35, ge=0.0, lt=1.0)
    least_area_px: int = Field(default=8, ge=1)
    least_elongation: float = Field(default=3.0, ge=0.0)
    least_sharpness: float = Field(default=0.25, ge=0.0, le=1.0)
    yellow: bool = True


@dataclass(frozen=True, eq=False)
class PixelScale:
    """How much road a pixel spans sideways.

    Attributes:
        cm_per_px: Of each pixel, [cm/px]; NaN off the road.
        row_cm_per_px: Median of each row's useful pixels, [cm/px]; NaN where a row has none.
    """

    cm_per_px: Float[np.ndarray, "h w"]
    row_cm_per_px: Float[np.ndarray, "h"]


def colour_edges(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    settings: ColourSettings,
    blur_px: int,
    keep: UInt8[np.ndarray, "h w"] | None = None,
    scale: PixelScale | None = None,
) -> EdgePixels:
    """Find the edges of white and yellow markings, with the gradient of the channel that shows them.

    Args:
        frame_bgr: Colour or gray image (gray: white markings only).
        settings: What counts as a marking.
        blur_px: Gauss kernel before the gradient.
        keep: Mask of pixels that may be edges (0 elsewhere).
        scale: Road per pixel; without it the sizes are those of a camera that shows the thickest marking
            with an eighth of the picture's width, and thickness is not judged.

    Returns:
        Sub-pixel edge points; the normal points to the brighter, or yellower, side.

    Source:
        Own derivation. Top-hat: Serra 1982; thickness and length of a strip from its area and boundary.
    """
    height, width = frame_bgr.shape[:2]
    top, bottom = _rows_in_use(keep, height)
    if bottom - top < 3 or width < 3:
        return EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
    part = frame_bgr[top:bottom]
    keep_part = None if keep is None else keep[top:bottom]
    row_px = _thickest_px(settings.thickest_cm, scale, height, width)[top:bottom]
    cm_per_px = None if scale is None else scale.cm_per_px[top:bottom]

    channels = [(part, settings.white_floor, settings.markings)]
    if part.ndim == 3:
        lab = cv2.cvtColor(part, cv2.COLOR_BGR2Lab)
        channels = [(cv2.extractChannel(lab, 0), settings.white_floor, settings.markings)]
        if settings.yellow:
            # Yellow first: where both see a marking, the road's brightness disturbs the yellow edge less.
            channels.insert(0, (cv2.extractChannel(lab, 2), settings.yellow_floor, "light"))
    found: list[EdgePixels] = []
    taken: np.ndarray | None = None
    for channel, floor, markings in channels:
        mask, threshold = _strips(channel, floor, markings, settings.contrast_share, row_px, keep_part)
        if mask is None:
            continue
        if taken is not None:
            mask[taken > 0] = 0
        dx, dy = gradients(channel, blur_px)
        mask = _marking_shapes(mask, dx, dy, threshold, cm_per_px, settings)
        if mask is None:
            continue
        around = cv2.dilate(mask, _square(3))
        step = _SOBEL_GAIN * threshold
        edges = cv2.Canny(dx, dy, 0.25 * step, 0.5 * step, L2gradient=True)
        cv2.bitwise_and(edges, around, dst=edges)
        if keep_part is not None:
            cv2.bitwise_and(edges, keep_part, dst=edges)
        found.append(edge_pixels(edges, dx, dy, subpixel=True))
        taken = cv2.dilate(mask, _square(7))
    if not found:
        return EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
    uv = np.concatenate([edges.uv_px for edges in found])
    uv[:, 1] += top
    return EdgePixels(uv, np.concatenate([edges.normals for edges in found]))


def _strips(
    channel: np.ndarray,
    floor: int,
    markings: str,
    contrast_share: float,
    row_px: np.ndarray,
    keep: np.ndarray | None,
) -> tuple[np.ndarray | None, float]:
    """Mask of what stands out from its surroundings and is thin; and the threshold in levels."""
    response = _thin_response(channel, markings, row_px)
    sample = response[::2, ::2]
    inside = sample.ravel() if keep is None else sample[keep[::2, ::2] > 0]
    counts = np.bincount(inside, minlength=256)
    if not counts[floor:].any():
        return None, 0.0
    strong = int(np.searchsorted(np.cumsum(counts), 0.99 * inside.size))
    threshold = max(float(floor), contrast_share * strong)
    mask = cv2.threshold(response, threshold, 255, cv2.THRESH_BINARY)[1]
    if keep is not None:
        cv2.bitwise_and(mask, keep, dst=mask)
    return mask, threshold


def _thin_response(channel: np.ndarray, markings: str, row_px: np.ndarray) -> np.ndarray:
    """Top-hat (light), bottom-hat (dark) or the larger of both; the square grows with the road's scale."""
    sides = np.asarray(_KERNELS_PX)[np.minimum(np.searchsorted(_KERNELS_PX, row_px), len(_KERNELS_PX) - 1)]
    response = np.zeros_like(channel)
    starts = np.flatnonzero(np.diff(sides, prepend=-1))
    for start, stop in zip(starts, [*starts[1:], len(sides)], strict=True):
        side = int(sides[start])
        above, below = max(0, start - side), min(len(sides), stop + side)
        band = channel[above:below]
        inner = slice(start - above, stop - above)
        hats = [
            cv2.morphologyEx(band, operation, _square(side))[inner]
            for name, operation in (("light", cv2.MORPH_TOPHAT), ("dark", cv2.MORPH_BLACKHAT))
            if markings in (name, "both")
        ]
        response[start:stop] = hats[0] if len(hats) == 1 else np.maximum(*hats)
    return response


def _marking_shapes(
    mask: np.ndarray,
    dx: np.ndarray,
    dy: np.ndarray,
    threshold: float,
    cm_per_px: np.ndarray | None,
    settings: ColourSettings,
) -> np.ndarray | None:
    """Keep the components that are long, thin and sharp; None if there are none."""
    count, labels = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
    if count < 2:
        return None
    flat = labels.reshape(-1)
    inside = np.flatnonzero(flat)
    of_inside = flat[inside]
    # Label 0 is the background, which has no entries here.
    area = np.maximum(np.bincount(of_inside, minlength=count), 1).astype(np.float64)
    # The picture's border is no boundary: a marking that leaves the picture goes on.
    rim = cv2.subtract(mask, cv2.erode(mask, _cross()))
    on_rim = np.flatnonzero(rim.reshape(-1))
    of_rim = flat[on_rim]
    boundary = np.maximum(np.bincount(of_rim, minlength=count), 1).astype(np.float64)
    # A strip of length l and thickness t has the area l t and, for t > 1, a boundary of about 2 l pixels.
    thickness_px = np.maximum(2.0 * area / boundary, 1.0)
    elongation = boundary * boundary / (4.0 * area)
    good = (area >= settings.least_area_px) & (elongation >= settings.least_elongation)
    gx, gy = dx.reshape(-1)[on_rim].astype(np.float32), dy.reshape(-1)[on_rim].astype(np.float32)
    gradient = np.bincount(of_rim, np.sqrt(gx * gx + gy * gy), count) / boundary
    good &= gradient >= settings.least_sharpness * _SOBEL_GAIN * threshold
    if cm_per_px is not None:
        mean_scale = np.bincount(of_rim, cm_per_px.reshape(-1)[on_rim], count) / boundary
        good &= ~(thickness_px * mean_scale > settings.thickest_cm)
    good[0] = False
    if not good.any():
        return None
    if good[1:].all():
        return mask
    kept = np.zeros_like(mask)
    kept.reshape(-1)[inside[good[of_inside]]] = 255
    return kept


def _thickest_px(thickest_cm: float, scale: PixelScale | None, height: int, width: int) -> np.ndarray:
    """Pixels that the thickest marking spans in each row, with a margin for its slope."""
    if scale is None:
        return np.full(height, width / 8.0)
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(1.5 * thickest_cm / scale.row_cm_per_px, nan=_KERNELS_PX[0])


def _rows_in_use(keep: np.ndarray | None, height: int) -> tuple[int, int]:
    if keep is None:
        return 0, height
    rows = np.flatnonzero(keep.any(axis=1))
    if rows.size == 0:
        return 0, 0
    # A margin, so that the border's reflection does not reach the useful rows.
    return max(0, int(rows[0]) - 4), min(height, int(rows[-1]) + 5)


def _square(side: int) -> np.ndarray:
    return np.ones((side, side), np.uint8)


def _cross() -> np.ndarray:
    return np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
