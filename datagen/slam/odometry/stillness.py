"""Frames in which the car stands or reverses, and breaks that only the images show."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from lanenet.data.drives import Commands, Drive
from lanenet.errors import TrackingLostError
from lanenet.perception.edges.canny import to_gray

#: Size of a small image: patches of 6 to 7 px of an image of 160 x 120.
SMALL_WIDTH, SMALL_HEIGHT = 24, 18
#: Frames over which the image of a moving car changes: half a second at 20 Hz.
_AHEAD = 10
#: Gray levels; averaged over such large patches, the noise of any camera is below it.
_NOISE = 0.6
#: Share of a drive's typical change below which two images count as the same. Chosen: a car at a quarter of
#: its typical speed may still be tracked.
_STILL_SHARE = 0.25
#: Correlation of neighbouring images below which the second shows another place, and how much higher the
#: correlations before and after it are. Chosen: in a quick turn neighbours correlate little too, but all of
#: them do.
_ELSEWHERE, _DIP = 0.35, 0.35
#: Throttle below which Donkeycar's car brakes or reverses; above, it is the noise of a joystick.
_BACKWARDS_THROTTLE = -0.05
#: Moving frames of a reverse command that count as reversing: a driver who brakes needs fewer.
_BACKING = 5
#: Change below which not even the noise differs: the frame was recorded twice.
_EPSILON = 1e-9
#: A crawl changes over ten frames by more than this times the change from one to the next; noise, and an
#: exposure that drifts, change by less. Chosen.
_GOES_ON = 3.0
#: Frames that a live car looks back, and moving frames whose median change is its typical one.
_BACK, _WATCHED = 4, 300


def following_frames(drive: Drive) -> tuple[Drive, list[str]]:
    """Leave out frames in which the car stands or reverses, and mark breaks that only the images show.

    All later stages follow a car that drives forward; where it reverses, the drive breaks.

    Returns:
        The drive that is left, and notes on what was found, a sentence each.

    Raises:
        TrackingLostError: If the car was commanded to reverse all the time.
    """
    notes: list[str] = []
    small = small_images(drive)
    standing, elsewhere = standing_frames(small), put_elsewhere(small)
    if elsewhere.any():
        where = ", ".join(str(number) for number in drive.frames[elsewhere][:5])
        notes.append(f"{elsewhere.sum()} breaks in the images, the first before frame {where}")
    breaks = drive.breaks | elsewhere
    backing = reversing_runs(drive.commands, standing)
    backs_up = np.zeros(len(drive), dtype=bool)
    for start, stop in backing:
        backs_up[start:stop] = True
        breaks[stop : stop + 1] = True
    if backing:
        where = ", ".join(f"{drive.frames[start]}-{drive.frames[stop - 1]}" for start, stop in backing[:5])
        more = f" and {len(backing) - 5} times more" if len(backing) > 5 else ""
        notes.append(f"the car was commanded to reverse in frames {where}{more}: left out")
        if (standing | backs_up).all():
            raise TrackingLostError(
                f"{drive.path}: the car was commanded to reverse in frames {where}{more} and stands in "
                "all others, expected a car that drives forward"
            )
    same = standing & ~backs_up
    if same.any():
        notes.append(f"{same.sum()} frames show the same as the one before, and are left out")
    drive, left_out = replace(drive, breaks=breaks), standing | backs_up
    return (drive.subset(np.flatnonzero(~left_out)) if left_out.any() else drive), notes


def reversing_runs(commands: Commands, standing: Bool[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """Find where the car was commanded to reverse, and moved for several frames.

    The throttle is used only if no speed was recorded and it is mostly positive: the motor may run the other
    way round.

    Args:
        commands: The commands.
        standing: See :func:`standing_frames`.

    Returns:
        First row of each run, and the row after its last.
    """
    reverse = np.zeros(len(standing), dtype=bool)
    if commands.speed_cm_s is not None:
        reverse = commands.speed_cm_s < 0.0
    elif commands.throttle is not None and np.sum(commands.throttle > 0.0) > np.sum(commands.throttle < 0.0):
        reverse = commands.throttle < _BACKWARDS_THROTTLE
    bounds = np.flatnonzero(np.diff(reverse.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    return [(int(a), int(b)) for a, b in bounds if (~standing[a:b]).sum() >= _BACKING]


def small_images(drive: Drive) -> Float32[np.ndarray, "n h w"]:
    """Return every frame as :func:`shrink_image` does."""
    small = np.empty((len(drive), SMALL_HEIGHT, SMALL_WIDTH), np.float32)
    for k in range(len(drive)):
        small[k] = shrink_image(drive.image(k))
    return small


def shrink_image(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2"]:
    """Return an image in gray, averaged over large patches."""
    size = (SMALL_WIDTH, SMALL_HEIGHT)
    return np.asarray(cv2.resize(to_gray(image), size, interpolation=cv2.INTER_AREA))


def standing_frames(small: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Find the frames that show the same as those before them: repeated ones, and those of a car that stands.

    Such an image hardly differs from the one before it, nor from the one ten frames before or after. "Hardly"
    is relative to the change in ten frames that is typical of this drive while the car moves. A crawl changes
    little from frame to frame, but goes on. The first frame of a stop is kept.

    Args:
        small: See :func:`small_images`.
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
    limit = max(_NOISE, _STILL_SHARE * _typical_change(step, far))
    # At either end of a stop, the change before the frame or the one after it is large.
    before = np.concatenate([np.full(_AHEAD, np.inf), far])
    after = np.concatenate([far, np.full(_AHEAD, np.inf)])
    still = np.minimum(before, after) < limit
    standing[1:] = still[1:] & (step < limit)
    # Recorded twice.
    standing[1:] |= step < _EPSILON
    return standing


def _typical_change(step: Float[np.ndarray, "m"], far: Float[np.ndarray, "f"]) -> float:
    """Median change in ten frames of a car that moves.

    Args:
        step: Change of each image to the next.
        far: Change of each image to the one ten frames later.
    """
    so_far = np.concatenate([[0.0], np.cumsum(step)])
    near = (so_far[_AHEAD:] - so_far[:-_AHEAD]) / _AHEAD
    # Noise is as large between any two images.
    moves = (near > _NOISE) | (far > _GOES_ON * near)
    return float(np.median(far[moves])) if moves.any() else 0.0


class StandstillDetector:
    """Says of each frame as it comes whether the car stands.

    As :func:`standing_frames`, but from past frames alone: the first frames of a stop count as driven, and
    the typical change is that of the last moving frames.
    """

    def __init__(self) -> None:
        self._last: deque[Float32[np.ndarray, "d"]] = deque(maxlen=_BACK)
        self._changes: deque[float] = deque(maxlen=_WATCHED)

    def stands(self, small: UInt8[np.ndarray, "h w"]) -> bool:
        """Take in the next frame's small image (see :func:`shrink_image`)."""
        flat = small.astype(np.float32).ravel()
        flat -= flat.mean()
        full = len(self._last) == _BACK
        step = float(np.abs(flat - self._last[-1]).mean()) if self._last else np.inf
        far = float(np.abs(flat - self._last[0]).mean()) if full else np.inf
        self._last.append(flat)
        limit = max(_NOISE, _STILL_SHARE * float(np.median(self._changes))) if self._changes else _NOISE
        stands = step < _EPSILON or (far < limit and step < limit)
        if full and not stands:
            self._changes.append(far)
        return stands


def put_elsewhere(small: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "n"]:
    """Find frames that show another place than the one before: frames are missing, or somebody moved the car.

    Args:
        small: See :func:`small_images`.
    """
    flat = small.reshape(len(small), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1.0)
    elsewhere = np.zeros(len(small), dtype=bool)
    alike = np.sum(unit[1:] * unit[:-1], axis=1)
    # In a quick turn many neighbours differ; a break is a single one between two that agree.
    around = np.minimum(alike[:-2], alike[2:])
    elsewhere[2:-1] = (alike[1:-1] < _ELSEWHERE) & (around > alike[1:-1] + _DIP)
    return elsewhere


def _change(flat: Float[np.ndarray, "n d"], frames: int) -> Float[np.ndarray, "m"]:
    """Mean change of each image to the one so many frames later, [gray levels]."""
    return np.abs(flat[frames:] - flat[:-frames]).mean(axis=1)
