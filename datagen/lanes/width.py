"""How wide the markings are and the driven lane is, where nobody has said so.

Two lines side by side are not yet a lane. Where three lines run side by side at even distances, the road has
two lanes, or it is one with a line in its middle: which of the two tells the car. One that keeps to the
middle of one half drives in a lane of that width; one that drives on the middle line, or changes sides all
the time, has the whole road for its lane.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from datagen.lanes.follow import TraceSettings, best_lane, follow_line
from datagen.lanes.path import Path
from datagen.lanes.profile import EdgeProfile, shifted
from lanenet.errors import TrackingLostError

#: Shares of the distance of two lines within which a third one lies in the middle between them.
_HALF = (0.44, 0.56)
#: How well lines have to be seen at half or twice the distance of those seen best: one may be dashed.
_AS_WELL = 0.8
#: How much better each of three lines is seen than what lies between them, in the middles of the two lanes.
_CLEAR = 1.25
#: How far off the middle of its lane the car may drive, as a share of the lane's width: what is further off
#: is half of a lane, beside a crack or a shadow that it drives over.
_OFF_CENTRE = 0.4
#: A car that is further than this off the middle of a road of two lanes, in widths of the road, is nearer to
#: the middle of one lane than to that of the road; one that is further off than this is not on it.
_IN_HALF, _ON_ROAD = 0.125, 1.0
#: Share of the frames that a car is in the same half of the road if it keeps to it: on simulated drives in
#: one of two lanes 0.88 with wide swerves, else 0.96 and more.
_MOST = 0.5


def find_tape_width(
    profile: EdgeProfile, driven: int, camera_height_cm: float, settings: TraceSettings
) -> float:
    """Width at which left and right edges pair up best, over the driven stretch."""
    low, high = (t * camera_height_cm for t in settings.tape_heights)
    widths = np.arange(low, high, 0.5 * profile.cell_cm)
    # The best pairing at each path position, on either side; a wrong width pairs by chance only.
    scores = [np.sort(profile.tapes(w)[:driven], axis=1)[:, -6:].mean() for w in widths]
    return float(widths[int(np.argmax(gaussian_filter1d(np.array(scores), 1.0)))])


def find_lane_width(
    path: Path,
    tapes: Float[np.ndarray, "m c"],
    profile: EdgeProfile,
    driven: int,
    camera_height_cm: float,
    settings: TraceSettings,
) -> float:
    """Distance at which two markings run side by side along the path, one on either side of the car.

    Args:
        path: The path, with the frames' places on it.
        tapes: Support of a marking at each place of the profile.
        profile: Density of edges.
        driven: Samples of the path that the car has driven over.
        camera_height_cm: Sets the scale of bounds.
        settings: Bounds.

    Raises:
        TrackingLostError: If no two lines run side by side.
    """
    low, high = (w * camera_height_cm for w in settings.lane_heights)
    widths = np.arange(low, high, 2.0 * profile.cell_cm)
    scores = []
    for width in widths:
        cells = 0.5 * width / profile.cell_cm
        pair = shifted(tapes[:driven], cells) * shifted(tapes[:driven], -cells)
        within = int(_OFF_CENTRE * width / profile.cell_cm)
        scores.append(
            np.sqrt(pair[:, profile.half_cells - within : profile.half_cells + within + 1]).max(axis=1).mean()
        )
    score = gaussian_filter1d(np.array(scores), 1.5)
    peaks = [i for i in range(1, len(score) - 1) if score[i] >= score[i - 1] and score[i] > score[i + 1]]
    if not peaks:
        raise TrackingLostError("no two lines run side by side along the drive, so that its scale is unknown")
    peaks.sort(key=lambda i: -score[i])
    best = peaks[0]
    for other in peaks[1:]:
        half, whole = sorted((float(widths[best]), float(widths[other])))
        if score[other] < _AS_WELL * score[best] or not _HALF[0] < half / whole < _HALF[1]:
            continue
        _, middle = best_lane(path, tapes, profile, whole, settings)
        if _has_middle_line(path, tapes, profile, middle, whole, settings):
            return half if _keeps_to_a_half(path, middle, whole) else whole
    return float(widths[best])


def _has_middle_line(
    path: Path,
    tapes: Float[np.ndarray, "m c"],
    profile: EdgeProfile,
    middle_cm: Float[np.ndarray, "m"],
    whole_cm: float,
    settings: TraceSettings,
) -> bool:
    """Whether three lines run along a road: on a mottled floor any place across it looks half like one."""
    left, left_lane, middle, right_lane, right = (
        _followed_support(path, tapes, profile, middle_cm + share * whole_cm, whole_cm, settings)
        for share in (0.5, 0.25, 0.0, -0.25, -0.5)
    )
    return min(left, middle, right) >= _CLEAR * max(left_lane, right_lane)


def _keeps_to_a_half(path: Path, middle_cm: Float[np.ndarray, "m"], whole_cm: float) -> bool:
    """Whether the car is in the same half of the road, as it drives, most of the time."""
    middle = np.interp(path.s_frames_cm, path.s_cm, middle_cm, period=path.period_cm)
    beside = path.offsets_cm - middle
    left = np.where(path.drives_forward, beside, -beside) / whole_cm
    left = left[np.abs(left) < _ON_ROAD]
    return bool(max(np.sum(left > _IN_HALF), np.sum(left < -_IN_HALF)) > _MOST * len(left))


def _followed_support(
    path: Path,
    tapes: Float[np.ndarray, "m c"],
    profile: EdgeProfile,
    guess_cm: Float[np.ndarray, "m"],
    whole_cm: float,
    settings: TraceSettings,
) -> float:
    """Mean support of the marking, or what looks most like one, that runs about these offsets."""
    followed = follow_line(path, tapes, profile, guess_cm, (max(_HALF) - 0.5) * whole_cm, settings)
    column = np.rint(followed / profile.cell_cm).astype(np.intp) + profile.half_cells
    return float(tapes[np.arange(len(tapes)), np.clip(column, 0, tapes.shape[1] - 1)].mean())
