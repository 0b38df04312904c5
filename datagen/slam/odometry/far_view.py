"""How far the car turned from image to image, by what is far away.

Walls and what stands before them move across the image when the car turns, and hardly when it drives. That
shows a turn where the road does not: in blur, in a slide, on a road whose lines look alike. How many pixels a
turn is depends on a lens that may not be known, and some drives show nothing in the distance but the sky, or
lamps that move with the car. The shifts therefore count only where they agree with the turns by the road in
most of the drive, and in the scale that those give.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import to_gray

#: What is this far away on the ground, in camera heights, and all above it counts as far. With a focal length
#: of 80 px, a step of half a camera height moves that row by 0.6 px.
_FAR_HEIGHTS = 8.0
#: Width at which images are compared, that of a Donkeycar tub, and the fewest rows that tell anything.
_WIDTH, _LEAST_ROWS = 160, 12
#: Correlation peak from which a shift is believed, and the largest such shift as a share of the width.
#: Chosen: well above the peak of noise; a larger shift leaves too little overlap.
_LEAST_PEAK, _MOST_SHIFT = 0.3, 0.25
#: Least standard deviation of a view, gray levels: less is the noise of a blank wall.
_LEAST_CONTRAST = 2.0
#: Frames, correlation with the turns by the road, and share of inliers that are needed. Chosen: 50 frames are
#: two to five seconds; lamps that move with the car, and blank distance, must stay below the others.
_LEAST_FRAMES, _LEAST_CORRELATION, _LEAST_SHARE = 50, 0.8, 0.6
#: Inliers are within so many sigmas; rounds of the fit without the others. Chosen: usual for a robust fit.
_INLIER, _ROUNDS = 4.0, 5
#: Factor on the turns that the lens gives, at most, either way: a guessed lens is not further off.
_LENS_FACTOR = 2.0
#: Least sigma of such a turn, [rad]: a third of a pixel of a lens of 80 px.
_LEAST_SIGMA_RAD = 0.004


@dataclass(frozen=True)
class SeenTurns:
    """Turns as seen in the distance.

    Attributes:
        turns_rad: Turn from the frame before, positive left; NaN where it was not seen.
        sigma_rad: Standard deviation of each.
    """

    turns_rad: Float[np.ndarray, "n"]
    sigma_rad: float


def far_turns(drive: Drive, camera: Camera) -> Float[np.ndarray, "n"]:
    """Measure how far the distance turned from each frame to the next, in the scale of the given camera.

    Returns:
        Turns, positive left, [rad]; NaN for the first frame, and where nothing was recognised.

    Source:
        Phase correlation: Kuglin and Hines 1975; here OpenCV's.
    """
    turns = np.full(len(drive), np.nan)
    m = camera.mounting
    far = [[m.right_of_centre_cm, m.ahead_of_front_axle_cm + _FAR_HEIGHTS * m.height_cm]]
    width = min(_WIDTH, camera.width)
    scale = width / camera.width
    row = float(camera.project_ground(np.array(far))[0, 1])
    rows = int(scale * row) if np.isfinite(row) else 0
    if rows < _LEAST_ROWS * width / _WIDTH:
        return turns
    rows = min(rows, round(scale * camera.height))
    window = cv2.createHanningWindow((width, rows), cv2.CV_32F)
    before: Float32[np.ndarray, "h w"] | None = None
    for k in range(len(drive)):
        view = _far_view(drive, k, width, rows, scale)
        blank = float(view.std()) < _LEAST_CONTRAST
        # Without the mean: the window itself would look alike in all images.
        view = (view - view.mean()) * window
        if before is not None and not blank:
            (right_px, _), peak = cv2.phaseCorrelate(before.copy(), view.copy())
            if peak > _LEAST_PEAK and abs(right_px) < _MOST_SHIFT * width:
                turns[k] = right_px / (scale * camera.K[0, 0])
        before = None if blank else view
    return turns


def seen_turns(far_rad: Float[np.ndarray, "n"], turns_rad: Float[np.ndarray, "n"]) -> SeenTurns | None:
    """Compare the turns by the distance with those by the road, and bring them to the scale of the latter.

    Args:
        far_rad: See :func:`far_turns`.
        turns_rad: Turns by the road.

    Returns:
        None where the two do not agree.
    """
    known = np.isfinite(far_rad)
    known[:1] = False
    x, y = far_rad[known], turns_rad[known]
    if len(x) < _LEAST_FRAMES or not np.any(x):
        return None
    factor = _median_ratio(x, y)
    for _ in range(_ROUNDS):
        miss = np.abs(y - factor * x)
        sigma = max(1.4826 * float(np.median(miss)), _LEAST_SIGMA_RAD)
        kept: Bool[np.ndarray, "m"] = miss < _INLIER * sigma
        factor = float(x[kept] @ y[kept] / max(x[kept] @ x[kept], 1e-12))
    moved = np.std(x[kept]) > 0.0 and np.std(y[kept]) > 0.0
    if not moved or np.corrcoef(x[kept], y[kept])[0, 1] < _LEAST_CORRELATION:
        return None
    if kept.mean() < _LEAST_SHARE or not 1.0 / _LENS_FACTOR < factor < _LENS_FACTOR:
        return None
    return SeenTurns(factor * far_rad, sigma)


def _median_ratio(x: Float[np.ndarray, "m"], y: Float[np.ndarray, "m"]) -> float:
    """Slope through the origin with the least absolute errors; turns that the road misses are outliers."""
    moved = x != 0.0
    ratio, weight = y[moved] / x[moved], np.abs(x[moved])
    order = np.argsort(ratio)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    return float(ratio[order[half]])


def _far_view(drive: Drive, k: int, width: int, rows: int, scale: float) -> Float32[np.ndarray, "h w"]:
    gray = to_gray(drive.image(k))[: int(np.ceil(rows / scale))]
    if gray.shape != (rows, width):
        gray = cv2.resize(gray, (width, rows), interpolation=cv2.INTER_AREA)
    return gray.astype(np.float32)
