"""Lane lines of the map in the car frame of one image: polylines and the six labels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from lanenet.data.maps.line import LaneLine
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import N_POINTS, ROWS_CM, rows_of_polyline

#: Spacing of a polyline's points. Chosen: chords of a 50 cm bend deviate by 0.1 mm.
_SAMPLE_CM = 2.0
#: Extent of the polylines: from behind the rear axle to beyond the far edge of the bird's-eye window (72 cm).
_BEHIND_CM, _AHEAD_CM = 20.0, 90.0
#: Tangent of 60 degrees. Chosen: where a line is steeper, 1 cm along the car is 1.7 cm across a label row.
_STEEPEST = float(np.tan(np.pi / 3.0))


@dataclass(frozen=True)
class FrameLines:
    """The lane of one frame.

    Attributes:
        left_cm: Left line in the direction of travel, frame car; NaN where it is not supported.
        right_cm: Right line likewise.
        points_cm: The six labels; NaN where masked.
        markings_cm: Width of the left and the right marking; NaN if unknown.
    """

    left_cm: Float[np.ndarray, "m 2"]
    right_cm: Float[np.ndarray, "m 2"]
    points_cm: Float[np.ndarray, "6"]
    markings_cm: tuple[float, float] = (float("nan"), float("nan"))

    def without(self, hidden: Bool[np.ndarray, "2"]) -> FrameLines:
        """Mask the left, the right or both lines."""
        lines = [
            np.full_like(line, np.nan) if gone else line
            for line, gone in zip((self.left_cm, self.right_cm), hidden, strict=True)
        ]
        points_cm = np.where(np.repeat(hidden, N_POINTS // 2), np.nan, self.points_cm)
        return replace(self, left_cm=lines[0], right_cm=lines[1], points_cm=points_cm)

    def marking_cm(self, side: int, usual_cm: float) -> float:
        """Return the width of the left (0) or right (1) marking; ``usual_cm`` if it is unknown."""
        own = self.markings_cm[side]
        return own if np.isfinite(own) else usual_cm


def lines_of_frame(
    lines: list[LaneLine],
    pose: Float[np.ndarray, "3"],
    s_cm: float,
    wheelbase_cm: float,
    lane: int = 0,
    forward: bool = True,
    max_sigma_cm: float = np.inf,
) -> FrameLines:
    """Transform the lane lines around a frame into its car frame.

    Args:
        lines: Lines of the segment; a line of the lane that is not among them is unknown.
        pose: Rear-axle pose of the frame, frame map.
        s_cm: Position of the rear axle along the path.
        wheelbase_cm: Distance between the axles.
        lane: Index of the line on the left of the lane, seen in the path's direction; 0 is the driven lane.
        forward: Whether the car drives in the path's direction; if not, left and right swap.
        max_sigma_cm: A line is masked where its sigma exceeds this.
    """
    along = np.arange(-_BEHIND_CM, wheelbase_cm + _AHEAD_CM, _SAMPLE_CM)
    s = s_cm + (along if forward else -along)
    by_index = {line.index: line for line in lines}
    pair = (lane, lane + 1) if forward else (lane + 1, lane)
    bounds = [by_index.get(i) for i in pair]
    left, right = (_polyline(line, s, pose, wheelbase_cm, max_sigma_cm) for line in bounds)
    points = np.concatenate([label_rows(left), label_rows(right)])
    assert points.shape == (N_POINTS,)
    of_left, of_right = (float("nan") if line is None else line.marking_cm for line in bounds)
    return FrameLines(left, right, points, (of_left, of_right))


def label_rows(line_car_cm: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "3"]:
    """Find x where a line crosses the label rows; NaN where it crosses too obliquely or more than once.

    Args:
        line_car_cm: Polyline in the direction of travel, frame car; NaN rows break it.
    """
    found = rows_of_polyline(line_car_cm)
    x, y = line_car_cm[:, 0], line_car_cm[:, 1]
    for i, row in enumerate(ROWS_CM):
        crossed = np.flatnonzero((y[:-1] <= row) != (y[1:] <= row))
        crossed = crossed[np.isfinite(y[crossed]) & np.isfinite(y[crossed + 1])]
        sideways, ahead = (abs(part[crossed + 1] - part[crossed]) for part in (x, y))
        if len(crossed) != 1 or sideways[0] > _STEEPEST * ahead[0]:
            found[i] = np.nan
    return found


def parallel_line(line_car_cm: Float[np.ndarray, "m 2"], right_cm: float) -> Float[np.ndarray, "m 2"]:
    """Shift a polyline to its right, seen in its direction; NaN spreads to neighbouring points."""
    along = np.gradient(line_car_cm, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    return np.asarray(line_car_cm + right_cm * np.stack([along[:, 1], -along[:, 0]], axis=1))


def _polyline(
    line: LaneLine | None,
    s_cm: Float[np.ndarray, "m"],
    pose: Float[np.ndarray, "3"],
    wheelbase_cm: float,
    max_sigma_cm: float,
) -> Float[np.ndarray, "m 2"]:
    """Express a line in the car frame; NaN where it is unsupported or uncertain."""
    if line is None:
        return np.full((len(s_cm), 2), np.nan)
    polyline = car_from_map(line.points(s_cm), pose, wheelbase_cm)
    polyline[line.sigma_cm(s_cm) > max_sigma_cm] = np.nan
    return polyline
