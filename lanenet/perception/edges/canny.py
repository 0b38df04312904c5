"""The three edge detectors, and the checks of a frame that come first."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int, Int16, UInt8
from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.errors import CalibrationError, DriveFormatError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges import compiled
from lanenet.perception.edges.markings_only import ColourSettings, PixelScale, colour_edges
from lanenet.perception.edges.pixels import EdgePixels, Slopes, edge_pixels, gradients, prefer_stronger

# Channels of BGR; gray is mostly green.
_BLUE, _RED = 0, 2
#: In a dim or soft frame, the upper threshold is at most the first times its least share of the strong
#: responses, but no lower than the second times its setting, and the third times the median response. Chosen:
#: no frame with sharp tape is changed, as on the three tubs; noise exceeds five medians once in 30 million.
_DIM, _LEAST_RAISED, _CLEAR = 2.0, 0.5, 5.0


class EdgeSettings(Settings):
    """How edges are found in a frame.

    ``canny`` is the paper's detector: fixed thresholds, whole pixels. ``directional`` raises the thresholds
    with the contrast of the frame, so that soft reflections of lamps fall below them where the tape is
    bright; lowers them in dim or soft frames, where the tape would fall below them; and moves each edge along
    its gradient to the sub-pixel maximum. With a colour weight it also finds yellow tape on a floor of the
    same brightness. ``colour`` finds strips that are brighter or yellower than the road beside them, drops
    those that are too thick, too round or too soft for a marking, and returns the sub-pixel edges of the
    rest.

    Attributes:
        method: The detector.
        blur_px: Size of the Gauss kernel; 0 for none.
        low: Lower threshold of the hysteresis on Sobel responses. Chosen: a step of 10 gray levels. Half of
            both thresholds adds 0 to 3 % of edge points on the three tubs, double drops 10 to 38 %.
        high: Upper threshold; chosen: a step of 20 gray levels.
        contrast_share: ``directional``: the upper threshold is at least this share of the 99th percentile of
            the frame's Sobel responses; the lower one keeps its ratio. On the three tubs it drops 2 to 14 %
            of edge points, which are soft reflections; half of it drops none, double 34 to 46 %. 0 fixes the
            thresholds.
        colour_weight: ``directional``: where the Sobel response of yellow or red, times this, exceeds that of
            gray, it takes its place; 0 uses gray alone, as maps do. Below 1, since images store colour more
            coarsely than brightness.
        colour: ``colour``: what counts as a marking.
    """

    method: Literal["canny", "directional", "colour"] = "directional"
    blur_px: Literal[0, 3, 5] = 3
    low: float = Field(default=40.0, gt=0.0)
    high: float = Field(default=80.0, gt=0.0)
    contrast_share: float = Field(default=0.3, ge=0.0, lt=1.0)
    colour_weight: float = Field(default=0.0, ge=0.0, le=1.0)
    colour: ColourSettings = ColourSettings()

    @model_validator(mode="after")
    def _check_order(self) -> EdgeSettings:
        if self.low > self.high:
            raise ValueError(f"expected low at most high, found {self.low:g} above {self.high:g}")
        return self


def find_edges(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    settings: EdgeSettings,
    keep: UInt8[np.ndarray, "h w"] | None = None,
    scale: PixelScale | None = None,
    sample: Int[np.ndarray, " n"] | None = None,
) -> EdgePixels:
    """Find the edge points of a frame.

    Args:
        frame_bgr: Colour or gray image.
        settings: The detector and its thresholds (of OpenCV's Canny, on Sobel responses).
        keep: Mask of pixels that may be edges (0 elsewhere).
        scale: Road per pixel, for ``colour``; without it the filters by centimetres are left out.
        sample: Result of :func:`sample_pixels` for ``keep``, which callers with many frames compute once.

    Returns:
        Edge points with directions; empty when the frame has none.

    Source:
        Canny 1986; sub-pixel step: parabola through the gradient magnitude at the edge and at its two
        neighbours along the gradient (Devernay 1995).
    """
    if settings.method == "colour":
        return colour_edges(check_frame(frame_bgr), settings.colour, settings.blur_px, keep, scale)
    directional = settings.method == "directional"
    if directional and sample is None:
        sample = sample_pixels(np.ones(check_frame(frame_bgr).shape[:2], np.uint8) if keep is None else keep)
    if compiled.finds_in(check_frame(frame_bgr)):
        return compiled.find(frame_bgr, keep, sample, search_of(settings))
    gray = to_gray(frame_bgr)
    dx, dy = gradients(gray, settings.blur_px)
    raised = 1.0
    hues: tuple[Slopes, ...] = ()
    if directional:
        if frame_bgr.ndim == 3 and settings.colour_weight > 0.0:
            # Gray minus blue shows yellow, red minus gray red; white, gray and black have neither. Both
            # rise towards the inside of yellow tape, as brightness does for white tape, so that normals mean
            # the same. White tape on a yellow floor may get normals that point to the floor.
            channels = (cv2.extractChannel(frame_bgr, channel) for channel in (_BLUE, _RED))
            blue, red = (gradients(channel, settings.blur_px) for channel in channels)
            hues = (dx - blue[0], dy - blue[1]), (red[0] - dx, red[1] - dy)
            for hue_dx, hue_dy in hues:
                prefer_stronger(dx, dy, hue_dx, hue_dy, settings.colour_weight, settings.low)
        if settings.contrast_share > 0.0 and sample is not None:
            usual, strong = _responses(dx, dy, sample) / settings.high
            relative = settings.contrast_share * strong
            raised = max(relative, min(1.0, max(_DIM * relative, _LEAST_RAISED, _CLEAR * usual)))
    edges = cv2.Canny(dx, dy, raised * settings.low, raised * settings.high, L2gradient=True)
    if keep is not None:
        cv2.bitwise_and(edges, keep, dst=edges)
    return edge_pixels(edges, dx, dy, subpixel=directional, hues=hues)


def search_of(settings: EdgeSettings) -> compiled.Search:
    """Return the settings as the compiled loops take them."""
    directional = settings.method == "directional"
    return compiled.Search(
        settings.blur_px,
        settings.low,
        settings.high,
        settings.colour_weight if directional else 0.0,
        settings.contrast_share if directional else 0.0,
        directional,
        (_DIM, _LEAST_RAISED, _CLEAR),
    )


def sample_pixels(keep: UInt8[np.ndarray, "h w"]) -> Int[np.ndarray, " n"]:
    """Return the flat indices of every third pixel of every third row, as far as it is kept."""
    v, u = np.nonzero(keep[::3, ::3])
    return np.asarray(3 * (v * keep.shape[1] + u))


def _responses(
    dx: Int16[np.ndarray, "h w"], dy: Int16[np.ndarray, "h w"], sample: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "2"]:
    """Median and 99th percentile of the Sobel magnitude over a sample of the pixels."""
    if sample.size == 0:
        return np.zeros(2)
    wide_x = dx.reshape(-1).take(sample).astype(np.int32)
    wide_y = dy.reshape(-1).take(sample).astype(np.int32)
    squared = wide_x * wide_x + wide_y * wide_y
    ranks = [(squared.size - 1) // 2, int(0.99 * (squared.size - 1))]
    squared.partition(ranks)
    return np.sqrt(squared[ranks])


def to_gray(frame_bgr: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w"]:
    """Return the frame as gray uint8.

    Raises:
        DriveFormatError: If the array is not an image of one or three uint8 channels.
    """
    frame = check_frame(frame_bgr)
    return frame if frame.ndim == 2 else np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))


def check_frame(frame_bgr: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w *c"]:
    """Return the frame if it is an image.

    Raises:
        DriveFormatError: If the array is not an image of one or three uint8 channels.
    """
    # A camera that has stopped returns None.
    if not isinstance(frame_bgr, np.ndarray):
        raise DriveFormatError(
            f"frame: expected a uint8 image (h, w) or (h, w, 3), found {type(frame_bgr).__name__}"
        )
    if frame_bgr.dtype != np.uint8 or frame_bgr.ndim not in (2, 3) or frame_bgr.size == 0:
        raise DriveFormatError(
            f"frame: expected a uint8 image (h, w) or (h, w, 3), found {frame_bgr.dtype} {frame_bgr.shape}"
        )
    if frame_bgr.ndim == 3 and frame_bgr.shape[2] != 3:
        raise DriveFormatError(f"frame: expected 3 channels (BGR), found {frame_bgr.shape[2]}")
    return frame_bgr


def check_size(frame_bgr: UInt8[np.ndarray, "h w *c"], camera: Camera | None) -> None:
    """Refuse a frame that is not of the camera's size; without a camera any size will do.

    Raises:
        CalibrationError: With both sizes.
    """
    height, width = frame_bgr.shape[:2]
    if camera is not None and (width, height) != (camera.width, camera.height):
        raise CalibrationError(
            f"frame of {width}x{height} px, but the camera is calibrated for {camera.width}x{camera.height}"
        )
