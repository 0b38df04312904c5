"""Edges of lane markings only: strips brighter or yellower than the road beside them, chosen by their shape.

White is found in the lightness of Lab; every other colour of tape is an entry of :data:`COLOURS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.perception.edges.pixels import EdgePixels, edge_pixels, gradients

#: Sobel response of a step of one gray level, without blur: the kernel's weights on one side, 1 + 2 + 1.
SOBEL_GAIN = 4.0
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
#: Sides of the top-hat's square, [px]; each row takes the one nearest to the widest marking. Chosen: steps of
#: about 1.9, so that few squares serve all rows and each is at most 1.4 times too wide or too narrow.
_KERNELS_PX = (9, 17, 31, 59)
_KERNEL_LIMITS_PX = np.sqrt(np.multiply(_KERNELS_PX[:-1], _KERNELS_PX[1:]))
#: Least gradient of an edge, as a share of that of a sharp step as high as the threshold; chosen: the share
#: that the blur of 3 px (1 2 1) leaves.
_EDGE_SHARE = 0.5
#: Lab's L (0-255) of a gray level; for colours, of their luma.
_LIGHTNESS = cv2.cvtColor(np.arange(256, dtype=np.uint8).repeat(3).reshape(1, 256, 3), cv2.COLOR_BGR2Lab)[
    ..., 0
].reshape(-1)


class ColourSettings(Settings):
    """What counts as a marking; thresholds follow the frame's own contrast down to the given floors.

    With the defaults the three tubs keep 60 to 77 % of the edge points of ``directional``. Half or double the
    floors changes that by at most 10 %, since there the contrast of the frame sets the threshold; the floors
    keep noise out of frames without markings.

    Attributes:
        markings: ``light`` markings on a darker road, ``dark`` ones on a lighter road, or ``both``.
        thickest_cm: Thickest marking.
        white_floor: Smallest response that counts, in levels of Lab's L (0-255): brighter than the road
            beside.
        yellow_floor: The same in levels of Lab's b (0-255): yellower than the road beside.
        contrast_share: The threshold is at least this share of the 99th percentile of the responses.
        least_area_px: Smaller components are dropped.
        least_elongation: Least length over thickness, from the boundary; a disk has 3, a square 4.
        least_sharpness: Least mean gradient on a component's boundary, as a share of that of a sharp step of
            its contrast.
        yellow: Look for yellow at all.
    """

    markings: Literal["light", "dark", "both"] = "light"
    thickest_cm: float = Field(default=7.0, gt=0.0)
    white_floor: int = Field(default=12, ge=1, le=255)
    yellow_floor: int = Field(default=8, ge=1, le=255)
    contrast_share: float = Field(default=0.35, ge=0.0, lt=1.0)
    least_area_px: int = Field(default=8, ge=1)
    least_elongation: float = Field(default=3.5, ge=0.0)
    least_sharpness: float = Field(default=0.25, ge=0.0, le=1.0)
    yellow: bool = True


@dataclass(frozen=True)
class MarkingColour:
    """A colour of tape: a channel of Lab that rises or falls towards it.

    Attributes:
        channel: 1 for a (green to red), 2 for b (blue to yellow).
        floor: Smallest response that counts, from the settings; None where they leave the colour out.
        falls: The channel falls towards the colour.
    """

    channel: Literal[1, 2]
    floor: Callable[[ColourSettings], int | None]
    falls: bool = False


#: Colours beside white. A new one is an entry here and the setting that its floor reads.
COLOURS = {"yellow": MarkingColour(2, lambda settings: settings.yellow_floor if settings.yellow else None)}


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
    """Find the edges of white and coloured markings, with the gradient of the channel that shows them.

    Args:
        frame_bgr: Colour or gray image (gray: white markings only).
        settings: What counts as a marking.
        blur_px: Gauss kernel before the gradient.
        keep: Mask of pixels that may be edges (0 elsewhere).
        scale: Road per pixel; without it the sizes are those of a camera that shows the thickest marking
            with an eighth of the image's width, and thickness is not checked.

    Returns:
        Sub-pixel edge points; the normal points to the brighter, or more coloured, side.

    Source:
        Own derivation. Top-hat: Serra 1982; thickness and length of a strip from its area and boundary.
    """
    height, width = frame_bgr.shape[:2]
    top, bottom = _rows_in_use(keep, scale, height)
    if bottom - top < 3 or width < 3:
        return EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
    part = frame_bgr[top:bottom]
    keep_part = None if keep is None else keep[top:bottom]
    row_px = _thickest_px(settings.thickest_cm, scale, height, width)[top:bottom]
    cm_per_px = None if scale is None else scale.cm_per_px[top:bottom]

    gray = part if part.ndim == 2 else cv2.cvtColor(part, cv2.COLOR_BGR2GRAY)
    light = cv2.LUT(gray, _LIGHTNESS)
    dx, dy = gradients(light, blur_px)
    white = _strips(light, settings.white_floor, settings, settings.markings, row_px)
    kept = np.zeros_like(light)
    found: list[EdgePixels] = []
    for coloured in _coloured_strips(part, settings, row_px) if part.ndim == 3 else ():
        # The camera and JPEG store colour at half the resolution: where brightness shows the marking at all,
        # it places the edge better.
        shapes = measure_components(_only(coloured.mask, keep_part), cm_per_px)
        shown = shapes.boundary_step(dx, dy) >= _EDGE_SHARE * white.level
        good = _marking_shaped(shapes, settings)
        kept = cv2.bitwise_or(kept, shapes.paint(good & shown))
        if np.any(good & ~shown):
            size = (light.shape[1], light.shape[0])
            c_dx, c_dy = gradients(cv2.resize(coloured.channel, size), blur_px)
            contrast = shapes.mean(cv2.resize(coloured.response, size))
            faint = good & ~shown
            faint &= shapes.boundary_step(c_dx, c_dy) >= settings.least_sharpness * contrast
            found.append(_edges_around(shapes.paint(faint), c_dx, c_dy, coloured.level, keep_part))
            good = faint | (good & shown)
        # A coloured marking is not a white one as well.
        white.mask[...] = cv2.subtract(white.mask, cv2.dilate(shapes.paint(good), _square(7)))
    shapes = measure_components(_only(white.mask, keep_part), cm_per_px)
    good = _marking_shaped(shapes, settings)
    good &= shapes.boundary_step(dx, dy) >= settings.least_sharpness * shapes.mean(white.response)
    kept = cv2.bitwise_or(kept, shapes.paint(good))
    found.append(_edges_around(kept, dx, dy, white.level, keep_part))
    uv = np.concatenate([edges.uv_px for edges in found])
    uv[:, 1] += top
    return EdgePixels(uv, np.concatenate([edges.normals for edges in found]))


@dataclass(frozen=True, eq=False)
class _Strips:
    """Thin parts of a channel that rise above their surroundings.

    Attributes:
        channel: The channel.
        mask: 255 where the response exceeds the threshold; may be empty.
        response: Prominence of each pixel, in levels of the channel.
        level: The threshold.
    """

    channel: np.ndarray
    mask: np.ndarray
    response: np.ndarray
    level: float


def _coloured_strips(part: np.ndarray, settings: ColourSettings, row_px: np.ndarray) -> list[_Strips]:
    """Find the strips of each colour that the settings ask for; colours without any are left out.

    The work is done at half the resolution, since cameras and JPEG store colour no finer. Only the mask is
    enlarged again.
    """
    wanted = [(colour, floor) for colour in COLOURS.values() if (floor := colour.floor(settings)) is not None]
    if not wanted:
        return []
    height, width = part.shape[:2]
    half = cv2.resize(part, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(half, cv2.COLOR_BGR2Lab)
    found = []
    for colour, floor in wanted:
        channel = cv2.extractChannel(lab, colour.channel)
        if colour.falls:
            channel = cv2.bitwise_not(channel)
        strips = _strips(channel, floor, settings, "light", 0.5 * row_px[::2])
        if cv2.countNonZero(strips.mask):
            mask = cv2.resize(strips.mask, (width, height), interpolation=cv2.INTER_NEAREST)
            found.append(replace(strips, mask=mask))
    return found


def _strips(
    channel: np.ndarray, floor: int, settings: ColourSettings, markings: str, row_px: np.ndarray
) -> _Strips:
    """Find the strips of one channel, with a threshold that follows the frame's contrast."""
    response = _thin_response(channel, markings, row_px)
    counts = np.bincount(response[::3, ::3].ravel(), minlength=256).cumsum()
    strong = int(np.searchsorted(counts, 0.99 * counts[-1]))
    level = max(float(floor), settings.contrast_share * strong)
    mask = cv2.threshold(response, level, 255, cv2.THRESH_BINARY)[1]
    return _Strips(channel, mask, response, level)


def _thin_response(channel: np.ndarray, markings: str, row_px: np.ndarray) -> np.ndarray:
    """Top-hat (light), bottom-hat (dark) or the larger of both; the square grows with the road's scale."""
    sides = np.asarray(_KERNELS_PX)[np.searchsorted(_KERNEL_LIMITS_PX, row_px)]
    response = np.zeros_like(channel)
    starts = np.flatnonzero(np.diff(sides, prepend=-1)).tolist()
    for start, stop in pairwise([*starts, len(sides)]):
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


@dataclass(frozen=True, eq=False)
class Components:
    """Connected components of a mask by label; label 0 is the background, its measures mean nothing.

    Attributes:
        shape: Rows and columns of the mask.
        inside: Flat indices of the components' pixels.
        of_inside: Their labels.
        on_rim: Flat indices of the boundary pixels, without those on the image border, where a strip
            continues unseen.
        of_rim: Their labels.
        area: Pixels of each component.
        rim: Boundary pixels of each component, at least 1.
        elongation: Length over thickness, from the outline with the image border: a disk has 3, a
            square 4, a strip twice as long as thick 4.5.
        thickness_cm: On the road, [cm]; NaN where unknown.
    """

    shape: tuple[int, int]
    inside: Int[np.ndarray, "p"]
    of_inside: Int[np.ndarray, "p"]
    on_rim: Int[np.ndarray, "b"]
    of_rim: Int[np.ndarray, "b"]
    area: Int[np.ndarray, "k"]
    rim: Int[np.ndarray, "k"]
    elongation: Float[np.ndarray, "k"]
    thickness_cm: Float[np.ndarray, "k"]

    def boundary_step(self, dx: Int16[np.ndarray, "h w"], dy: Int16[np.ndarray, "h w"]) -> np.ndarray:
        """Return the mean gradient on each boundary, as the height of a sharp step in gray levels."""
        gx = dx.reshape(-1).take(self.on_rim).astype(np.float32)
        gy = dy.reshape(-1).take(self.on_rim).astype(np.float32)
        total = np.bincount(self.of_rim, np.sqrt(gx * gx + gy * gy), len(self.rim))
        return total / (SOBEL_GAIN * self.rim)

    def mean(self, image: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "k"]:
        """Return the mean of an image over each component."""
        return np.bincount(self.of_inside, image.reshape(-1).take(self.inside), len(self.area)) / self.area

    def paint(self, chosen: Bool[np.ndarray, "k"]) -> UInt8[np.ndarray, "h w"]:
        """Return a mask of the chosen components."""
        mask = np.zeros(self.shape, np.uint8)
        mask.reshape(-1)[self.inside[chosen.take(self.of_inside)]] = 255
        return mask


def measure_components(
    mask: UInt8[np.ndarray, "h w"], cm_per_px: Float[np.ndarray, "h w"] | None = None
) -> Components:
    """Label the components of a mask (8-connected) and measure them.

    Args:
        mask: 255 inside, 0 elsewhere.
        cm_per_px: Road per pixel, for the thickness.

    Returns:
        The components.

    Source:
        Own derivation: a strip of length l and thickness t has the area l t and a boundary of about 2 l.
    """
    kind = cv2.CV_16U if mask.size < 4 * 65535 else cv2.CV_32S
    count, labels = cv2.connectedComponents(mask, connectivity=8, ltype=kind)
    flat = labels.reshape(-1)
    inside = np.flatnonzero(mask.reshape(-1) != 0)
    of_inside = flat.take(inside).astype(np.intp)
    # The background has no pixels here; 1 avoids a division by zero.
    area = np.maximum(np.bincount(of_inside, minlength=count), 1)
    boundary = cv2.erode(mask, _CROSS).reshape(-1).take(inside) == 0
    on_rim, of_rim = inside[boundary], of_inside[boundary]
    rim = np.maximum(np.bincount(of_rim, minlength=count), 1)
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    # The boundary counts each corner once; four more give small and large squares the same elongation.
    outline = rim + np.bincount(border, minlength=count) + 4.0
    thickness_cm = np.full(count, np.nan)
    if cm_per_px is not None:
        scale = np.bincount(of_rim, cm_per_px.reshape(-1)[on_rim], count) / rim
        thickness_cm = np.maximum(2.0 * area / rim, 1.0) * scale
    shape = (mask.shape[0], mask.shape[1])
    elongation = outline * outline / (4.0 * area)
    return Components(shape, inside, of_inside, on_rim, of_rim, area, rim, elongation, thickness_cm)


def _marking_shaped(shapes: Components, settings: ColourSettings) -> np.ndarray:
    """Tell which components are large, long and thin."""
    return (
        (shapes.area >= settings.least_area_px)
        & (shapes.elongation >= settings.least_elongation)
        & ~(shapes.thickness_cm > settings.thickest_cm)
        & (np.arange(len(shapes.area)) > 0)
    )


def _edges_around(
    mask: np.ndarray, dx: np.ndarray, dy: np.ndarray, level: float, keep: np.ndarray | None
) -> EdgePixels:
    """Edges of a channel that belong to the components of a mask."""
    high = _EDGE_SHARE * SOBEL_GAIN * level
    edges = cv2.Canny(dx, dy, 0.5 * high, high, L2gradient=True)
    cv2.bitwise_and(edges, cv2.dilate(mask, _square(3)), dst=edges)
    return edge_pixels(_only(edges, keep), dx, dy, subpixel=True)


def _thickest_px(thickest_cm: float, scale: PixelScale | None, height: int, width: int) -> np.ndarray:
    """Pixels that the thickest marking spans in each row."""
    if scale is None:
        return np.full(height, width / 8.0)
    return np.where(np.isfinite(scale.row_cm_per_px), thickest_cm / scale.row_cm_per_px, _KERNELS_PX[0])


def _rows_in_use(keep: np.ndarray | None, scale: PixelScale | None, height: int) -> tuple[int, int]:
    if keep is None:
        return 0, height
    rows = np.flatnonzero(keep.any(axis=1) if scale is None else np.isfinite(scale.row_cm_per_px))
    if rows.size == 0:
        return 0, 0
    # A margin, so that the border's reflection does not reach the useful rows.
    return max(0, int(rows[0]) - 4), min(height, int(rows[-1]) + 5)


def _square(side: int) -> np.ndarray:
    return np.ones((side, side), np.uint8)


def _only(mask: np.ndarray, keep: np.ndarray | None) -> np.ndarray:
    """Clear a mask in place where ``keep`` is zero."""
    return mask if keep is None else cv2.bitwise_and(mask, keep, dst=mask)
