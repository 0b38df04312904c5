"""Frames in which the car stands or backs up, and breaks that only the pictures tell."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from lanenet.data.drives import Commands, Drive
from lanenet.errors import TrackingLostError
from lanenet.perception.edges.canny import to_gray

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
#: Throttle below which Donkeycar's car brakes or drives backwards.
_BACKWARDS_THROTTLE = -0.05
#: Frames of one such command in which the car moves: a driver who brakes needs fewer.
_BACKING = 5
_EPSILON = 1e-9
#: How much more a crawl changes over those frames than from one to the next: noise, and an exposure that
#: drifts, do so by less.
_GOES_ON = 3.0
_BACK = 4  # frames that a live car looks back
_WATCHED = 300  # frames of a live car whose change counts as usual


def following_frames(drive: Drive, notes: list[str]) -> Drive:
    """Leave out frames in which the car stands or backs up, and mark breaks that only the pictures tell.

    All that comes after follows a car that drives forward; where it backs up, the drive breaks.

    Args:
        drive: The drive.
        notes: What was found is added, a sentence each.

    Raises:
        TrackingLostError: If the car was told to reverse all the time.
    """
    small = small_pictures(drive)
    standing, elsewhere = standing_frames(small), put_elsewhere(small)
    if elsewhere.any():
        where = ", ".join(str(number) for number in drive.frames[elsewhere][:5])
        notes.append(f"{elsewhere.sum()} breaks in the pictures, the first before frame {where}")
    breaks = drive.breaks | elsewhere
    backing = reversing_runs(drive.commands, standing)
    backs_up = np.zeros(len(drive), dtype=bool)
    for start, stop in backing:
        backs_up[start:stop] = True
        breaks[stop : stop + 1] = True
    if backing:
        where = ", ".join(f"{drive.frames[start]}-{drive.frames[stop - 1]}" for start, stop in backing[:5])
        more = f" and {len(backing) - 5} times more" if len(backing) > 5 else ""
        notes.append(f"the car was told to reverse in frames {where}{more}: left out")
        if (standing | backs_up).all():
            raise TrackingLostError(
                f"{drive.path}: the car was told to reverse in frames {where}{more} and stands in any other, "
                "expected a car that drives forward"
            )
    same = standing & ~backs_up
    if same.any():
        notes.append(f"{same.sum()} frames show the same as the one before, and are left out")
    drive, left_out = replace(drive, breaks=breaks), standing | backs_up
    return drive.subset(np.flatnonzero(~left_out)) if left_out.any() else drive


def reversing_runs(commands: Commands, standing: Bool[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """Find where the car was told to drive backwards, and moved for several frames.

    A throttle is only asked where no speed was recorded and it is positive as a rule: it may be that of a
    motor that turns the other way.

    Args:
        commands: What the car was told.
        standing: See :func:`standing_frames`.

    Returns:
        First row of each run, and the row after its last.
    """
    told = np.zeros(len(standing), dtype=bool)
    if commands.speed_cm_s is not None:
        told = commands.speed_cm_s < 0.0
    elif commands.throttle is not None and np.sum(commands.throttle > 0.0) > np.sum(commands.throttle < 0.0):
        told = commands.throttle < _BACKWARDS_THROTTLE
    bounds = np.flatnonzero(np.diff(told.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    return [(int(a), int(b)) for a, b in bounds if (~standing[a:b]).sum() >= _BACKING]


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
    on either side of the step, as compared with what the drive's pictures usually change by in ten frames
    while the car moves. A crawl changes little from frame to frame, but goes on. The first frame of a stop is
    kept.

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
    limit = max(_NOISE, _STILL_SHARE * _usual_change(step, far))
    # The far change before a frame or the one after it is small: at either end of a stop one of them is not.
    before = np.concatenate([np.full(_AHEAD, np.inf), far])
    after = np.concatenate([far, np.full(_AHEAD, np.inf)])
    still = np.minimum(before, after) < limit
    standing[1:] = still[1:] & (step < limit)
    # A picture that was recorded twice: not even the noise differs.
    standing[1:] |= step < _EPSILON
    return standing


def _usual_change(step: Float[np.ndarray, "m"], far: Float[np.ndarray, "f"]) -> float:
    """Usual change in ten frames of a car that moves.

    Args:
        step: Change of each picture to the next.
        far: Change of each picture to the one ten frames on.
    """
    so_far = np.concatenate([[0.0], np.cumsum(step)])
    near = (so_far[_AHEAD:] - so_far[:-_AHEAD]) / _AHEAD
    # Noise is as large from each picture to any other one.
    moves = (near > _NOISE) | (far > _GOES_ON * near)
    return float(np.median(far[moves])) if moves.any() else 0.0


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
