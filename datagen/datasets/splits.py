"""Split the labels of a recorded drive into training, validation and test part, with gaps between them.

The parts follow one another in time. Frames close to a cut, by number or by distance, belong to no part:
neighbouring frames show the same road from almost the same place.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from datagen.datasets.settings import RecordedSettings
from lanenet.data.label_set import LabelSet
from lanenet.data.segments import equal_runs, map_segments
from lanenet.errors import ConfigError

#: A lap with less than this share of the median lap's frames was not completed. Chosen: half a lap.
_WHOLE_LAP = 0.5
#: One to learn from, one to choose the epoch by, one for the test.
_LEAST_LAPS = 3


def split_recording(labels: LabelSet, settings: RecordedSettings) -> list[LabelSet]:
    """Return training, validation and test part of a recorded drive.

    Raises:
        ConfigError: As :func:`split_along_time` and :func:`split_by_lap`.
    """
    if chosen_split(labels, settings) == "lap":
        return split_by_lap(labels, settings.gap_frames, settings.gap_cm)
    shares = (settings.train_share, settings.validation_share)
    return split_along_time(labels, shares, settings.gap_frames, settings.gap_cm)


def chosen_split(labels: LabelSet, settings: RecordedSettings) -> str:
    """Return how a drive is split: what ``auto`` stands for with these labels, or the setting."""
    if settings.split != "auto":
        return settings.split
    return "lap" if len(_lap_starts(labels)) >= _LEAST_LAPS else "time"


def split_along_time(
    labels: LabelSet, shares: tuple[float, ...], gap_frames: int, gap_cm: float = 0.0
) -> list[LabelSet]:
    """Split a drive's labels along its time.

    Args:
        labels: Labels of one drive, in the order of its frames.
        shares: Share of the frames of each part but the last, which gets the rest.
        gap_frames: The numbers of two frames of different parts differ by more than this.
        gap_cm: At least this distance was driven between them, [cm].

    Returns:
        One part more than there are shares.

    Raises:
        ConfigError: If a part would be empty.
    """
    cuts = np.rint(np.cumsum([0.0, *shares]) * len(labels)).astype(np.int64)
    return _cut(labels, np.minimum(cuts, len(labels)), gap_frames, gap_cm, f"shares {shares}")


def split_by_lap(labels: LabelSet, gap_frames: int, gap_cm: float = 0.0) -> list[LabelSet]:
    """Split a drive's labels by lap: all early laps, the last but one, the last.

    An incomplete lap belongs to the one before it. Each segment of a map counts its own laps.

    Args:
        labels: Labels of one drive, in the order of its frames.
        gap_frames: As for :func:`split_along_time`.
        gap_cm: Likewise.

    Returns:
        The three parts.

    Raises:
        ConfigError: If there are fewer than three complete laps, or a part would be empty.
    """
    starts = _lap_starts(labels)
    if len(starts) < _LEAST_LAPS:
        raise ConfigError(
            f"split by lap: {len(starts)} complete laps, expected {_LEAST_LAPS} at least; use split: time"
        )
    return _cut(labels, np.array([0, *starts[-2:]]), gap_frames, gap_cm, "the laps")


def _lap_starts(labels: LabelSet) -> list[int]:
    """First rows of the complete laps."""
    laps = equal_runs(labels.lap)
    typical = np.median([len(lap) for lap in laps]) if laps else 0.0
    return [int(lap[0]) for lap in laps if len(lap) >= _WHOLE_LAP * typical]


def driven_cm(labels: LabelSet) -> Float[np.ndarray, "n"]:
    """Return the distance driven up to each labelled frame, [cm]; jumps between segments add nothing."""
    steps = np.linalg.norm(np.diff(labels.poses[:, :2], axis=0), axis=1)
    steps[np.diff(map_segments(labels.frame, labels.poses)) != 0] = 0.0
    return np.concatenate([np.zeros(min(1, len(labels))), np.cumsum(steps)])


def _cut(
    labels: LabelSet, cuts: Int[np.ndarray, "k"], gap_frames: int, gap_cm: float, what: str
) -> list[LabelSet]:
    """Cut before the given rows, and leave out what lies within the gap after each part."""
    distance_cm = driven_cm(labels)
    parts: list[LabelSet] = []
    last = -1
    for start, end in pairwise([*cuts.tolist(), len(labels)]):
        rows = np.arange(start, end)
        if last >= 0:
            numbers = labels.frame[rows] - labels.frame[last]
            distances_cm = distance_cm[rows] - distance_cm[last]
            rows = rows[(numbers > gap_frames) & (distances_cm >= gap_cm)]
        if not rows.size:
            raise ConfigError(
                f"{what} with a gap of {gap_frames} frames and {gap_cm:g} cm leave a part empty; the drive "
                f"has {len(labels)} labelled frames: drive longer, two laps or more, or set smaller gaps"
            )
        parts.append(labels.subset(rows))
        last = int(rows[-1])
    return parts
