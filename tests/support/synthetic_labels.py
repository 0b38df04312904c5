"""Label sets of random parabolic lanes, for the tests of learning."""

from __future__ import annotations

from typing import Literal

import numpy as np

from lanenet.data.label_set import LabelMeta, LabelSet
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import rows_of_polyline
from lanenet.perception.edges.road import RoadEdges

WINDOW = BirdseyeWindow(left_cm=-48.0, near_cm=0.0, cell_cm=3.0, rows=24, columns=32)


def make_label_set(
    n: int,
    seed: int,
    *,
    window: BirdseyeWindow = WINDOW,
    camera_hash: str = "cam0",
    wheelbase_cm: float = 26.0,
    source: Literal["map", "truth"] = "map",
) -> LabelSet:
    """Both edges of a 2 cm tape on each side of a 40 cm lane, seen from 8 cm ahead of the car."""
    rng = np.random.default_rng(seed)
    edges, lines, points = [], [], []
    y_line = np.arange(-60.0, 120.0, 5.0)
    y_edge = np.arange(8.0, 80.0, 0.5)
    for _ in range(n):
        a, b, c = rng.uniform(-1, 1, 3) * [0.003, 0.15, 8.0]

        def x_of(y, offset, a=a, b=b, c=c):
            return (a * y + b) * y + c + offset

        pair = tuple(np.stack([x_of(y_line, o), y_line], axis=1) for o in (-20.0, 20.0))
        lines.append(tuple(line.astype(np.float32) for line in pair))
        points.append(np.concatenate([rows_of_polyline(line) for line in pair]))
        x = np.concatenate([x_of(y_edge, o) for o in (-21.0, -19.0, 19.0, 21.0)])
        xy = np.stack([x, np.tile(y_edge, 4)], axis=1)
        normals = np.tile([1.0, 0.0], (len(xy), 1))
        edges.append(RoadEdges(xy, normals).rows())
    return LabelSet(
        meta=LabelMeta(window, camera_hash, wheelbase_cm, 40.0, source),
        drive=["d"] * n,
        file=[""] * n,
        frame=np.arange(n),
        t_s=np.arange(n) * 0.05,
        lap=np.zeros(n, np.int64),
        poses=np.zeros((n, 3)),
        points_cm=np.array(points),
        edges=edges,
        lines=lines,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )
