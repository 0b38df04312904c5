"""Checks that refuse a drive of which no map can be made."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from datagen.lanes.trace import other_lane
from datagen.quality.measure import MapQuality
from datagen.quality.residuals import REFERENCE_WIDTH, summarise
from datagen.slam.odometry.stillness import shrink_image
from lanenet.data.drives import Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.lane import SIDES
from lanenet.perception.edges.canny import EdgeSettings, find_edges

#: Frames looked at, evenly over the drive. Chosen: enough for a median, and quick.
_CHECKED = 40
#: Mean difference below which frames from all over a drive are the same, [gray levels] of block means.
#: Chosen: sensor noise of block means is a few tenths.
_SAME = 1.0
#: The same, for noisy images: below the first they are the same if distant frames differ less than the second
#: times as much as neighbours. Chosen: noise and flicker change both alike, motion changes distant frames
#: more.
_NOISY_SAME, _NOISY_RATIO = 4.0, 1.3
#: Least median number of edge points in the lower half of a frame. Chosen: one border of one line, 20 px
#: long.
_LEAST_EDGES = 20
#: Least coverage of both lines. Chosen: dashes and worn lines have more.
_LEAST_COVERAGE = 0.2
#: A line is clutter if its robust sd exceeds the first, in pixels of an image 160 px wide, and its coverage
#: is below the second; with more coverage it is a line that the map has bent. Measured: edges met by chance
#: have 3 px, real lines 0.5 px at most (:class:`datagen.quality.verdict.VerdictSettings`).
_CLUTTER_PX, _CLUTTER_COVERAGE = 1.5, 0.4


def check_moving(drive: Drive) -> None:
    """Refuse a drive whose images do not change.

    Raises:
        TrackingLostError: If the car stands still; names the changes.
    """
    at = np.unique(np.linspace(0, len(drive) - 2, _CHECKED).astype(int))
    blocks = np.array([[_blocks(drive, int(k) + d) for d in (0, 1)] for k in at])
    neighbours = float(np.median(_difference(blocks[:, 0], blocks[:, 1])))
    # Half the drive apart, so that a lap driven twice is not compared with itself.
    spread = float(np.median(_difference(blocks[:, 0], np.roll(blocks[:, 0], len(at) // 3, axis=0))))
    if spread < _SAME or (spread < _NOISY_SAME and spread < _NOISY_RATIO * neighbours):
        raise TrackingLostError(
            f"{drive.path}: the car stands still: {len(drive)} frames, which differ by {spread:.1f} gray "
            f"levels from distant ones and by {neighbours:.1f} from their neighbours; mapping needs a "
            "moving car"
        )


def check_edges(drive: Drive, settings: EdgeSettings) -> None:
    """Refuse a drive with hardly any edges on the road, before the camera is searched for.

    Raises:
        TrackingLostError: Names the number of edge points.
    """
    counts = []
    for k in np.unique(np.linspace(0, len(drive) - 1, _CHECKED).astype(int)).tolist():
        # The horizon is unknown without a camera; most cameras show road in the lower half.
        image = drive.image(k)
        counts.append(len(find_edges(image[image.shape[0] // 2 :], settings).uv_px))
    if np.median(counts) < _LEAST_EDGES:
        raise TrackingLostError(
            f"{drive.path}: {np.median(counts):.0f} edge points in the lower half of a frame, expected "
            f"{_LEAST_EDGES} at least: no line is visible"
        )


def _blocks(drive: Drive, k: int) -> Float[np.ndarray, "d"]:
    """Block means of a frame relative to its brightness: suppresses noise and flicker."""
    small = shrink_image(drive.image(k)).astype(np.float64)
    return (small - small.mean()).ravel()


def _difference(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.abs(a - b).mean(axis=1))


def check_lines_seen(
    quality: MapQuality, drive: Drive, lane_width_cm: float, free_lane_cm: float | None
) -> None:
    """Refuse lines that held-out frames do not show: clutter along the path.

    Args:
        quality: The map compared with its held-out frames.
        drive: The drive.
        lane_width_cm: The given lane width.
        free_lane_cm: Lane width found without the given one, if it fits better; else None.

    Raises:
        TrackingLostError: If the frames show at most one of the lines; names the coverage.
        CalibrationError: If they show at most one, but there is a lane of another width.
    """
    near = quality.near
    coverage = summarise(near).coverage
    if coverage < _LEAST_COVERAGE:
        raise TrackingLostError(
            f"{drive.path}: no lane: held-out frames show an edge along {100.0 * coverage:.0f} % of the "
            f"borders of its lines, expected {100.0 * _LEAST_COVERAGE:.0f} % at least"
        )
    lines = {side: summarise(near.select(near.right == (side == "right"))) for side in SIDES}
    sd_px = {side: line.robust_sd_px * REFERENCE_WIDTH / drive.width for side, line in lines.items()}
    clutter = [
        side for side in SIDES if lines[side].coverage < _CLUTTER_COVERAGE and sd_px[side] > _CLUTTER_PX
    ]
    if not clutter:
        return
    if free_lane_cm is not None:
        raise other_lane(lane_width_cm, free_lane_cm)
    found = ", ".join(
        f"of the {side} one {100.0 * line.coverage:.0f} % to {sd_px[side]:.1f} px"
        for side, line in lines.items()
    )
    raise TrackingLostError(
        f"{drive.path}: {'one line only bounds the driven lane' if len(clutter) == 1 else 'no lane'}: "
        f"held-out frames show {found} (robust sd); for the {' and the '.join(clutter)} one these are edges "
        "met by chance"
    )
