"""Kozlowski's lane feature filter: two markings of the right thickness, a lane's width apart, on one row.

The filter fits no curve and knows nothing but distances between edge points of the bird's-eye view. It is the
paper's onboard detector, and a baseline for every other one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import CalibrationError
from lanenet.geometry.lane import N_POINTS, ROWS_CM
from lanenet.geometry.steering import proportional_angle_rad
from lanenet.perception.birdseye import RoadEdgeExtractor
from lanenet.perception.estimate import LaneEstimate


class LaneFilterSettings(Settings):
    """What the filter takes for a lane.

    Attributes:
        lane_width_cm: Distance between the middles of the two lines of the driven lane.
        lane_width_tolerance_cm: How far a pair of markings may be from that.
        marking_cm: Thickness of a marking (tape).
        marking_tolerance_cm: How far a pair of edges may be from that; edges are a pixel of road uncertain.
        grid_cm: Grid to whose nodes the points are moved.
        row_cm: Extent along y of the points that count as one row. The paper's grid rows are finer than a
            pixel (6 mm), so a single one seldom holds all four edges.
        row_tolerance_cm: How far from the wanted row a row is looked for when that one has no lane.
        look_ahead_cm: Distance of the point A that is steered at.
        max_edge_share: With more edge points than this share of the pixels that see the road, every distance
            occurs by chance, and a frame gives no lane.
    """

    lane_width_cm: float = Field(gt=0.0)
    lane_width_tolerance_cm: float = Field(default=4.0, gt=0.0)
    marking_cm: float = Field(default=2.0, gt=0.0)
    marking_tolerance_cm: float = Field(default=0.8, gt=0.0)
    grid_cm: float = Field(default=0.2, gt=0.0)
    row_cm: float = Field(default=0.6, gt=0.0)
    row_tolerance_cm: float = Field(default=2.4, ge=0.0)
    look_ahead_cm: float = Field(default=15.0, gt=0.0)
    max_edge_share: float = Field(default=0.15, gt=0.0, le=1.0)


def find_row(
    points_cm: Float[np.ndarray, "n 2"],
    y_cm: float,
    settings: LaneFilterSettings,
    expected_centre_cm: float = 0.0,
) -> tuple[float, float] | None:
    """Find the left and the right line on one row.

    The wanted row is tried first, then its neighbours outward, near before far; the first row that satisfies
    the conditions ends the search.

    Args:
        points_cm: Edge points, [cm], frame car; points that are not finite are ignored.
        y_cm: The wanted row.
        settings: The lane's distances and their tolerances.
        expected_centre_cm: Of several pairs the one whose centre is nearest to this counts.

    Returns:
        x of the middles of the left and right marking, [cm], frame car, or None if no row has a lane.

    Source:
        Kozlowski et al. 2024, section 2.2. The order of the rows, the row's extent and the choice among
        several pairs are not in the paper.
    """
    near = np.abs(points_cm[:, 1] - y_cm) <= settings.row_tolerance_cm + settings.row_cm
    band = points_cm[near & np.isfinite(points_cm[:, 0])]
    steps = int(settings.row_tolerance_cm / settings.row_cm + 1e-9)
    for step in sorted(range(-steps, steps + 1), key=lambda k: (abs(k), k)):
        row = np.abs(band[:, 1] - (y_cm + step * settings.row_cm)) <= 0.5 * settings.row_cm
        nodes = np.unique(np.rint(band[row, 0] / settings.grid_cm).astype(np.int64))
        pair = _lane_of(_markings_cm(nodes, settings), settings, expected_centre_cm)
        if pair is not None:
            return pair
    return None


def _markings_cm(nodes: Int[np.ndarray, "n"], settings: LaneFilterSettings) -> Float[np.ndarray, "m"]:
    """Middles of all pairs of grid nodes whose spacing is a marking's thickness, sorted, [cm]."""
    low = np.ceil((settings.marking_cm - settings.marking_tolerance_cm) / settings.grid_cm - 1e-9)
    high = np.floor((settings.marking_cm + settings.marking_tolerance_cm) / settings.grid_cm + 1e-9)
    spacings = np.arange(max(int(low), 1), int(high) + 1)
    paired = np.isin(nodes[:, None] + spacings, nodes)
    # Twice the middle stays an integer, so equal middles of different pairs count once.
    return np.unique((2 * nodes[:, None] + spacings)[paired]) * (0.5 * settings.grid_cm)


def _lane_of(
    markings_cm: Float[np.ndarray, "m"], settings: LaneFilterSettings, expected_centre_cm: float
) -> tuple[float, float] | None:
    """The two markings a lane's width apart whose centre is nearest to the expected one."""
    if markings_cm.size < 2:
        return None
    slack = settings.lane_width_tolerance_cm + 1e-9
    first = np.searchsorted(markings_cm, markings_cm + settings.lane_width_cm - slack, side="left")
    # A tolerance wider than the lane must not pair a marking with itself.
    first = np.maximum(first, np.arange(markings_cm.size) + 1)
    last = np.searchsorted(markings_cm, markings_cm + settings.lane_width_cm + slack, side="right") - 1
    has_partner = np.flatnonzero(first <= last)
    if has_partner.size == 0:
        return None
    first, last, left = first[has_partner], last[has_partner], markings_cm[has_partner]
    # For each left line the best right line mirrors it about the expected centre, if a marking lies there.
    wanted = 2.0 * expected_centre_cm - left
    above = np.clip(np.searchsorted(markings_cm, wanted), first, last)
    below = np.clip(above - 1, first, last)
    nearer = np.abs(markings_cm[below] - wanted) < np.abs(markings_cm[above] - wanted)
    right = markings_cm[np.where(nearer, below, above)]
    best = int(np.argmin(np.abs(0.5 * (left + right) - expected_centre_cm)))
    return _middle(markings_cm, left[best], settings), _middle(markings_cm, right[best], settings)


def _middle(markings_cm: Float[np.ndarray, "m"], chosen_cm: float, settings: LaneFilterSettings) -> float:
    """Middle of all candidates of one marking: the one nearest to the centre alone would pull inwards."""
    same = markings_cm[np.abs(markings_cm - chosen_cm) <= 0.5 * settings.marking_cm]
    return 0.5 * float(same[0] + same[-1])


class LaneFilter:
    """The lane feature filter as a detector.

    Rows 15 and 30 are measured. Row 0, which no frame sees, lies on the straight line through them. The
    centres found in a frame are expected in the next one; a row that finds nothing starts again straight
    ahead.
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
        if self.extractor.is_crowded(edges, self.settings.max_edge_share):
            self.reset()
            return LaneEstimate()
        return self.estimate(edges.points_cm)

    def estimate(self, points_cm: Float[np.ndarray, "n 2"]) -> LaneEstimate:
        """Find the lane in the edge points of one frame.

        Args:
            points_cm: Edge points, [cm], frame car.

        Returns:
            The lane; its confidence is the share of the two measured rows that have one, and the standard
            deviations are unknown.
        """
        near_cm, far_cm = ROWS_CM[1:]
        near = self._track(points_cm, near_cm, 0.0)
        straight_on_cm = 0.0 if near is None else 0.5 * (near[0] + near[1])
        far = self._track(points_cm, far_cm, straight_on_cm)
        points = np.full((2, len(ROWS_CM)), np.nan)
        if near is not None:
            points[:, 1] = near
        if far is not None:
            points[:, 2] = far
        # NaN unless both rows are known.
        points[:, 0] = points[:, 1] - (points[:, 2] - points[:, 1]) * near_cm / (far_cm - near_cm)
        return LaneEstimate(
            points_cm=points.reshape(N_POINTS),
            steering_rad=self._steering_rad(points_cm, near, far),
            confidence=0.5 * (near is not None) + 0.5 * (far is not None),
        )

    def _steering_rad(
        self,
        points_cm: Float[np.ndarray, "n 2"],
        near: tuple[float, float] | None,
        far: tuple[float, float] | None,
    ) -> float:
        look_ahead_cm = self.settings.look_ahead_cm
        if look_ahead_cm == ROWS_CM[1]:
            pair = near
        elif look_ahead_cm == ROWS_CM[2]:
            pair = far
        else:
            pair = self._track(points_cm, look_ahead_cm, 0.0)
        if pair is None:
            return float("nan")
        return proportional_angle_rad(0.5 * (pair[0] + pair[1]), look_ahead_cm)

    def _track(
        self, points_cm: Float[np.ndarray, "n 2"], y_cm: float, otherwise_cm: float
    ) -> tuple[float, float] | None:
        """Find a row near its centre of the frame before, or near ``otherwise_cm`` where there was none."""
        pair = find_row(points_cm, y_cm, self.settings, self._centre_cm.get(y_cm, otherwise_cm))
        if pair is None:
            self._centre_cm.pop(y_cm, None)
        else:
            self._centre_cm[y_cm] = 0.5 * (pair[0] + pair[1])
        return pair
