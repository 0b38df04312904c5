"""Frames that have no say in the lines of the map, so that the map can be checked against them.

A held-out frame keeps its place in the chain: its edges take part in finding its own pose, or it would have
none. What it is held out from is the lines. So the check sees what is wrong with the lines and with the poses
of its neighbours relative to its own, and not what all of them have in common.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from datagen.slam.scans import Scans

#: A stream of its own, so that holding frames out changes nothing else that is drawn.
_STREAM = 1


def held_out_frames(count: int, every: int, seed: int) -> Bool[np.ndarray, "n"]:
    """Choose one of every so many frames, from a first one that the seed decides.

    Args:
        count: Frames of the drive.
        every: Distance between the chosen ones; 0 for none.
        seed: Of the drive's settings.
    """
    chosen = np.zeros(count, dtype=bool)
    if every:
        first = int(np.random.default_rng((seed, _STREAM)).integers(every))
        chosen[first::every] = True
    return chosen


def without_frames(scans: Scans, left_out: Bool[np.ndarray, "n"]) -> Scans:
    """Return the scans with some frames emptied; the others stay at their index."""
    kept = ~left_out[scans.frame_of_point]
    counts = np.where(left_out, 0, np.diff(scans.starts))
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Scans(scans.points_cm[kept], scans.normals[kept], scans.weights[kept], starts)
