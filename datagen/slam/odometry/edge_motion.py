"""Whether the edges of an image moved since the one before it, however little of the image has edges.

On a bare floor the mean change of an image says little of the car's motion: a pale sheet shows next to
nothing that could change. The strongest edges of the image tell, be they only stains.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lanenet.perception.edges.canny import to_gray

#: Width at which images are compared, [px]: that of a Donkeycar tub.
_WIDTH = 160
#: Share of the pixels that count as edges, the strongest. Chosen: a blank sheet with one line has as many.
_STRONGEST = 0.03
#: Pixels about which brightness is compared: exposure and white balance change more slowly, [px].
_AROUND_PX = 25
#: Shift of the tenth of the edges that moves most, beyond which the car moves, [px]: edges along the path of
#: a moving car stay where they are, and so does the car's own bumper. Measured on neighbouring images: at
#: most 0.44 while the cars of ``blue_tape`` and ``usi_mat`` stand (50 frames), and more on 66 of the 71
#: frames in which the former rolls over a bare sheet and hardly changes its image.
_MOVED_PX = 0.45
#: Times that the change at the edges exceeds that of the whole image where something moves: noise changes
#: all pixels alike. Chosen.
_ABOVE_NOISE = 2.0
#: Least gradient of an edge, [gray levels per px].
_LEAST_GRADIENT = 1.0


def edges_moved(before: UInt8[np.ndarray, "h w *c"], after: UInt8[np.ndarray, "h w *c"]) -> bool:
    """Tell whether the strongest edges lie elsewhere in the second of two images of the same size.

    A small shift changes an edge by its gradient times the shift across it; noise changes all pixels alike.

    Args:
        before: An image, colour or gray.
        after: The next one.
    """
    change, slope, strong = _change_at_edges(before, after)
    if not strong.any():
        return False
    at_edges, everywhere = np.quantile(change[strong], 0.9), np.quantile(change, 0.9)
    return _shift_px(change, slope, strong) > _MOVED_PX and bool(at_edges > _ABOVE_NOISE * everywhere)


def edge_shift_px(before: UInt8[np.ndarray, "h w *c"], after: UInt8[np.ndarray, "h w *c"]) -> float:
    """Return the shift of the tenth of the strongest edges that moves most, up to about their width.

    Args:
        before: An image, colour or gray.
        after: The next one.

    Returns:
        In pixels of an image 160 px wide; NaN without an edge.
    """
    change, slope, strong = _change_at_edges(before, after)
    return _shift_px(change, slope, strong) if strong.any() else float("nan")


def _shift_px(
    change: Float32[np.ndarray, "h w"], slope: Float32[np.ndarray, "h w"], strong: Bool[np.ndarray, "h w"]
) -> float:
    return float(np.quantile(change[strong] / slope[strong], 0.9))


def _change_at_edges(
    before: UInt8[np.ndarray, "h w *c"], after: UInt8[np.ndarray, "h w *c"]
) -> tuple[Float32[np.ndarray, "h2 w2"], Float32[np.ndarray, "h2 w2"], Bool[np.ndarray, "h2 w2"]]:
    """Change of brightness and slope at each pixel of two images, and where the strongest edges are."""
    first, second = _without_light(before), _without_light(after)
    middle = 0.5 * (first + second)
    # Sobel's kernel adds up to eight times the slope.
    slope = np.hypot(cv2.Sobel(middle, cv2.CV_32F, 1, 0), cv2.Sobel(middle, cv2.CV_32F, 0, 1)) / 8.0
    strong = slope >= max(float(np.quantile(slope, 1.0 - _STRONGEST)), _LEAST_GRADIENT)
    return np.abs(first - second), slope, strong


def _without_light(image: UInt8[np.ndarray, "h w *c"]) -> Float32[np.ndarray, "h2 w2"]:
    """Return an image in gray, at the width of a comparison, relative to the brightness around each pixel."""
    gray = to_gray(image)
    height = round(gray.shape[0] * _WIDTH / gray.shape[1])
    small = cv2.resize(gray, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (3, 3), 0).astype(np.float32)
    return np.asarray(smooth - cv2.blur(smooth, (_AROUND_PX, _AROUND_PX)))
