"""Which labelled frames belong to the same piece of a map: a drive with interruptions is mapped in pieces.

Runs of samples that follow one another and are alike.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

#: A step longer than so many median ones is no way driven: it leads into another piece.
_JUMP = 5.0


def map_pieces(frames: Int[np.ndarray, "n"], poses: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Number the pieces of a map by where its poses jump; each piece has a frame of its own.

    Args:
        frames: Frame numbers, increasing.
        poses: Rear-axle centre and heading of each, frame map.

    Returns:
        The piece of each frame, from 0.
    """
    if not len(frames):
        return np.empty(0, np.int64)
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    apart = np.maximum(np.diff(frames), 1)
    jumps = steps > _JUMP * apart * np.median(steps / apart) if len(steps) else np.empty(0, bool)
    return np.concatenate([[0], np.cumsum(jumps)]).astype(np.int64)


def equal_runs(values: Int[np.ndarray, "n"] | Bool[np.ndarray, "n"]) -> list[Int[np.ndarray, "_"]]:
    """Return the indices of each longest run of equal values, in order; none of no values."""
    if not len(values):
        return []
    return np.split(np.arange(len(values)), np.flatnonzero(values[1:] != values[:-1]) + 1)


def true_runs(flags: Bool[np.ndarray, "n"], closed: bool = False) -> list[Int[np.ndarray, "_"]]:
    """Return the indices of each longest run of True, in order; in a closed row one may cross the seam."""
    runs = equal_runs(flags)
    if closed and len(runs) > 2 and flags[0] and flags[-1]:
        runs = [*runs[1:-1], np.concatenate([runs[-1], runs[0]])]
    return [run for run in runs if flags[run[0]]]
