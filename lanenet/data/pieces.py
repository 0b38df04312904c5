"""Which labelled frames belong to the same piece of a map: a drive with interruptions is mapped in pieces."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

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
