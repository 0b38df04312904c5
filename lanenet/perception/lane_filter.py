"""Kozlowski's lane feature filter: two markings of the right thickness, a lane's width apart, on one row.

The filter fits no curve; in the paper it knows nothing but distances between edge points of the bird's-eye
view. It is the paper's onboard detector, and a baseline for every other one.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.errors import CalibrationError
from lanenet.geometry.lane import N_POINTS, ROWS_CM
from lanenet.geometry.steering import proportional_angle_rad
from lanenet.perception.birdseye import RoadEdgeExtractor
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.lane_filter_settings import PAPER, LaneFilterSettings
from lanenet.perception.lane_rows import find_row

__all__ = ["PAPER", "LaneFilter", "LaneFilterSettings", "find_row"]

_Pair = tuple[float, float]


class LaneFilter:
    """The lane feature filter as a detector.

    Rows 15 and 30 are measured. Row 0, which no frame sees, lies on the straight line through them; where
    they contradict each other, only row 15 is answered. The centres found in a frame are expected in the
    next one; a row that finds nothing starts again straight ahead.
    """

    def __init__(self, extractor: RoadEdgeExtractor | None, settings: LaneFilterSettings) -> None:
        """Build the filter; without an extractor it works on edge points alone."""
        self.extractor = extractor
        self.settings = settings
        self._centre_cm: dict[float, float] = {}

    def reset(self) -> None:
        """Forget the centres of earlier frames."""
        self._centre_cm = {}

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame.

        Raises:
            CalibrationError: If the frame's size is not the camera's, or there is no extractor.
        """
        if self.extractor is None:
            raise CalibrationError("lane filter: built without a camera, it takes edge points, not frames")
        edges = self.extractor.extract(frame_bgr)
        if self.extractor.is_crowded(len(edges.points_cm), self.settings.max_edge_share):
            self.reset()
            return LaneEstimate()
        return self.estimate(edges.points_cm, edges.normals)

    def estimate(
        self, points_cm: Float[np.ndarray, "n 2"], normals: Float[np.ndarray, "n 2"] | None = None
    ) -> LaneEstimate:
        """Find the lane in the edge points of one frame.

        Args:
            points_cm: Edge points, [cm], frame car.
            normals: Unit vectors across the edges, towards the brighter side; None leaves out what needs
                them, as :func:`find_row` does.

        Returns:
            The lane; its confidence is the share of the two measured rows that have one, and the standard
            deviations are unknown.
        """
        near_cm, far_cm = ROWS_CM[1:]
        near = self._track(points_cm, normals, near_cm, 0.0)
        straight_on_cm = 0.0 if near is None else _centre(near)
        far = self._track(points_cm, normals, far_cm, straight_on_cm)
        if near is not None and far is not None and self._contradict(near, far):
            far = None
            self._centre_cm.pop(far_cm)
        points = np.full((2, len(ROWS_CM)), np.nan)
        if near is not None:
            points[:, 1] = near
        if far is not None:
            points[:, 2] = far
        # NaN unless both rows are known.
        points[:, 0] = points[:, 1] - (points[:, 2] - points[:, 1]) * near_cm / (far_cm - near_cm)
        return LaneEstimate(
            points_cm=points.reshape(N_POINTS),
            steering_rad=self._steering_rad(points_cm, normals, near, far),
            confidence=0.5 * (near is not None) + 0.5 * (far is not None),
        )

    def _contradict(self, near: _Pair, far: _Pair) -> bool:
        """Tell whether no lane goes through both rows."""
        settings = self.settings
        if settings.max_centre_jump is None:
            return False
        jump_cm = abs(_centre(far) - _centre(near))
        # A lane that leads to the side is wider along a row than across.
        oblique = math.hypot(1.0, jump_cm / (ROWS_CM[2] - ROWS_CM[1]))
        wider_cm = (far[1] - far[0]) - (near[1] - near[0])
        slack_cm = settings.lane_width_tolerance_cm + settings.lane_width_cm * (oblique - 1.0)
        return jump_cm > settings.max_centre_jump * settings.lane_width_cm or abs(wider_cm) > slack_cm

    def _steering_rad(
        self,
        points_cm: Float[np.ndarray, "n 2"],
        normals: Float[np.ndarray, "n 2"] | None,
        near: _Pair | None,
        far: _Pair | None,
    ) -> float:
        look_ahead_cm = self.settings.look_ahead_cm
        if look_ahead_cm == ROWS_CM[1]:
            pair = near
        elif look_ahead_cm == ROWS_CM[2]:
            pair = far
        else:
            pair = self._track(points_cm, normals, look_ahead_cm, 0.0)
        if pair is None:
            return float("nan")
        return proportional_angle_rad(_centre(pair), look_ahead_cm)

    def _track(
        self,
        points_cm: Float[np.ndarray, "n 2"],
        normals: Float[np.ndarray, "n 2"] | None,
        y_cm: float,
        otherwise_cm: float,
    ) -> _Pair | None:
        """Find a row near its centre of the frame before, or near ``otherwise_cm`` where there was none."""
        expected_cm = self._centre_cm.get(y_cm, otherwise_cm)
        pair = find_row(points_cm, y_cm, self.settings, expected_cm, normals)
        if pair is None:
            self._centre_cm.pop(y_cm, None)
        else:
            self._centre_cm[y_cm] = _centre(pair)
        return pair


def _centre(pair: _Pair) -> float:
    return 0.5 * (pair[0] + pair[1])
