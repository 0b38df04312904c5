"""Lane lines of the map, seen from each frame's pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.lanes.fit import LaneLine
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import N_POINTS, rows_of_polyline

_SAMPLE_CM = 2.0
_BEHIND_CM = 20.0
_AHEAD_CM = 90.0


@dataclass(frozen=True)
class FrameLines:
    """The lane of one frame.

    Attributes:
        left_cm: Left line in the direction of travel, frame car; NaN where unsupported.
        right_cm: Right line likewise.
        points_cm: The six labels; NaN where masked.
    """

    left_cm: Float[np.ndarray, "m 2"]
    right_cm: Float[np.ndarray, "m 2"]
    points_cm: Float[np.ndarray, "6"]


def lines_of_frame(
    lines: list[LaneLine], pose: Float[np.ndarray, "3"], s_cm: float, wheelbase_cm: float
) -> FrameLines:
    """Project the stretch of lane around a frame into its car frame.

    Args:
        lines: Left and right line of the driven lane.
        pose: Rear-axle pose of the frame, frame map.
        s_cm: Position of the rear axle along the driven path.
        wheelbase_cm: Distance between the axles.
    """
    s = np.arange(s_cm - _BEHIND_CM, s_cm + wheelbase_cm + _AHEAD_CM, _SAMPLE_CM)
    polylines = {
        line.side: car_from_map(line.points(s), pose, wheelbase_cm) for line in lines if line.rank == 0
    }
    left, right = polylines["left"], polylines["right"]
    points = np.concatenate([rows_of_polyline(left), rows_of_polyline(right)])
    assert points.shape == (N_POINTS,)
    return FrameLines(left, right, points)
