"""Drives of which no map can be made: found early, and said with what to drive instead."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from datagen.lanes.trace import other_lane
from datagen.quality.measure import MapQuality
from datagen.quality.residuals import REFERENCE_WIDTH, summarise
from datagen.slam.odometry.stillness import small_picture
from lanenet.data.drives import Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.lane import SIDES
from lanenet.perception.edges.canny import EdgeSettings, find_edges

_LOOKS = 40
#: Pictures from all over a drive that differ by less than this [gray levels, means of blocks] are the same.
_SAME = 1.0
#: Noise and flicker change neighbours as much as frames far apart; a moving car changes these more.
_NOISY_SAME, _NOISY_RATIO = 4.0, 1.3
_LEAST_EDGES = 20
#: Dashes and worn lines show at least this share of their borders.
_LEAST_SHOWN = 0.2
#: Edges that are met by chance have a robust sd of 3 px, image 160 px wide, those of real lines 0.5 at most.
#: A line with more than this is clutter, unless so much of it is shown that it is one which the map has bent.
_CLUTTER_PX, _CLUTTER_SHOWN = 1.5, 0.4


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
        raise other_lane(lane_width_cm, free_lane_cm)
    found = ", ".join(
        f"of the {side} one {100.0 * line.coverage:.0f} % to {sd_px[side]:.1f} px"
        for side, line in lines.items()
    )
    raise TrackingLostError(
        f"{drive.path}: {'one line only bounds the driven lane' if len(clutter) == 1 else 'no lane'}: frames "
        f"held out from the map show {found} (robust sd), which for the {' and the '.join(clutter)} one is "
        "what edges meet by chance"
    )
