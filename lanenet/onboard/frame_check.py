"""Frames that must not be used: missing, late, from another clock, or of a camera that hangs."""

from __future__ import annotations

import math
import zlib

import numpy as np
from jaxtyping import Bool, UInt8, UInt32

from lanenet.onboard.devices import Frame
from lanenet.onboard.safety import SafetySettings

#: A frame time further ahead than this comes from another clock; chosen: more than rounding, less than two
#: frames.
_MAX_AHEAD_S = 0.05
#: Frames that are remembered; chosen: more than the buffers of any driver, a second at 30 frames/s.
_FRAMES = 32
#: Rows and columns of tiles into which the lower half of an image is divided: that half shows road with every
#: camera that can steer. Chosen: a clock, or a strip that is still alive, covers less than half of them.
_ROWS, _COLUMNS = 4, 8
#: A tile is proof if at least this share of its pixels differ from their neighbours. Measured on the lower
#: half of frames of four recorded cars: 0.25 to 0.9, below 0.4 in 1 % of their bands. A smooth floor whose
#: noise JPEG compression removes has less than 0.1; its bands repeat by chance.
_LEAST_TEXTURE = 0.4
#: The camera hangs if this share of the tiles that are proof repeat one earlier frame, and this many. At
#: half, 30 of 13,020 frames of a standing camera were taken for repeats (160x120, denoised, JPEG quality 50);
#: at this share none of 6,240, and every clock of up to 20 px is noticed at 160x120 without compression.
_FROZEN_SHARE, _LEAST_TILES = 0.65, 6


class FrameCheck:
    """Finds frames that must not be used: missing, late, from another clock, or repeated."""

    def __init__(self, settings: SafetySettings) -> None:
        """Take the limits; no frame has been seen."""
        self._settings = settings
        self._repeats, self._lap = RepeatCheck(), 0

    def fault_of(self, frame: Frame | None, now_s: float) -> str:
        """Return what is wrong with a frame; empty if nothing is."""
        if frame is None:
            return "no frame from the camera"
        if frame.lap != self._lap:
            # A short recording in a loop is no camera that hangs.
            self._repeats, self._lap = RepeatCheck(), frame.lap
        repeated = "" if self._settings.allow_repeated_frames else self._repeats.fault_of(frame.image_bgr)
        age_s = now_s - frame.t_s
        if not math.isfinite(age_s) or age_s < -_MAX_AHEAD_S:
            return f"frame {frame.number} is timed {-age_s:.2f} s ahead of the clock"
        if age_s > self._settings.max_age_s:
            since = "old" if frame.age_known else "old since it arrived"
            return f"frame {frame.number} is {1e3 * age_s:.0f} ms {since}"
        return f"frame {frame.number} {repeated}" if repeated else ""


class RepeatCheck:
    """Finds images of a camera that hangs: a sensor's noise makes every exposure differ from all others.

    An image is repeated if it equals one of the last 32 that were not. So it is if half of the tiles in its
    lower half equal those of one of them, when only the upper rows, a strip or a burnt-in clock still change.
    Tiles without fine texture prove nothing: saturated, black or masked ones never change, and those of a
    smooth floor seldom do after JPEG compression.
    """

    def __init__(self) -> None:
        """Start without a memory of images."""
        self._hashes: UInt32[np.ndarray, "frames parts"] = np.zeros(
            (_FRAMES, 1 + _ROWS * _COLUMNS), np.uint32
        )
        self._count = 0

    def fault_of(self, image_bgr: UInt8[np.ndarray, "h w 3"]) -> str:
        """Return what the image repeats, after its name; empty if it is a new exposure.

        A new exposure is remembered. A repeated image is not: it is found however long the camera hangs.
        """
        parts = _parts(image_bgr)
        hashes = np.array([zlib.crc32(np.ascontiguousarray(part).data) for part in parts], np.uint32)
        equal = self._hashes[: self._count] == hashes
        whole = equal.all(axis=1)
        if whole.any():
            return f"repeats {'the one before' if whole[0] else 'an earlier one'}: the camera hangs"
        if _most_are_frozen(equal[:, 1:], parts[1:]):
            return "repeats the road of an earlier one: the camera hangs"
        self._hashes = np.roll(self._hashes, 1, axis=0)
        self._hashes[0] = hashes
        self._count = min(self._count + 1, _FRAMES)
        return ""


def _parts(image_bgr: UInt8[np.ndarray, "h w 3"]) -> list[UInt8[np.ndarray, "_ _w 3"]]:
    """Return the upper half of an image, and the tiles of its lower half."""
    middle = len(image_bgr) // 2
    rows = np.array_split(image_bgr[middle:], _ROWS)
    return [image_bgr[:middle], *(tile for row in rows for tile in np.array_split(row, _COLUMNS, axis=1))]


def _most_are_frozen(
    equal: Bool[np.ndarray, "frames tiles"], tiles: list[UInt8[np.ndarray, "_ _w 3"]]
) -> bool:
    if not equal.size or equal.sum(axis=1).max() < _LEAST_TILES:
        return False
    proof = np.array([_has_texture(tile) for tile in tiles])
    most = int(equal[:, proof].sum(axis=1).max())
    return most >= max(_LEAST_TILES, _FROZEN_SHARE * int(proof.sum()))


def _has_texture(tile_bgr: UInt8[np.ndarray, "rows w 3"]) -> bool:
    """Tell whether a sensor's noise would show in a tile, even after JPEG compression."""
    differs = tile_bgr[:, 1:, 1] != tile_bgr[:, :-1, 1]
    return differs.size > 0 and float(differs.mean()) >= _LEAST_TEXTURE
