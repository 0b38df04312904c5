"""Drives of which no map can be made: found early, and said with what to drive instead."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from datagen.lanes.path import Path, PathEdges
from datagen.lanes.trace import TracedLane, TraceSettings, trace_lane
from datagen.quality.figures import MappedSegment
from datagen.quality.measure import MapQuality
from datagen.quality.residuals import REFERENCE_WIDTH, summarise
from datagen.slam.odometry.stillness import small_picture
from lanenet.data.drives import Drive
from lanenet.errors import CalibrationError, TrackingLostError
from lanenet.geometry.lane import SIDES
from lanenet.perception.edges.canny import EdgeSettings, find_edges

_LOOKS = 40
#: Pictures from all over a drive that differ by less than this [gray levels, means of blocks] are the same.
_SAME = 1.0
#: Noise and flicker change neighbours as much as frames far apart; a moving car changes these more.
_NOISY_SAME, _NOISY_RATIO = 4.0, 1.3
_LEAST_EDGES = 20
#: A line that is there along less of the way than this does not bound a lane.
_LEAST_SEEN = 0.2
#: Dashes and worn lines show at least this share of their borders.
_LEAST_SHOWN = 0.2
#: Edges that are met by chance have a robust sd of 3 px, image 160 px wide, those of real lines 0.5 at most.
#: A line with more than this is clutter, unless so much of it is shown that it is one which the map has bent.
_CLUTTER_PX, _CLUTTER_SHOWN = 1.5, 0.4
#: Less than this of one line is clutter that happens to lie along the way, more than that a line.
_MAYBE_LINE, _WHOLE_LINE = 0.5, 0.9
#: A line of the given lane that is seen along less than this share of the way along which one of another
#: width is: gaps between dashes leave more.
_HARDLY = 0.4


def check_moving(drive: Drive) -> None:
    """Refuse a drive whose pictures do not change.

    Raises:
        TrackingLostError: If the car stands still; says how little changes.
    """
    at = np.unique(np.linspace(0, len(drive) - 2, _LOOKS).astype(int))
    looks = np.array([[_blocks(drive, int(k) + d) for d in (0, 1)] for k in at])
    neighbours = float(np.median(_difference(looks[:, 0], looks[:, 1])))
    # Half the drive apart, so that a lap driven twice is not compared with itself.
    spread = float(np.median(_difference(looks[:, 0], np.roll(looks[:, 0], len(at) // 3, axis=0))))
    if spread < _SAME or (spread < _NOISY_SAME and spread < _NOISY_RATIO * neighbours):
        raise TrackingLostError(
            f"{drive.path}: the car stands still: {len(drive)} frames, which differ by {spread:.1f} gray "
            f"levels from others far away and by {neighbours:.1f} from their neighbours; mapping needs a "
            "moving car"
        )


def check_edges(drive: Drive, settings: EdgeSettings) -> None:
    """Refuse a drive that shows hardly an edge where the road is, before a camera is looked for with them.

    Raises:
        TrackingLostError: Says how many edge points there are.
    """
    counts = []
    for k in np.unique(np.linspace(0, len(drive) - 1, _LOOKS).astype(int)).tolist():
        # Without a camera nobody knows the horizon; most cameras on cars show road in the lower half.
        image = drive.image(k)
        counts.append(len(find_edges(image[image.shape[0] // 2 :], settings).uv_px))
    if np.median(counts) < _LEAST_EDGES:
        raise TrackingLostError(
            f"{drive.path}: {np.median(counts):.0f} edge points in the lower half of a frame, expected "
            f"{_LEAST_EDGES}: no line to be seen"
        )


def _blocks(drive: Drive, k: int) -> Float[np.ndarray, "d"]:
    """Means of blocks of a frame, without its brightness: noise is gone, and so is most of flicker."""
    small = small_picture(drive, k).astype(np.float64)
    return (small - small.mean()).ravel()


def _difference(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.abs(a - b).mean(axis=1))


def check_lane(parts: list[MappedSegment], drive: Drive) -> None:
    """Refuse a map in which one of the lines is hardly ever seen.

    Raises:
        TrackingLostError: Says how much of the way each line was seen.
    """
    seen: dict[str, list[Bool[np.ndarray, "_"]]] = {side: [] for side in SIDES}
    for part in parts:
        for line in part.lines:
            if line.rank == 0:
                seen[line.side].append(line.supported(part.s_frames_cm))
    share = {side: float(np.mean(np.concatenate(found))) if found else 0.0 for side, found in seen.items()}
    if min(share.values()) >= _LEAST_SEEN:
        return
    found = ", ".join(f"the {side} one along {100.0 * share[side]:.0f} % of the way" for side in SIDES)
    most = max(share.values())
    what = "no line" if most < _MAYBE_LINE else "one line only" if most > _WHOLE_LINE else "one line at most"
    raise TrackingLostError(
        f"{drive.path}: {what} bounds the driven lane: {found}, expected {100.0 * _LEAST_SEEN:.0f} % for each"
    )


def check_lines_seen(
    quality: MapQuality, drive: Drive, lane_width_cm: float, free_lane_cm: float | None
) -> None:
    """Refuse lines that held-out frames do not show: clutter that happened to lie along the way.

    Args:
        quality: What held-out frames show of the map.
        drive: The drive.
        lane_width_cm: Width of the lane that was given.
        free_lane_cm: Width of the lane that is found without that number, where another one is.

    Raises:
        TrackingLostError: If they show neither line, or one line only; says how much of the lines they show.
        CalibrationError: If they show one line only, but there is a lane of another width.
    """
    near = quality.near
    coverage = summarise(near).coverage
    if coverage < _LEAST_SHOWN:
        raise TrackingLostError(
            f"{drive.path}: no lane: frames held out from the map show an edge along "
            f"{100.0 * coverage:.0f} % of what would be the borders of its lines, expected "
            f"{100.0 * _LEAST_SHOWN:.0f} %"
        )
    lines = {side: summarise(near.part(near.right == (side == "right"))) for side in SIDES}
    sd_px = {side: line.robust_sd_px * REFERENCE_WIDTH / drive.width for side, line in lines.items()}
    clutter = [side for side in SIDES if lines[side].coverage < _CLUTTER_SHOWN and sd_px[side] > _CLUTTER_PX]
    if not clutter:
        return
    if free_lane_cm is not None:
        raise _other_lane(lane_width_cm, free_lane_cm)
    found = ", ".join(
        f"of the {side} one {100.0 * line.coverage:.0f} % to {sd_px[side]:.1f} px"
        for side, line in lines.items()
    )
    raise TrackingLostError(
        f"{drive.path}: {'one line only bounds the driven lane' if len(clutter) == 1 else 'no lane'}: frames "
        f"held out from the map show {found} (robust sd), which for the {' and the '.join(clutter)} one is "
        "what edges meet by chance"
    )


def trace_known_lane(
    path: Path, edges: PathEdges, height_cm: float, lane_width_cm: float, settings: TraceSettings
) -> tuple[TracedLane, float | None]:
    """Trace the lane of the given width, and look for the lane's width without that number too.

    Returns:
        The lane, and the width of the lane that is found freely; None where none is, or where the lane of the
        given width fits the road as well.

    Raises:
        CalibrationError: If there is no lane of this width but one of another; names both.
        TrackingLostError: If there is no lane.
    """
    try:
        free: TracedLane | None = trace_lane(path, edges, height_cm, None, settings)
    except TrackingLostError:
        free = None
    lane: TracedLane | None
    try:
        lane = trace_lane(path, edges, height_cm, lane_width_cm, settings)
    except TrackingLostError:
        if free is None:
            raise
        lane = None
    if (
        free is not None
        # Clutter that lies along the way makes pairs of any width.
        and min(_seen(free)) >= _MAYBE_LINE
        and (lane is None or min(_seen(lane)) < _LEAST_SEEN)
    ):
        raise _other_lane(lane_width_cm, free.lane_cm)
    if lane is None:
        raise TrackingLostError(f"no two lines {lane_width_cm:g} cm apart run along the drive")
    return lane, free.lane_cm if free is not None and _fits_better(free, lane) else None


def _other_lane(given_cm: float, found_cm: float) -> CalibrationError:
    return CalibrationError(
        f"no two lines {given_cm:g} cm apart run along the drive, but two that are {found_cm:.0f} cm apart "
        "with this camera: check the lane width and the camera's height"
    )


def _fits_better(free: TracedLane, lane: TracedLane) -> bool:
    """Whether the lane that was found freely is more likely the driven one than that of the given width.

    The free search alone is no proof: clutter beside a line makes a narrower lane, and the far line of a road
    of two lanes, where the one in its middle is dashed, a wider one. It counts where the weaker line of the
    given lane is hardly seen beside its own, or where the car keeps to its middle and not to that of the
    given lane, as on a road of two lanes whose whole width was given.
    """
    if min(_seen(lane)) < _HARDLY * min(_seen(free)):
        return True
    aside = [abs(float(np.median(one.centre_cm))) / one.lane_cm for one in (lane, free)]
    return min(_seen(free)) >= _LEAST_SEEN and aside[0] > 0.15 and aside[1] < 0.5 * aside[0]


def _seen(lane: TracedLane) -> tuple[float, float]:
    """Share of the way along which the left and the right line were seen."""
    return float(np.isfinite(lane.left_cm).mean()), float(np.isfinite(lane.right_cm).mean())
