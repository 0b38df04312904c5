"""Keyframes of a slow car, and the poses of the frames between them.

Everything that compares images counts in frames: the lags of the odometry and the bundle adjustment, the
memory of the filter's map, how long a mirrored lamp has to stand still. All of it is meant for steps of a
tenth of the camera's height or more. A slower car is tracked by some of its frames, the keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from datagen.slam.commands import CommandedMotion
from lanenet.data.segments import equal_runs, true_runs
from lanenet.geometry.poses import between_on_arc

#: Step length below which a car is slow, and distance between keyframes, in camera heights. Chosen: keyframes
#: are as far apart as frames of the drives for which the lags were tuned (2.6 cm under a camera 17 cm high),
#: and a car is slow where every second frame would do.
_SLOW_HEIGHTS, _KEY_HEIGHTS = 0.075, 0.15
#: Frames to either side over which the step length is averaged, and frames for which a car is slow at least:
#: half a second and three at 20 frames a second, so that setting out or braking for a bend does not count.
_BESIDE, _LEAST_SLOW = 10, 60


def choose_keyframes(
    steps_heights: Float[np.ndarray, "n"], part: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "k"]:
    """Choose the frames by which a drive is tracked: all of them where the car is not slow.

    Args:
        steps_heights: Rough step length of each frame, in camera heights.
        part: Part of the drive that each frame belongs to.

    Returns:
        Frames in ascending order, the first and the last of each part among them.
    """
    n = len(steps_heights)
    so_far = np.concatenate([[0.0], np.cumsum(steps_heights)])
    first, stop = np.maximum(np.arange(n) - _BESIDE, 0), np.minimum(np.arange(n) + _BESIDE + 1, n)
    slow = (so_far[stop] - so_far[first]) / (stop - first) < _SLOW_HEIGHTS
    kept = np.ones(n, dtype=bool)
    for run in true_runs(slow):
        if len(run) < _LEAST_SLOW:
            continue
        distance = 0.0
        for k in run:
            distance += steps_heights[k]
            # The frame nearest to the wanted distance; the first one has none before it.
            kept[k] = k == 0 or distance + 0.5 * steps_heights[k] >= _KEY_HEIGHTS
            distance = 0.0 if kept[k] else distance
    kept |= np.diff(part, prepend=part[0] - 1) > 0
    kept |= np.diff(part, append=part[-1] + 1) > 0
    return np.flatnonzero(kept)


def interleaved_rows(keys: Int[np.ndarray, "k"], n: int) -> list[Int[np.ndarray, "_"]]:
    """Share all frames out among rows that are each as sparse as the keyframes: these, those after them, ...

    Args:
        keys: The keyframes, the first and the last frame among them.
        n: Number of frames.
    """
    after = np.arange(n) - keys[np.searchsorted(keys, np.arange(n), side="right") - 1]
    return [np.flatnonzero(after == later) for later in range(int(after.max()) + 1)]


def keyframe_pairs(
    keys: Int[np.ndarray, "k"], lags: Sequence[int], part: Int[np.ndarray, "n"]
) -> list[tuple[int, int]]:
    """Pairs of frames that are so many keyframes apart, for the adjustment of all frames together.

    Consecutive frames of a slow car hardly show how far apart they are: what holds the keyframes on each
    other holds the whole map in shape. A part of which every frame is a keyframe needs no pairs of its
    own.

    Args:
        keys: The keyframes, the first and the last frame of each part among them.
        lags: How many keyframes apart.
        part: Part of the drive that each frame belongs to.
    """
    pairs = []
    for run in equal_runs(part):
        own = keys[(keys >= run[0]) & (keys <= run[-1])]
        if len(own) < len(run):
            pairs += [(int(a), int(b)) for lag in lags for a, b in zip(own, own[lag:], strict=False)]
    return pairs


def commands_between(commands: CommandedMotion, keys: Int[np.ndarray, "k"]) -> CommandedMotion:
    """Return what was commanded from keyframe to keyframe: the whole distance, and the mean turn."""
    starts = np.concatenate([[0], keys[:-1] + 1])
    distance = np.add.reduceat(commands.distance_cm, starts)
    turn = commands.turn
    if turn is not None:
        turn = np.add.reduceat(turn, starts) / np.diff(starts, append=keys[-1] + 1)
    # Time counts in steps between keyframes. The first frame of a part follows the last of the one before.
    periods = np.add.reduceat(commands.periods, starts) / np.diff(starts, append=keys[-1] + 1)
    return replace(commands, distance_cm=distance, turn=turn, periods=periods)


def poses_between(
    poses: Float[np.ndarray, "k 3"], keys: Int[np.ndarray, "k"], steps: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Put the frames between keyframes on the arc from the one before to the one after.

    Args:
        poses: Poses of the keyframes, headings unwrapped.
        keys: The keyframes.
        steps: Step length of every frame, in any unit, positive.

    Returns:
        Poses of all frames; those of the keyframes as they were.
    """
    before, share = _shares(keys, steps)
    between = between_on_arc(poses[before], poses[before + 1], share)
    between[keys] = poses
    return between


def values_between(
    values: Float[np.ndarray, "k c"], keys: Int[np.ndarray, "k"], steps: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n c"]:
    """Interpolate values linearly from each keyframe to the next; see :func:`poses_between`."""
    before, share = _shares(keys, steps)
    return values[before] + share[:, None] * np.diff(values, axis=0)[before]


def _shares(
    keys: Int[np.ndarray, "k"], steps: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Index of the keyframe before each frame, and the share of the distance to the next one."""
    before = np.clip(np.searchsorted(keys, np.arange(len(steps)), side="right") - 1, 0, len(keys) - 2)
    so_far = np.cumsum(steps)
    start, stop = so_far[keys[before]], so_far[keys[before + 1]]
    return before, (so_far - start) / (stop - start)
