"""The width of the markings, and of the driven lane if it is not given.

Two lines side by side are not necessarily the lane. Where three lines run side by side at equal distances,
the road has two lanes, or one lane with a line in its middle. The car decides: if it keeps to one half, that
half is its lane; if it drives on the middle line or changes sides often, its lane is the whole road.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.follow import Markings, TraceSettings
from datagen.lanes.path import Path, Samples
from datagen.lanes.profile import EdgeProfile, shifted
from lanenet.errors import TrackingLostError

#: Ratio of two line distances at which one counts as half of the other. Chosen: widths are known to a cell of
#: 0.06 camera heights, 3 % of a usual lane.
_HALF = (0.44, 0.56)
#: Least support of lines at half or twice the distance of the best ones. Chosen: one of them may be dashed.
_AS_WELL = 0.8
#: Least support of each of three lines relative to what lies in the middles of the two lanes. Chosen: on a
#: mottled floor, any place across the road has some support.
_CLEAR = 1.25
#: Largest offset of the car from the centre of its lane, as a share of the lane's width. Chosen: a pair of
#: lines further off is half of a lane, next to a crack or shadow that the car drives over.
_OFF_CENTRE = 0.4
#: Offsets from the middle of a road with two lanes, in widths of the road. Derived: beyond the first, the car
#: is nearer to the centre of one lane (at 0.25) than to the middle; beyond the second, it is not on the road.
_IN_HALF, _ON_ROAD = 0.125, 1.0
#: Least share of frames in the same half of the road if the car keeps to it. Measured on simulated drives in
#: one of two lanes: 0.88 with wide swerves, else 0.96 and more.
_MOST = 0.5


def find_tape_width(
    profile: EdgeProfile, driven: int, camera_height_cm: float, settings: TraceSettings
) -> float:
    """Find the width at which left and right edges pair up best, over the driven section."""
    low, high = (t * camera_height_cm for t in settings.tape_heights)
    widths = np.arange(low, high, 0.5 * profile.cell_cm)
    # The six best pairings at each position: two or three lines, each some cells wide.
    scores = [np.sort(profile.tapes(w)[:driven], axis=1)[:, -6:].mean() for w in widths]
    return float(widths[int(np.argmax(gaussian_filter1d(np.array(scores), 1.0)))])


def find_lane_width(markings: Markings, driven: int, camera_height_cm: float) -> float:
    """Find the distance at which two markings run along the path, one on either side of the car.

    Args:
        markings: Where markings may lie.
        driven: Number of path samples that the car has driven over.
        camera_height_cm: Sets the scale of bounds.

    Raises:
        TrackingLostError: If no two lines run side by side.
    """
    profile, support = markings.profile, markings.support[:driven]
    low, high = (w * camera_height_cm for w in markings.settings.lane_heights)
    widths = np.arange(low, high, 2.0 * profile.cell_cm)
    scores = []
    for width in widths:
        cells = 0.5 * width / profile.cell_cm
        pair = shifted(support, cells) * shifted(support, -cells)
        within = int(_OFF_CENTRE * width / profile.cell_cm)
        inside = pair[:, profile.half_cells - within : profile.half_cells + within + 1]
        scores.append(np.sqrt(inside).max(axis=1).mean())
    score = gaussian_filter1d(np.array(scores), 1.5)
    peaks = [i for i in range(1, len(score) - 1) if score[i] >= score[i - 1] and score[i] > score[i + 1]]
    if not peaks:
        raise TrackingLostError("no two lines run side by side along the drive, so its scale is unknown")
    peaks.sort(key=lambda i: -score[i])
    best = peaks[0]
    for other in peaks[1:]:
        half, whole = sorted((float(widths[best]), float(widths[other])))
        if score[other] < _AS_WELL * score[best] or not _HALF[0] < half / whole < _HALF[1]:
            continue
        _, middle = markings.best_lane(whole)
        if _has_middle_line(markings, middle, whole):
            return half if _keeps_to_a_half(markings.path, middle, whole) else whole
    return float(widths[best])


def _has_middle_line(markings: Markings, middle_cm: Samples, whole_cm: float) -> bool:
    """Whether three lines run along the road."""
    band_cm = (max(_HALF) - 0.5) * whole_cm
    left, left_lane, middle, right_lane, right = (
        markings.mean_support(markings.follow(middle_cm + share * whole_cm, band_cm))
        for share in (0.5, 0.25, 0.0, -0.25, -0.5)
    )
    return min(left, middle, right) >= _CLEAR * max(left_lane, right_lane)


def _keeps_to_a_half(path: Path, middle_cm: Samples, whole_cm: float) -> bool:
    """Whether the car is most of the time in the same half of the road, in its direction of travel."""
    middle = np.interp(path.s_frames_cm, path.s_cm, middle_cm, period=path.period_cm)
    offset = path.offsets_cm - middle
    left = np.where(path.drives_forward, offset, -offset) / whole_cm
    left = left[np.abs(left) < _ON_ROAD]
    return bool(max(np.sum(left > _IN_HALF), np.sum(left < -_IN_HALF)) > _MOST * len(left))
