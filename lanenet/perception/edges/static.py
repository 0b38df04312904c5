"""What stays in place in the image while the car drives: the car itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.errors import DriveFormatError
from lanenet.perception.edges.canny import EdgeSettings, to_gray

#: Least mean difference to the last used frame, [gray levels]; below, both show the same place. Chosen: above
#: the noise of a camera that stands still.
_LEAST_CHANGE = 4.0
#: Fewest different frames. Chosen: by chance an edge of the road is in 70 % of 20 frames only if it hardly
#: moves.
_LEAST_FRAMES = 20
#: An edge in at least this share of the frames belongs to the car. Chosen: blur and reflections hide it in
#: some.
_STATIC_SHARE = 0.7
#: What never moves but covers a larger share of the rows is not taken for the car; it may be a lane that the
#: car follows without a bend. Chosen.
_MAX_CAR_SHARE = 0.2
#: Share of the rows, from the bottom, in which the car is searched. Chosen: twice the share above.
_CAR_SHARE = 0.4
#: Frames, spread over a drive, that are enough. Chosen: more than seven times the fewest.
_ENOUGH_FRAMES = 150


#: Gray level that no pixel outside the image circle of a lens reaches, in any frame; side of the patches that
#: are looked at there, and share of the inner half of the image that is brighter. Chosen: above the noise of
#: black.
_BLACK, _PATCH_SHARE, _BRIGHT_SHARE = 24, 0.05, 0.95


@dataclass(frozen=True, eq=False)
class StaticPart:
    """What never moves at the bottom of a drive's frames.

    Attributes:
        mask: 255 on it, 0 elsewhere.
        rows: Rows at or below the highest one that it touches; 0 if everything moves.
    """

    mask: UInt8[np.ndarray, "h w"]
    rows: int

    @property
    def is_too_high(self) -> bool:
        """Whether it covers more rows than are taken for the car."""
        return self.rows > _MAX_CAR_SHARE * self.mask.shape[0]


def spread_frames(count: int) -> range:
    """Return which of a drive's ``count`` frames to look at."""
    return range(0, count, max(1, count // _ENOUGH_FRAMES))


def lens_circle_px(frames: Iterable[UInt8[np.ndarray, "h w *c"]]) -> float | None:
    """Radius of the circle that a full-circle fisheye shows; None if the images are filled to both sides.

    Args:
        frames: Frames from all over a drive, all of one size.
    """
    brightest = None
    for frame in frames:
        # Blurred, so that the noise of single pixels does not count.
        gray = cv2.blur(to_gray(frame), (3, 3))
        brightest = gray if brightest is None else np.maximum(brightest, gray)
    if brightest is None:
        return None
    height, width = brightest.shape
    lit, patch = brightest > _BLACK, max(2, round(_PATCH_SHARE * width))
    top, bottom, middle = slice(0, patch), slice(height - patch, height), (height - patch) // 2
    left, right = slice(0, patch), slice(width - patch, width)
    rows = (top, slice(middle, middle + patch), bottom)
    if any(lit[row, column].any() for row in rows for column in (left, right)):
        return None
    inner = lit[height // 4 : -(height // 4), width // 4 : -(width // 4)]
    return float(np.sqrt(lit.sum() / np.pi)) if inner.mean() > _BRIGHT_SHARE else None


def find_static(frames: Iterable[UInt8[np.ndarray, "h w *c"]]) -> StaticPart:
    """Find the car's own parts, and how high they reach; as :func:`static_mask`."""
    mask = static_mask(frames)
    touched = np.flatnonzero(mask.any(axis=1))
    return StaticPart(mask, mask.shape[0] - int(touched[0]) if touched.size else 0)


def static_mask(frames: Iterable[UInt8[np.ndarray, "h w *c"]]) -> UInt8[np.ndarray, "h w"]:
    """Find the car's own parts at the bottom of a drive's frames.

    Edges that stay in place, to a pixel, in most frames of a moving car belong to the car. Where they are
    connected to the lower border, everything below them is the car too.

    Args:
        frames: Frames from all over a drive, best about a hundred; standing still does no harm.

    Returns:
        255 on the car, 0 elsewhere; all 0 if nothing at the bottom stays in place.

    Raises:
        DriveFormatError: If frames differ in size, or fewer than 20 of them differ in content.

    Source:
        Own derivation; checked on synthetic drives in ``tests/unit/perception/test_static.py``.
    """
    counts: np.ndarray | None = None
    last: np.ndarray | None = None
    used = seen = 0
    near = np.ones((3, 3), np.uint8)
    plain = EdgeSettings()
    for seen, frame in enumerate(frames, start=1):
        gray = to_gray(frame)
        if counts is None:
            counts = np.zeros(gray.shape, np.int32)
        if gray.shape != counts.shape:
            raise DriveFormatError(
                f"frame {seen - 1}: {gray.shape[1]}x{gray.shape[0]} px, but the first frame has "
                f"{counts.shape[1]}x{counts.shape[0]}"
            )
        if last is not None and cv2.absdiff(gray, last).mean() < _LEAST_CHANGE:
            continue
        last = gray
        edges = cv2.Canny(cv2.GaussianBlur(gray, (3, 3), 0), plain.low, plain.high, L2gradient=True)
        counts += cv2.dilate(edges, near) > 0
        used += 1
    if counts is None or used < _LEAST_FRAMES:
        raise DriveFormatError(
            f"{used} of {seen} frames show something new, but {_LEAST_FRAMES} are needed to tell the car "
            "from the road: give frames of a moving car"
        )
    static = np.where(counts >= _STATIC_SHARE * used, 255, 0).astype(np.uint8)
    height = static.shape[0]
    static[: round((1.0 - _CAR_SHARE) * height)] = 0
    return _down_to_the_border(static)


def _down_to_the_border(static: np.ndarray) -> np.ndarray:
    """Keep what reaches the lowest rows, with everything below it."""
    height = static.shape[0]
    # Gaps of a few pixels between the car's edges belong to it.
    reach = max(3, height // 24) | 1
    closed = cv2.morphologyEx(
        cv2.copyMakeBorder(static, 0, reach, 0, 0, cv2.BORDER_CONSTANT, value=255),
        cv2.MORPH_CLOSE,
        np.ones((reach, reach), np.uint8),
    )
    _, labels = cv2.connectedComponents(closed, connectivity=8)
    car = (labels == labels[-1, 0])[:height] & (closed[:height] > 0)
    car = np.maximum.accumulate(car, axis=0) if car.any() else car
    mask = np.where(car, 255, 0).astype(np.uint8)
    # One pixel more, since the blur of an edge reaches beyond it.
    return cv2.dilate(mask, np.ones((3, 3), np.uint8)) if car.any() else mask
