"""The edge points of tapes that are laid along polylines."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lanenet.perception.edges.road import RoadEdges


def tape(path_cm: np.ndarray, marking_cm: float) -> RoadEdges:
    """Both borders of a tape along a polyline, every half centimetre."""
    points, normals = [], []
    for start, end in pairwise(path_cm):
        length_cm = float(np.hypot(*(end - start)))
        along = (end - start) / length_cm
        right = np.array([along[1], -along[0]])
        middle = start + np.arange(0.25, length_cm, 0.5)[:, None] * along
        for border in (-0.5, 0.5):
            points.append(middle + border * abs(marking_cm) * right)
            normals.append(np.tile(-2.0 * border * np.sign(marking_cm) * right, (len(middle), 1)))
    return RoadEdges(np.concatenate(points), np.concatenate(normals))


def together(*edges: RoadEdges) -> RoadEdges:
    """The edge points of several tapes."""
    points, normals = zip(*((each.points_cm, each.normals) for each in edges), strict=True)
    return RoadEdges(np.concatenate(points), np.concatenate(normals))
