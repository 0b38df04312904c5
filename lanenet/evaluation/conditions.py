"""What a label set knows of its frames beside the labels: which lines show, and how new the place is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.label_set import LabelSet
from lanenet.data.segments import map_segments
from lanenet.samples.augment import join_frames, plain_batch


def lines_seen(labels: LabelSet) -> Float[np.ndarray, "n 2"]:
    """Return whether each frame's raster shows the left and the right line: 1, 0, or NaN for unknown."""
    frames = join_frames(labels.edges, labels.lines, labels.points_cm)
    return plain_batch(frames, np.arange(len(labels)), labels.meta.window).present.astype(np.float64)


def way_to_training_cm(labels: LabelSet, training: Sequence[LabelSet]) -> Float[np.ndarray, "n"]:
    """Return how far each frame is from the nearest training frame of the same map, [cm].

    Two label sets are of one map if their drive has the same name, their camera is the same and both take
    their labels from a map: parts of one recorded drive. NaN where no training frame is of this map, or of
    this piece of it.
    """
    same = [
        other
        for other in training
        if labels.meta.source == other.meta.source == "map"
        and labels.meta.camera_hash == other.meta.camera_hash
        and labels.drive[:1] == other.drive[:1]
    ]
    parts = [*same, labels]
    frames, poses = (np.concatenate([getattr(part, name) for part in parts]) for name in ("frame", "poses"))
    learned = np.arange(len(frames)) < len(frames) - len(labels)
    order = np.argsort(frames, kind="stable")
    pieces = np.empty(len(frames), np.int64)
    pieces[order] = map_segments(frames[order], poses[order])
    result = np.full(len(labels), np.nan)
    for piece in np.unique(pieces[~learned]):
        mine = pieces[~learned] == piece
        result[mine] = nearest_pose_cm(labels.poses[mine], poses[learned & (pieces == piece)])
    return result


def nearest_pose_cm(
    poses: Float[np.ndarray, "n 3"], training_poses: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "n"]:
    """Return the distance of each place to the nearest of others, [cm], frame map; headings do not count."""
    if not len(training_poses):
        return np.full(len(poses), np.nan)
    result = np.empty(len(poses))
    for k, pose in enumerate(poses):
        result[k] = np.sqrt(((training_poses[:, :2] - pose[:2]) ** 2).sum(axis=1).min())
    return result


def at_frames(
    values: Float[np.ndarray, "n *k"], frames: Int[np.ndarray, "n"], wanted: Int[np.ndarray, "m"]
) -> Float[np.ndarray, "m *k"]:
    """Return the values of frames by their numbers; NaN for a number that there is no value for.

    Args:
        values: A row per frame.
        frames: Numbers of the rows, increasing.
        wanted: Numbers to look up.
    """
    result = np.full((len(wanted), *values.shape[1:]), np.nan)
    if len(frames):
        row = np.minimum(np.searchsorted(frames, wanted), len(frames) - 1)
        found = frames[row] == wanted
        result[found] = values[row[found]]
    return result
