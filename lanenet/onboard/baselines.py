"""Detectors without a network, run on the edge points of a label set, for tables of errors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lanenet.data.label_set import LabelSet
from lanenet.perception.lane_filter import LaneFilter, LaneFilterSettings


def lane_filter_points_cm(
    label_set: LabelSet, settings: LaneFilterSettings | None = None
) -> Float[np.ndarray, "n 6"]:
    """Run the lane filter over a label set.

    The filter starts again wherever a frame does not follow the one before it.

    Args:
        label_set: Frames with their edge points.
        settings: Of the filter; None takes its defaults with the label set's lane width.

    Returns:
        Six points per frame, [cm], frame car; NaN where the filter has no answer.
    """
    if settings is None:
        settings = LaneFilterSettings(lane_width_cm=label_set.meta.lane_width_cm)
    lane_filter = LaneFilter(None, settings)
    points = np.full(label_set.points_cm.shape, np.nan)
    for i, edges in enumerate(label_set.edges):
        follows = (
            i > 0
            and label_set.drive[i] == label_set.drive[i - 1]
            and label_set.frame[i] == label_set.frame[i - 1] + 1
        )
        if not follows:
            lane_filter.reset()
        points[i] = lane_filter.estimate(np.asarray(edges[:, :2], np.float64)).points_cm
    return points
