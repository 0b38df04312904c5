"""Frames in which the car stands, and places at which it was put down elsewhere, by small pictures alone."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from lanenet.data.drive import Drive
from lanenet.perception.edges import to_gray

SMALL_WIDTH, SMALL_HEIGHT = 24, 18
_AHEAD = 10  # frames over which a car that moves has changed its picture
#: Gray levels; averaged over so large patches, the noise of any camera is below it.
_NOISE = 0.6
#: Share of a drive's usual change below which a picture counts as the same.
_STILL_SHARE = 0.25
#: Correlation of neighbouring pictures below which the second was taken elsewhere.
_ELSEWHERE = 0.35
#: How much more alike the steps before and after it are.
_DIP = 0.35
_EPSILON = 1e-9
_BACK = 4  # frames that a live car looks back
_WATCHED = 300  # frames of a live car whose change counts as usual


def following_frames(drive: Drive, notes: list[str]) -> Drive:
    """Leave out frames that show the same as the one before, and mark breaks that only the pictures tell.

    Args:
        drive: The drive.
        notes: What was found is added, a sentence each.
    """
    small = small_pictures(drive)
    standing, elsewhere = standing_frames(small), put_elsewhere(small)
    if elsewhere.any():
        where = ", ".join(str(number) for number in drive.frames[elsewhere][:5])
        notes.append(f"{elsewhere.sum()} breaks in the pictures, the first before frame {where}")
    drive = replace(drive, breaks=drive.breaks | elsewhere)
    if standing.any():
        notes.append(f"{standing.sum()} frames show the same as the one before, and are left out")
        drive = drive.subset(np.flatnonzero(~standing))
    return drive


def small_pictures(drive: Drive) -> Float32[np.ndarray, "n h w"]:
    """Return every frame as :func:`small_picture`."""
    small = np.empty((len(drive), SMALL_HEIGHT, SMALL_WIDTH), np.float32)
    for k in range(len(drive)):
        small[k] = small_picture(drive, k)
    return small


def small_picture(drive: Drive, k: int) -> UInt8[np.ndarray, "h w"]:
    """Return the drive's k-th frame as :func:`shrink_picture`."""
    return shrink_picture(drive.image(k))


def shrink_picture(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
    """Return a frame in gray, averaged over large patches, gray levels."""
    size = (SMALL_WIDTH, SMALL_HEIGHT)
    return np.asarray(cv2.resize(to_gray(image), size, interpolation=cv2.INTER_AREA))


def standing_frames(small: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Find the frames that show the same as those before them: repeated ones, and those of a car that stands.

    A frame stands where the picture hardly differs from that of the frame before, nor from that of ten frames
    on either side of the step, as compared with what the drive's pictures usually change by in ten frames. A
    crawl changes little from frame to frame, but goes on. The first frame of a stop is kept.

    Args:
        small: See :func:`small_pictures`.
    """
    n = len(small)
    flat = small.reshape(n, -1)
    # A lamp that flickers, or an exposure that drifts, is no motion.
    flat = flat - flat.mean(axis=1, keepdims=True)
    standing = np.zeros(n, dtype=bool)
    if n <= _AHEAD:
        return standing
    step = _change(flat, 1)
    far = _change(flat, _AHEAD)
    limit = max(_NOISE, _STILL_SHARE * float(np.median(far)))
    # The far change before a frame or the one after it is small: at either end of a stop one of them is not.
    before = np.concatenate([np.full(_AHEAD, np.inf), far])
    after = np.concatenate([far, np.full(_AHEAD, np.inf)])
    still = np.minimum(before, after) < limit
    standing[1:] = still[1:] & (step < limit)
    # A picture that was recorded twice: not even the noise differs.
    standing[1:] |= step < _EPSILON
    return standing


class StandingWatch:
    """Tells of each frame as it comes whether the car stands, from what came before alone.

    As :func:`standing_frames`, but nothing is known of the frames to come: the first frames of a stop count
    as driven, so that they have to be few. What the pictures usually change by is that of the last frames in
    which the car drove.
    """

    def __init__(self) -> None:
        self._last: deque[Float32[np.ndarray, "d"]] = deque(maxlen=_BACK)
        self._usual: deque[float] = deque(maxlen=_WATCHED)

    def stands(self, small: UInt8[np.ndarray, "h w"]) -> bool:
        """Take in the next frame's small picture (see :func:`shrink_picture`)."""
        flat = small.astype(np.float32).ravel()
        flat -= flat.mean()
        full = len(self._last) == _BACK
        step = float(np.abs(flat - self._last[-1]).mean()) if self._last else np.inf
        far = float(np.abs(flat - self._last[0]).mean()) if full else np.inf
        self._last.append(flat)
        limit = max(_NOISE, _STILL_SHARE * float(np.median(self._usual))) if self._usual else _NOISE
        stands = step < _EPSILON or (far < limit and step < limit)
        if full and not stands:
            self._usual.append(far)
        return stands


def put_elsewhere(small: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Find frames that show another place than the one before: a stretch is missing, or the car was lifted.

    Args:
        small: See :func:`small_pictures`.
    """
    flat = small.reshape(len(small), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1.0)
    elsewhere = np.zeros(len(small), dtype=bool)
    alike = np.sum(unit[1:] * unit[:-1], axis=1)
    # In a quick turn many neighbours differ; a break is one step between two that do not.
    around = np.minimum(alike[:-2], alike[2:])
    elsewhere[2:-1] = (alike[1:-1] < _ELSEWHERE) & (around > alike[1:-1] + _DIP)
    return elsewhere


def _change(flat: Float[np.ndarray, "n d"], frames: int) -> Float[np.ndarray, "m"]:
    """Mean change of each picture to the one so many frames on, [gray levels]."""
    return np.abs(flat[frames:] - flat[:-frames]).mean(axis=1)
