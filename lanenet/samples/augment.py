"""Augmentation: seeded changes of samples on their edge points, in cm, with exact new labels.

The points are moved, dropped and joined by clutter before they become a raster, so that a turned road has
edges as sharp as a straight one. The labels of the moved car follow from the lane lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, UInt8

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.edges.raster import PLANES, STEPS
from lanenet.samples.kernels import (
    Amounts,
    Frames,
    Grid,
    augment_frames,
    near_lines,
    rasterise_frames,
)
from lanenet.samples.settings import AugmentSettings

Lines = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]

#: Assumed place of a camera that the label set does not give: right of, ahead of and above the front axle,
#: [cm]. Chosen: the mean of the project's synthetic cars.
TYPICAL_CAMERA_CM = (0.0, 0.0, 18.0)


class Batch(NamedTuple):
    """Samples as a network takes them.

    Attributes:
        rasters: With all planes, see :mod:`lanenet.perception.edges.raster`.
        points_cm: Labels, [cm]; NaN where masked.
        present: Whether each line can be seen: 1, 0 or NaN for unknown.
        lane_cm: The lane width that the network is given, [cm]; 0 where it is kept back.
    """

    rasters: UInt8[np.ndarray, "b p r c"]
    points_cm: Float[np.ndarray, "b 6"]
    present: Float[np.ndarray, "b 2"]
    lane_cm: Float[np.ndarray, "b"]


def join_frames(
    edges: Sequence[Float[np.ndarray, "_ 6"]],
    lines_cm: Sequence[Lines],
    points_cm: Float[np.ndarray, "n 6"],
    camera_cm: Float[np.ndarray, "n 3"] | None = None,
    lane_cm: Float[np.ndarray, "n"] | None = None,
    divides: Bool[np.ndarray, "n 2"] | None = None,
) -> Frames:
    """Concatenate frames, as the compiled loops take them.

    Args:
        edges: Edge points of each frame, as label sets hold them, see :meth:`RoadEdges.rows`.
        lines_cm: Left and right lane line of each frame, in the direction of travel, frame car.
        points_cm: Labels of each frame; a point that is masked here stays masked.
        camera_cm: Optical centre of each frame's camera (right, ahead, up), frame car; None takes
            ``TYPICAL_CAMERA_CM`` for all.
        lane_cm: Lane width of each frame; None: not known.
        divides: Whether there is another lane beyond its left and its right line; None: nowhere.
    """
    size = len(edges)
    polylines = [np.asarray(line, np.float64) for pair in lines_cm for line in pair]
    lines_of_edges = []
    for k in range(size):
        near = np.empty(len(edges[k]), np.uint8)
        near_lines(np.asarray(edges[k], np.float32), polylines[2 * k], polylines[2 * k + 1], near)
        lines_of_edges.append(near)
    typical = np.tile(np.array(TYPICAL_CAMERA_CM), (size, 1))
    return Frames(
        edges_cm=np.concatenate([np.empty((0, 2), np.float32), *(e[:, :2] for e in edges)]).astype(
            np.float32
        ),
        edge_looks=np.concatenate([np.empty((0, 4), np.int8), *(_looks(e) for e in edges)]),
        edge_lines=np.concatenate([np.empty(0, np.uint8), *lines_of_edges]),
        edge_start=_starts(edges),
        lines_cm=np.concatenate([np.empty((0, 2)), *polylines]),
        line_start=_starts(polylines),
        points_cm=np.ascontiguousarray(points_cm, np.float64),
        camera_cm=typical if camera_cm is None else np.ascontiguousarray(camera_cm, np.float64),
        lane_cm=np.zeros(size) if lane_cm is None else np.ascontiguousarray(lane_cm, np.float64),
        divides=np.zeros((size, 2), np.bool_) if divides is None else np.ascontiguousarray(divides, np.bool_),
    )


def concat_frames(parts: Sequence[Frames]) -> Frames:
    """Join frames that :func:`join_frames` returned, in their order."""
    joined: dict[str, np.ndarray] = {}
    for name in Frames._fields:
        values = [getattr(part, name) for part in parts]
        if name.endswith("_start"):
            counts = np.concatenate([np.diff(value) for value in values])
            joined[name] = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        else:
            joined[name] = np.concatenate(values)
    return Frames(**joined)


def concat_batches(parts: Sequence[Batch]) -> Batch:
    """Join batches, in their order."""
    if len(parts) == 1:
        return parts[0]
    return Batch(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def plain_batch(frames: Frames, indices: Int[np.ndarray, "b"], window: BirdseyeWindow) -> Batch:
    """Return frames as they are, with their lane width."""
    rasters, present = _empty(len(indices), window)
    rasterise_frames(rasters, np.asarray(indices, np.int64), frames, _grid(window), present)
    labels, lane_cm = (part[indices].astype(np.float32) for part in (frames.points_cm, frames.lane_cm))
    return Batch(rasters, labels, present, lane_cm)


def augment_batch(
    frames: Frames,
    indices: Int[np.ndarray, "b"],
    window: BirdseyeWindow,
    settings: AugmentSettings,
    seed: int,
    epoch: int,
    streams: Int[np.ndarray, "b"] | None = None,
) -> Batch:
    """Change each sample of a batch by its own random draw.

    Args:
        frames: Returned by :func:`join_frames`.
        indices: Frames of the batch.
        window: Grid of the rasters.
        settings: What is changed, and by how much.
        seed: Of the run.
        epoch: Counted from 0.
        streams: Number of each sample's random stream; None takes its index. A frame that is shown twice in
            an epoch needs two.

    Returns:
        The changed samples; each follows from seed, epoch, stream and frame alone.
    """
    rasters, present = _empty(len(indices), window)
    labels, given = np.empty((len(indices), 6), np.float32), np.empty(len(indices), np.float32)
    chosen = np.asarray(indices, np.int64)
    augment_frames(
        rasters,
        labels,
        present,
        given,
        chosen,
        chosen if streams is None else np.asarray(streams, np.int64),
        seed,
        epoch,
        frames,
        _grid(window),
        _amounts(settings),
    )
    return Batch(rasters, labels, present, given)


def _looks(edges: Float[np.ndarray, "n 6"]) -> Int8[np.ndarray, "n 4"]:
    """Normals and hues in the steps of a raster."""
    return np.rint(np.float32(STEPS) * edges[:, 2:].astype(np.float32)).astype(np.int8)


def _starts(parts: Sequence[np.ndarray]) -> Int[np.ndarray, "_"]:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


def _empty(size: int, window: BirdseyeWindow) -> tuple[np.ndarray, np.ndarray]:
    shape = (size, len(PLANES), window.rows, window.columns)
    return np.empty(shape, np.uint8), np.empty((size, 2), np.float32)


def _grid(window: BirdseyeWindow) -> Grid:
    return Grid(
        np.float32(window.left_cm),
        np.float32(window.far_cm),
        np.float32(window.cell_cm),
        window.rows,
        window.columns,
        float(window.left_cm),
        float(window.right_cm),
    )


def _amounts(settings: AugmentSettings) -> Amounts:
    values = settings.model_dump()
    values["limit"] = int(values.pop("draw") == "limit")
    return Amounts(**values)
