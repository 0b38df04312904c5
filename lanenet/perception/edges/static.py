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
