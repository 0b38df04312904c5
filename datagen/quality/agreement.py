"""Frames that show the lines elsewhere than the map does: where a map is bent or its poses are lost.

A wrong map agrees with itself in most places, so that its figures look well as a whole. Where it is wrong,
the frames say so: the borders of the lines meet no edge, or edges beside them. Such frames get no labels, nor
do those next to them on the road, whose near points these frames alone have seen. Where only one of the two
lines is contradicted, only that one gets none.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from datagen.quality.residuals import REFERENCE_WIDTH, BorderSamples, ResidualSettings, border_samples
from datagen.slam.camera.coarse import mapping_range
from lanenet.data.maps.mapped_drive import MappedDrive, lines_at
from lanenet.geometry.poses import path_lengths
from lanenet.perception.edges.canny import find_edges
from lanenet.perception.edges.road import RoadTable

#: One frame in so many is looked at: neighbours show the same.
_EVERY = 3
#: A frame disagrees where the edges lie further off than this as median, in pixels of an image 160 px wide,
#: or where less than this share of the borders in view met any: both lines are seldom interrupted at once.
_OFF_PX, _LEAST_MET = 1.0, 0.15
#: The same for one line where both together agree. Edges met by chance lie 2 px off as median, half the gate,
#: so that every other frame speaks against a line that is none; a lower bound masks lines that are right.
_ALONE_PX = 2.0
#: Lines that are less certain than this, in lane widths, bridge gaps: no paint is expected there.
_KNOWN_LANES = 0.02
#: Samples that tell it at least: in view, and met.
_MIN_VIEW, _MIN_MET = 15, 8
_REACH_CM = 60.0
#: Way on either side of a place over which frames are asked, and the share that has to disagree.
_AROUND_CM, _SHARE = 20.0, 0.3


def contradicted_lines(mapped: MappedDrive) -> Bool[np.ndarray, "n 2"]:
    """Find the left and right lines of the map's frames with which the pictures around disagree."""
    drive_map = mapped.drive_map
    camera, n = drive_map.camera, len(drive_map.frames)
    table = RoadTable(camera, mapping_range(camera.mounting.height_cm, mapped.perception.range))
    asked = np.arange(0, n, _EVERY)
    disagrees, told = np.zeros((len(asked), 2), dtype=bool), np.zeros(len(asked), dtype=bool)
    for i, k in enumerate(asked.tolist()):
        image = mapped.drive.image(int(mapped.rows[k]))
        edges = find_edges(image, mapped.perception.edges, table.keep, table.scale)
        samples = border_samples(
            edges,
            lines_at(drive_map, k, _KNOWN_LANES),
            drive_map.meta.tape_cm,
            drive_map.camera_at(k),
            table.keep,
            ResidualSettings(),
        )
        samples = samples.part(samples.ahead_cm < _REACH_CM)
        told[i] = len(samples.residual_px) >= _MIN_VIEW
        if told[i]:
            disagrees[i] = _disagrees(samples, camera.width)
    contradicted = np.zeros((n, 2), dtype=bool)
    way = path_lengths(drive_map.poses)
    for k in range(n):
        telling = np.flatnonzero(told & (drive_map.segment[asked] == drive_map.segment[k]))
        near = telling[np.abs(way[asked[telling]] - way[k]) < _AROUND_CM]
        if not near.size:
            # In a long gap the last frame before it and the first one after it tell.
            i = int(np.searchsorted(asked[telling], k))
            near = telling[max(i - 1, 0) : i + 1]
        if near.size:
            contradicted[k] = disagrees[near].mean(axis=0) > _SHARE
    return contradicted


def _disagrees(samples: BorderSamples, width: int) -> tuple[bool, bool]:
    """Whether a frame disagrees with its left and with its right line.

    Missing paint speaks against the map only where both lines lack it, and a line that met too few edges does
    not speak for itself.
    """
    met = samples.residual_px[samples.found]
    if met.size < _LEAST_MET * len(samples.residual_px):
        return True, True
    if _off_px(met, width) > _OFF_PX:
        # Where the frame is lost, one of its lines may meet something by chance.
        return True, True
    left, right = (
        _off_px(samples.residual_px[samples.found & (samples.right == side)], width) > _ALONE_PX
        for side in (False, True)
    )
    return left, right


def _off_px(met_px: Float[np.ndarray, "m"], width: int) -> float:
    """How far off the edges are that were met, as median, image 160 px wide; NaN where they are too few."""
    if met_px.size < _MIN_MET:
        return float("nan")
    return float(np.median(np.abs(met_px))) * REFERENCE_WIDTH / width
