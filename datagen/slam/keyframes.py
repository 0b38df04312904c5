"""Key frames of a car that crawls, and the poses of the frames between them.

Everything that compares pictures counts in frames: how far apart those are that are compared, how long the
filter's map reaches back, how long a mirrored lamp has to stand still. All of it is meant for a car that
drives a tenth of its camera's height per frame or more. A slower one is followed by some of its frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.slam.track import CommandedMotion
from lanenet.data.segments import equal_runs, true_runs
from lanenet.geometry.poses import between_on_arc

#: Way per frame below which a car crawls, and from one key frame to the next, in camera heights.
_CRAWL_HEIGHTS, _KEY_HEIGHTS = 0.075, 0.15
#: Frames to either side over which that way is averaged, and for which a car crawls at least: one that sets
#: out or slows down for a bend does not.
_BESIDE, _LEAST_CRAWL = 10, 60


def key_frames(ways_heights: Float[np.ndarray, "n"]) -> Int[np.ndarray, "k"]:
    """Choose the frames by which a drive is followed: all of them where the car does not crawl.

    Args:
        ways_heights: Way of each frame from the one before, in camera heights, about.

    Returns:
        Frames in ascending order, the first and the last among them.
    """
    n = len(ways_heights)
    so_far = np.concatenate([[0.0], np.cumsum(ways_heights)])
    first, stop = np.maximum(np.arange(n) - _BESIDE, 0), np.minimum(np.arange(n) + _BESIDE + 1, n)
    crawls = (so_far[stop] - so_far[first]) / (stop - first) < _CRAWL_HEIGHTS
    kept = np.ones(n, dtype=bool)
    for run in true_runs(crawls):
        if len(run) < _LEAST_CRAWL:
            continue
        way = 0.0
        for k in run:
            way += ways_heights[k]
            # The frame that is nearest to the wanted way; the first one has none before it.
            kept[k] = k == 0 or way + 0.5 * ways_heights[k] >= _KEY_HEIGHTS
            way = 0.0 if kept[k] else way
    kept[[0, -1]] = True
    return np.flatnonzero(kept)


def alongside(keys: Int[np.ndarray, "k"], n: int) -> list[Int[np.ndarray, "_"]]:
    """Share all frames out among rows that are each thinned as the key frames are: these, those after, ...

    Args:
        keys: The key frames, the first and the last frame among them.
        n: Number of frames.
    """
    after = np.arange(n) - keys[np.searchsorted(keys, np.arange(n), side="right") - 1]
    return [np.flatnonzero(after == later) for later in range(int(after.max()) + 1)]


def key_pairs(
    keys: Int[np.ndarray, "k"], lags: Sequence[int], breaks: Bool[np.ndarray, "n"] | None = None
) -> list[tuple[int, int]]:
    """Pairs of frames that are so many key frames apart, for the adjustment of all frames together.

    What holds the key frames on each other is what holds the map in shape: frames of a crawl that follow each
    other hardly tell how far they are apart. A stretch of which every frame is a key frame needs none.

    Args:
        keys: The key frames, the first and the last frame of each stretch among them.
        lags: How many key frames apart.
        breaks: Frames that do not follow the one before them; None for one stretch.
    """
    stretch = np.zeros(keys[-1] + 1, np.int64) if breaks is None else np.cumsum(breaks)
    pairs = []
    for run in equal_runs(stretch):
        own = keys[(keys >= run[0]) & (keys <= run[-1])]
        if len(own) < len(run):
            pairs += [(int(a), int(b)) for lag in lags for a, b in zip(own, own[lag:], strict=False)]
    return pairs


def commands_between(commands: CommandedMotion, keys: Int[np.ndarray, "k"]) -> CommandedMotion:
    """Return what was commanded from key frame to key frame: the whole way, and the mean turn."""
    starts = np.concatenate([[0], keys[:-1] + 1])
    distance = np.add.reduceat(commands.distance_cm, starts)
    turn = commands.turn
    if turn is not None:
        turn = np.add.reduceat(turn, starts) / np.diff(starts, append=keys[-1] + 1)
    return replace(commands, distance_cm=distance, turn=turn)


def poses_between(
    poses: Float[np.ndarray, "k 3"], keys: Int[np.ndarray, "k"], ways: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Put the frames between key frames on the arc from the one before to the one after.

    Args:
        poses: Poses of the key frames, headings unwrapped.
        keys: The key frames.
        ways: Way of every frame from the one before, in any unit; more than none.

    Returns:
        Poses of all frames; those of the key frames as they were.
    """
    before, share = _places(keys, ways)
    between = between_on_arc(poses[before], poses[before + 1], share)
    between[keys] = poses
    return between


def values_between(
    values: Float[np.ndarray, "k c"], keys: Int[np.ndarray, "k"], ways: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n c"]:
    """Values of all frames, straight from each key frame to the next; see :func:`poses_between`."""
    before, share = _places(keys, ways)
    return values[before] + share[:, None] * np.diff(values, axis=0)[before]


def _places(
    keys: Int[np.ndarray, "k"], ways: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Key frame before each frame, by its place among them, and the share of the way to the next."""
    before = np.clip(np.searchsorted(keys, np.arange(len(ways)), side="right") - 1, 0, len(keys) - 2)
    so_far = np.cumsum(ways)
    start, stop = so_far[keys[before]], so_far[keys[before + 1]]
    return before, (so_far - start) / (stop - start)
