"""Runs of samples that are alike, and the segments of a map among labelled frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

#: A step longer than this many median steps leads into another segment. Chosen: cars do not change speed by a
#: factor of 5 from frame to frame, and segments start anywhere on the map.
_JUMP = 5.0


def map_segments(frames: Int[np.ndarray, "n"], poses: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Number the segments of a map by the jumps of its poses; each segment has a map frame of its own.

    Args:
        frames: Frame numbers, increasing.
        poses: Rear-axle poses, frame map.

    Returns:
        The segment of each frame, from 0.
    """
    if not len(frames):
        return np.empty(0, np.int64)
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    apart = np.maximum(np.diff(frames), 1)
    jumps = steps > _JUMP * apart * np.median(steps / apart) if len(steps) else np.empty(0, bool)
    return np.concatenate([[0], np.cumsum(jumps)]).astype(np.int64)


def equal_runs(values: Int[np.ndarray, "n"] | Bool[np.ndarray, "n"]) -> list[Int[np.ndarray, "_"]]:
    """Return the indices of each maximal run of equal values, in order."""
    if not len(values):
        return []
    return np.split(np.arange(len(values)), np.flatnonzero(values[1:] != values[:-1]) + 1)


def true_runs(flags: Bool[np.ndarray, "n"], closed: bool = False) -> list[Int[np.ndarray, "_"]]:
    """Return the indices of each maximal run of True, in order; if closed, a run may cross the seam."""
    runs = equal_runs(flags)
    if closed and len(runs) > 2 and flags[0] and flags[-1]:
        runs = [*runs[1:-1], np.concatenate([runs[-1], runs[0]])]
    return [run for run in runs if flags[run[0]]]
