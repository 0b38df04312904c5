"""A recorded drive cut into parts to learn from, to choose by and to judge by, with gaps between them.

The parts follow each other in time, so that a part is never between two of another. Frames close to a cut, by
number or by way, belong to no part: neighbouring frames show the same road from almost the same place.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.label_set import LabelSet
from lanenet.data.segments import equal_runs, map_pieces
from lanenet.errors import ConfigError

#: A lap with less than this share of the frames of the median lap was not driven to its end.
_WHOLE_LAP = 0.5


def split_along_time(
    labels: LabelSet, shares: tuple[float, ...], gap_frames: int, gap_cm: float = 0.0
) -> list[LabelSet]:
    """Cut a drive's labels along its time.

    Args:
        labels: Labels of one drive, in the order of its frames.
        shares: Share of the frames of each part but the last, which gets the rest.
        gap_frames: No two frames of different parts are this close or closer by their numbers.
        gap_cm: Nor by the way driven between them, [cm].

    Returns:
        One more part than there are shares.

    Raises:
        ConfigError: If a part would be empty.
    """
    cuts = np.rint(np.cumsum([0.0, *shares]) * len(labels)).astype(np.int64)
    return _cut(labels, np.minimum(cuts, len(labels)), gap_frames, gap_cm, f"shares {shares}")


def split_by_lap(labels: LabelSet, gap_frames: int, gap_cm: float = 0.0) -> list[LabelSet]:
    """Cut a drive's labels where laps begin: all early laps, the last but one, the last.

    A lap that was not driven to its end belongs to the one before it. Where the map is in several pieces,
    each piece counts its own laps.

    Args:
        labels: Labels of one drive, in the order of its frames.
        gap_frames: As for :func:`split_along_time`.
        gap_cm: Likewise.

    Returns:
        The three parts.

    Raises:
        ConfigError: If there are fewer than three laps, or a part would be empty.
    """
    laps = equal_runs(labels.lap)
    usual = np.median([len(lap) for lap in laps]) if laps else 0.0
    starts = [int(lap[0]) for lap in laps if len(lap) >= _WHOLE_LAP * usual]
    if len(starts) < 3:
        raise ConfigError(
            f"split by lap: found {len(starts)} laps driven to their end, expected at least 3; split along "
            "the time"
        )
    return _cut(labels, np.array([0, *starts[-2:]]), gap_frames, gap_cm, "the laps")


def way_cm(labels: LabelSet) -> Float[np.ndarray, "n"]:
    """Return the way driven up to each labelled frame, [cm]; it stays where the map is interrupted."""
    steps = np.linalg.norm(np.diff(labels.poses[:, :2], axis=0), axis=1)
    steps[np.diff(map_pieces(labels.frame, labels.poses)) != 0] = 0.0
    return np.concatenate([np.zeros(min(1, len(labels))), np.cumsum(steps)])


def _cut(
    labels: LabelSet, cuts: Int[np.ndarray, "k"], gap_frames: int, gap_cm: float, how: str
) -> list[LabelSet]:
    """Cut at rows, and leave out what lies within the gaps after the part before."""
    way = way_cm(labels)
    parts: list[LabelSet] = []
    last = -1
    for start, end in pairwise([*cuts.tolist(), len(labels)]):
        rows = np.arange(start, end)
        if last >= 0:
            rows = rows[
                (labels.frame[rows] - labels.frame[last] > gap_frames) & (way[rows] - way[last] >= gap_cm)
            ]
        if not rows.size:
            raise ConfigError(
                f"{how} with a gap of {gap_frames} frames and {gap_cm:g} cm leave a part of {len(labels)} "
                "empty"
            )
        parts.append(labels.subset(rows))
        last = int(rows[-1])
    return parts
