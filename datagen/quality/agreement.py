"""Frames that contradict the map: where the map is bent or its poses are lost.

A map that is wrong in one place has good figures as a whole. At that place, the frames contradict it: the
borders of its lines meet no edge, or edges beside them. Such frames get no labels, and neither do frames
close to them on the road, since only these frames saw their near points. If one of the two lines is
contradicted, only that line is masked.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from datagen.quality.residuals import REFERENCE_WIDTH, BorderSamples, border_samples
from datagen.slam.view import mapping_range
from lanenet.data.maps.mapped_drive import MappedDrive, lines_at
from lanenet.geometry.poses import path_lengths
from lanenet.perception.edges.canny import find_edges
from lanenet.perception.edges.road import RoadTable

#: Every how many frames one is checked. Chosen: neighbouring frames show nearly the same.
_EVERY = 3
#: A frame contradicts the map if the median distance of the edges exceeds the first, in pixels of an image
#: 160 px wide, or if the coverage is below the second. Chosen: right maps keep below 0.5 px; both lines are
#: seldom interrupted at once.
_OFF_PX, _LEAST_MET = 1.0, 0.15
#: The same for one line, if both together agree. Derived: edges met by chance have a median of 2 px, half the
#: gate, so every other frame contradicts a wrong line; a lower bound masks lines that are right.
_ALONE_PX = 2.0
#: Sigma up to which a line is checked, in lane widths. Chosen: lines with a larger sigma bridge gaps, where
#: no paint is expected.
_KNOWN_LANES = 0.02
#: Least number of samples of a frame: in view, and with an edge. Chosen: one border over 15 cm.
_MIN_VIEW, _MIN_MET = 15, 8
#: Samples up to this distance ahead count. Chosen: twice the farthest label row.
_REACH_CM = 60.0
#: Distance along the path up to which frames count for a place, and the share that has to contradict the map.
#: Chosen: a single bad frame is outvoted, and an error over 20 cm of road is not.
_AROUND_CM, _SHARE = 20.0, 0.3


def contradicted_lines(mapped: MappedDrive) -> Bool[np.ndarray, "n 2"]:
    """Return which left and right lines of the map's frames are contradicted by the images around."""
    drive_map = mapped.drive_map
    camera, n = drive_map.camera, len(drive_map.frames)
    table = RoadTable(camera, mapping_range(camera.mounting.height_cm, mapped.perception.range))
    checked = np.arange(0, n, _EVERY)
    against, counts = np.zeros((len(checked), 2), dtype=bool), np.zeros(len(checked), dtype=bool)
    for i, k in enumerate(checked.tolist()):
        image = mapped.drive.image(int(mapped.rows[k]))
        edges = find_edges(image, mapped.perception.edges, table.keep, table.scale)
        samples = border_samples(
            edges,
            lines_at(drive_map, k, _KNOWN_LANES),
            drive_map.meta.tape_cm,
            drive_map.camera_at(k),
            table.keep,
        )
        samples = samples.select(samples.ahead_cm < _REACH_CM)
        counts[i] = len(samples.residual_px) >= _MIN_VIEW
        if counts[i]:
            against[i] = _contradicts(samples, camera.width)
    contradicted = np.zeros((n, 2), dtype=bool)
    distance = path_lengths(drive_map.poses)
    for k in range(n):
        valid = np.flatnonzero(counts & (drive_map.segment[checked] == drive_map.segment[k]))
        near = valid[np.abs(distance[checked[valid]] - distance[k]) < _AROUND_CM]
        if not near.size:
            # In a long gap, the last frame before it and the first one after it decide.
            i = int(np.searchsorted(checked[valid], k))
            near = valid[max(i - 1, 0) : i + 1]
        if near.size:
            contradicted[k] = against[near].mean(axis=0) > _SHARE
    return contradicted


def _contradicts(samples: BorderSamples, width: int) -> tuple[bool, bool]:
    """Whether a frame contradicts its left and its right line.

    Missing paint counts against the map only where both lines lack it; a line that met too few edges by
    itself is not contradicted.
    """
    met = samples.residual_px[samples.found]
    if met.size < _LEAST_MET * len(samples.residual_px):
        return True, True
    if _off_px(met, width) > _OFF_PX:
        # Both: if the pose is lost, one of the lines may meet edges by chance.
        return True, True
    left, right = (
        _off_px(samples.residual_px[samples.found & (samples.right == side)], width) > _ALONE_PX
        for side in (False, True)
    )
    return left, right


def _off_px(met_px: Float[np.ndarray, "m"], width: int) -> float:
    """Median distance of the edges, in pixels of an image 160 px wide; NaN if they are too few."""
    if met_px.size < _MIN_MET:
        return float("nan")
    return float(np.median(np.abs(met_px))) * REFERENCE_WIDTH / width
