"""Kozlowski's lane feature filter: two markings of the right thickness, a lane's width apart, on one row.

The filter fits no curve; in the paper it uses nothing but distances between edge points of the bird's-eye
view. It is the paper's onboard detector, and a baseline for every other one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field

from lanenet.config import Settings, check_settings
from lanenet.errors import CalibrationError, ConfigError
from lanenet.geometry.lane import N_POINTS, ROWS_CM, LaneWidthCm, proportional_angle_rad
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import DetectorInputs, DetectorKind, LaneEstimate

#: Settings that switch off every check which is not in the paper.
PAPER: dict[str, Any] = {
    "polarity": "ignored",
    "agreement_share": 0.0,
    "clear_share": 0.0,
    "max_pairs": None,
    "max_centre_jump": None,
    "max_edge_share": 1.0,
}


class LaneFilterSettings(Settings):
    """What the filter accepts as a lane.

    The paper's filter uses distances between edge points alone. In textured images some points have these
    distances by chance. The checks that were added look at the directions of the edges, at neighbouring rows
    and at contradictions; :data:`PAPER` switches them off. On three simulated drives they reduce the RMSE
    from 3.78 to 0.99 cm, and 70 instead of 62 % of the points are answered
    (``tests/sim/test_lane_filter_on_simulated_drives.py``).

    Attributes:
        lane_width_cm: Distance between the middles of the two lines of the driven lane.
        lane_width_tolerance_cm: How far a pair of markings may be from that.
        marking_cm: Thickness of a marking (tape).
        marking_tolerance_cm: How far a pair of edges may be from that; edges are a pixel of road uncertain.
        grid_cm: Grid to whose nodes the points are moved; the paper's 2 mm.
        row_cm: Extent along y of one row: a pixel of the paper's camera, 6 mm. The paper's rows of 2 mm
            seldom hold all four edges.
        row_tolerance_cm: How far from the wanted row the search goes if that one has no lane.
        look_ahead_cm: Distance of the aim point A; the paper's 15 cm.
        max_edge_share: Frames with more edge points than this share of the road's pixels have no lane, since
            every distance occurs by chance. Not in the paper; 1 switches it off.
        polarity: The two edges of a ``bright`` marking face each other, those of a ``dark`` one away;
            ``any`` takes both, but never one of each in a pair. ``ignored``, as in the paper, uses edges
            without direction and measures distances along the row instead of across the lines.
        parallel_rad: Largest difference in direction of the two edges of a marking, and of the two lines of a
            lane, which differ along a row of a curve. Not used with ``ignored``.
        agreement_cm: Extent along y, before and behind a row, in which its two lines have to continue. Not in
            the paper.
        agreement_share: Share of that extent in which both have to be seen; about a half at the end of a dash
            and at the border of the image. 0 switches it off, as does ``ignored``.
        clear_share: A row has no lane if less than this share of the edge points between its lines, over the
            same extent, lies on the two lines: the floor of a lane is empty, a texture is not. Not in the
            paper; 0 switches it off.
        max_pairs: A row with more pairs that satisfy all conditions is ambiguous and has no lane; three lanes
            side by side are three pairs. Not in the paper; null switches it off.
        max_centre_jump: The far row is dropped if its centre is further than this share of the lane width to
            the side of the near row's, or if the widths differ by more than their tolerance. Not in the
            paper; null switches it off.
    """

    lane_width_cm: LaneWidthCm
    lane_width_tolerance_cm: float = Field(default=4.0, gt=0.0)
    marking_cm: float = Field(default=2.0, gt=0.0)
    marking_tolerance_cm: float = Field(default=0.8, gt=0.0)
    grid_cm: float = Field(default=0.2, gt=0.0)
    row_cm: float = Field(default=0.6, gt=0.0)
    row_tolerance_cm: float = Field(default=2.4, ge=0.0)
    look_ahead_cm: float = Field(default=15.0, gt=0.0)
    max_edge_share: float = Field(default=0.10, gt=0.0, le=1.0)
    polarity: Literal["any", "bright", "dark", "ignored"] = "any"
    parallel_rad: float = Field(default=0.5, gt=0.0, lt=1.57)
    agreement_cm: float = Field(default=8.0, gt=0.0, le=60.0)
    agreement_share: float = Field(default=0.4, ge=0.0, le=1.0)
    clear_share: float = Field(default=0.5, ge=0.0, le=1.0)
    max_pairs: int | None = Field(default=4, ge=1)
    max_centre_jump: float | None = Field(default=0.5, gt=0.0)


#: A line at a larger angle from straight ahead is not used. Chosen: at 60 degrees an error of the direction
#: of 3 degrees changes a width by a tenth.
MAX_OBLIQUE_RAD = math.pi / 3.0
#: A marking that only confirms a line may miss the thickness by this many tolerances, since far from the car
#: it is a few pixels thick.
_SLACK = 2.0


@dataclass(frozen=True)
class Markings:
    """Pairs of edges whose spacing is about a marking's thickness, sorted by row and middle.

    Attributes:
        row: Index of the row of each, counted from the wanted row.
        middle_cm: x of its middle, frame car.
        direction_rad: Direction of its line, from straight ahead, positive right; 0 where it is ignored.
        polarity: 1 for brighter than the floor, -1 for darker, 0 where that is ignored.
        exact: True where the thickness lies within its tolerance.
    """

    row: Int[np.ndarray, "n"]
    middle_cm: Float[np.ndarray, "n"]
    direction_rad: Float[np.ndarray, "n"]
    polarity: Int[np.ndarray, "n"]
    exact: Bool[np.ndarray, "n"]

    def subset(self, keep: Bool[np.ndarray, "n"] | Int[np.ndarray, "m"]) -> Markings:
        """Return some of them, in the order asked for."""
        return Markings(*(values[keep] for values in vars(self).values()))


def find_markings(
    points_cm: Float[np.ndarray, "n 2"],
    normals: Float[np.ndarray, "n 2"] | None,
    y_cm: float,
    reach_cm: float,
    settings: LaneFilterSettings,
) -> Markings:
    """Find all markings near a row.

    Args:
        points_cm: Edge points, [cm], frame car; points that are not finite are ignored.
        normals: Unit vectors across the edges, towards the brighter side. With them the two edges have to
            face each other or point apart, and the thickness is measured across the line; without them it is
            measured along the row, as in the paper.
        y_cm: The row from which the others are counted, ``row_cm`` apart.
        reach_cm: How far from it markings are looked for.
        settings: Thickness, grid, polarity and their tolerances.

    Returns:
        The markings; one edge may belong to several.
    """
    near = (np.abs(points_cm[:, 1] - y_cm) <= reach_cm + settings.row_cm) & np.isfinite(points_cm[:, 0])
    x, y = points_cm[near].T
    rows = np.rint((y - y_cm) / settings.row_cm).astype(np.int64)
    nodes = np.rint(x / settings.grid_cm).astype(np.int64)
    order = np.lexsort((nodes, rows))
    rows, nodes = rows[order], nodes[order]
    widest_cm = settings.marking_cm + settings.marking_tolerance_cm + 1e-9
    if normals is not None:
        widest_cm = settings.marking_cm + _SLACK * settings.marking_tolerance_cm
        widest_cm /= math.cos(MAX_OBLIQUE_RAD)
    # All rows on one axis, far apart, so that one search serves them all.
    reach = widest_cm / settings.grid_cm
    span = int(np.ptp(nodes)) + int(reach) + 2 if nodes.size else 1
    keys = rows * span + nodes
    first, second = index_ranges(
        np.arange(1, keys.size + 1), np.searchsorted(keys, keys + reach, side="right")
    )
    gap_cm = (nodes[second] - nodes[first]) * settings.grid_cm
    middle_cm = (nodes[first] + nodes[second]) * (0.5 * settings.grid_cm)
    apart = gap_cm > 0.0
    first, second, gap_cm, middle_cm = first[apart], second[apart], gap_cm[apart], middle_cm[apart]
    row = rows[first]
    if normals is None:
        exact = np.abs(gap_cm - settings.marking_cm) <= settings.marking_tolerance_cm + 1e-9
        nothing = np.zeros(row.size)
        found = Markings(row, middle_cm, nothing, nothing.astype(np.int64), exact).subset(exact)
    else:
        across = normals[near][order]
        found = _facing_edges(row, middle_cm, gap_cm, across[first], across[second], settings)
    return found.subset(np.lexsort((found.middle_cm, found.row)))


def _facing_edges(
    row: Int[np.ndarray, "n"],
    middle_cm: Float[np.ndarray, "n"],
    gap_cm: Float[np.ndarray, "n"],
    left_normals: Float[np.ndarray, "n 2"],
    right_normals: Float[np.ndarray, "n 2"],
    settings: LaneFilterSettings,
) -> Markings:
    """Keep the pairs of edges that are parallel, of opposite normals and the right distance apart."""
    # From the left edge to the right one on a bright marking, and back on a dark one.
    facing = left_normals - right_normals
    side = np.copysign(1.0, facing[:, 0])
    direction = np.arctan2(-facing[:, 1] * side, np.abs(facing[:, 0]))
    off_cm = np.abs(gap_cm * np.cos(direction) - settings.marking_cm)
    slack_cm = settings.marking_tolerance_cm + 1e-9
    # The difference of unit vectors at an angle of pi - a has the length 2 cos(a / 2).
    length = np.hypot(facing[:, 0], facing[:, 1])
    good = (length >= 2.0 * math.cos(0.5 * settings.parallel_rad)) & (off_cm <= _SLACK * slack_cm)
    good &= np.abs(direction) <= MAX_OBLIQUE_RAD
    if settings.polarity in ("bright", "dark"):
        good &= side == (1.0 if settings.polarity == "bright" else -1.0)
    return Markings(row, middle_cm, direction, side.astype(np.int64), off_cm <= slack_cm).subset(good)


def index_ranges(
    first: Int[np.ndarray, "n"], last: Int[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Pair each index i with first[i], ..., last[i] - 1."""
    counts = np.maximum(last - first, 0)
    one = np.repeat(np.arange(first.size), counts)
    within = np.arange(one.size) - np.repeat(np.cumsum(counts) - counts, counts)
    return one, first[one] + within


#: Neighbouring rows are counted in steps of this [cm]: about two pixels of road at the far row of an image of
#: 160 x 120 px. Half or double changes the RMSE on a synthetic drive by 0.03 cm.
_STEP_CM = 2.0
#: Sideways change of a line per cm towards a neighbouring row, from bends and from the error of its direction
#: [cm per cm]. Chosen: half or double changes neither RMSE nor answers on a synthetic drive by more than 1 %.
_BEND = 0.12

_Pair = tuple[float, float]


class LaneFilter:
    """The lane feature filter as a detector.

    Rows 15 and 30 are measured, and row 0, which no frame sees, is extrapolated from them. If they contradict
    each other, only row 15 is answered. A row looks first near its centre of the frame before; if that frame
    had none, straight ahead.
    """

    def __init__(self, extractor: RoadEdgeExtractor | None, settings: LaneFilterSettings) -> None:
        """Build the filter; without an extractor it takes edge points only."""
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
        for row, pair in enumerate((near, far), start=1):
            if pair is not None:
                points[:, row] = pair
        # NaN unless both rows are known.
        points[:, 0] = points[:, 1] - (points[:, 2] - points[:, 1]) * near_cm / (far_cm - near_cm)
        return LaneEstimate(
            points_cm=points.reshape(N_POINTS),
            steering_rad=self._steering_rad(points_cm, normals, near, far),
            confidence=0.5 * (near is not None) + 0.5 * (far is not None),
        )

    def _contradict(self, near: _Pair, far: _Pair) -> bool:
        """Whether no lane can go through both rows."""
        settings = self.settings
        if settings.max_centre_jump is None:
            return False
        jump_cm = abs(_centre(far) - _centre(near))
        # An oblique lane is wider along a row than across.
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
        look_ahead_cm, known = self.settings.look_ahead_cm, {ROWS_CM[1]: near, ROWS_CM[2]: far}
        if look_ahead_cm in known:
            pair = known[look_ahead_cm]
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
        """Find a row near its centre of the frame before, or near ``otherwise_cm`` without one."""
        expected_cm = self._centre_cm.get(y_cm, otherwise_cm)
        pair = find_row(points_cm, y_cm, self.settings, expected_cm, normals)
        if pair is None:
            self._centre_cm.pop(y_cm, None)
        else:
            self._centre_cm[y_cm] = _centre(pair)
        return pair


def _centre(pair: _Pair) -> float:
    return 0.5 * (pair[0] + pair[1])


def find_row(
    points_cm: Float[np.ndarray, "n 2"],
    y_cm: float,
    settings: LaneFilterSettings,
    expected_centre_cm: float = 0.0,
    normals: Float[np.ndarray, "n 2"] | None = None,
) -> tuple[float, float] | None:
    """Find the left and the right line on one row.

    The wanted row is tried first, then its neighbours outward. The search ends at the first row that meets
    the conditions, and without a lane at a row that is ambiguous or full of other edges.

    Args:
        points_cm: Edge points, [cm], frame car; points that are not finite are ignored.
        y_cm: The wanted row.
        settings: The lane's distances and their tolerances.
        expected_centre_cm: Of several pairs, the one with the nearest centre is taken.
        normals: Unit vectors across the edges, towards the brighter side; None skips the checks that need
            them (polarity, parallel lines, distances across the lines, agreement of neighbouring rows).

    Returns:
        x of the middles of the left and right marking, [cm], frame car, or None if no row has a lane.

    Source:
        Kozlowski et al. 2024, section 2.2. Not in the paper: the order of the rows, a row's extent, the
        choice among several pairs, and all checks by directions or by other rows.
    """
    if settings.polarity == "ignored":
        normals = None
    agreeing = settings.agreement_share > 0.0 and normals is not None
    reach_cm = settings.row_tolerance_cm + (settings.agreement_cm if agreeing else 0.0)
    markings = find_markings(points_cm, normals, y_cm, reach_cm, settings)
    steps = int(settings.row_tolerance_cm / settings.row_cm + 1e-9)
    for step in sorted(range(-steps, steps + 1), key=lambda k: (abs(k), k)):
        row = markings.subset(markings.exact & (markings.row == step))
        left, right = _pairs(row, settings)
        if agreeing and left.size:
            agree = _agree(row, left, right, markings, settings)
            left, right = left[agree], right[agree]
        if not left.size:
            continue
        if settings.max_pairs is not None and _count_lanes(row, left, right, settings) > settings.max_pairs:
            return None
        centres = 0.5 * (row.middle_cm[left] + row.middle_cm[right])
        best = int(np.argmin(np.abs(centres - expected_centre_cm)))
        lane = int(left[best]), int(right[best])
        if not _is_clear(points_cm, y_cm + step * settings.row_cm, row, lane, settings):
            return None
        return _middle(row, lane[0], settings), _middle(row, lane[1], settings)
    return None


def _pairs(row: Markings, settings: LaneFilterSettings) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Left and right marking of all pairs of one row that are a lane's width apart."""
    x, turn, slack = row.middle_cm, row.direction_rad, settings.lane_width_tolerance_cm + 1e-9
    low, high = settings.lane_width_cm - slack, settings.lane_width_cm + slack
    # Without directions all turns are 0, and the distance along the row has to fit.
    widest = high / math.cos(MAX_OBLIQUE_RAD) if turn.any() else high
    # Even a tolerance wider than the lane pairs no marking with itself.
    first = np.maximum(np.searchsorted(x, x + low, side="left"), np.arange(x.size) + 1)
    left, right = index_ranges(first, np.searchsorted(x, x + widest, side="right"))
    width = (x[right] - x[left]) * np.cos(0.5 * (turn[left] + turn[right]))
    good = (width >= low) & (width <= high) & (row.polarity[left] == row.polarity[right])
    good &= np.abs(turn[left] - turn[right]) <= settings.parallel_rad
    return left[good], right[good]


def _agree(
    row: Markings,
    left: Int[np.ndarray, "m"],
    right: Int[np.ndarray, "m"],
    markings: Markings,
    settings: LaneFilterSettings,
) -> Bool[np.ndarray, "m"]:
    """True for the pairs whose two lines continue in enough of the neighbouring rows."""
    used = np.unique(np.concatenate([left, right]))
    ahead_cm = (markings.row - row.row[0]) * settings.row_cm
    near = np.abs(ahead_cm) <= settings.agreement_cm + 1e-9
    others, ahead_cm = markings.subset(near), ahead_cm[near]
    slope = np.tan(row.direction_rad[used])
    off_cm = np.abs(others.middle_cm - (row.middle_cm[used, None] + slope[:, None] * ahead_cm))
    goes_on = off_cm <= 0.5 * settings.marking_cm + _BEND * np.abs(ahead_cm)
    goes_on &= others.polarity == row.polarity[used, None]
    steps = np.rint(ahead_cm / _STEP_CM)
    most = int(settings.agreement_cm / _STEP_CM + 1e-9)
    seen = np.stack([goes_on[:, steps == k].any(axis=1) for k in range(-most, most + 1)], axis=1)
    both = seen[np.searchsorted(used, left)] & seen[np.searchsorted(used, right)]
    return np.asarray(both.mean(axis=1) >= settings.agreement_share - 1e-9)


def _count_lanes(
    row: Markings, left: Int[np.ndarray, "m"], right: Int[np.ndarray, "m"], settings: LaneFilterSettings
) -> int:
    """Number of pairs, counting the candidates of one marking once."""
    line = np.cumsum(np.diff(row.middle_cm, prepend=row.middle_cm[:1]) > 0.5 * settings.marking_cm)
    return len(np.unique(np.stack([line[left], line[right]], axis=1), axis=0))


def _is_clear(
    points_cm: Float[np.ndarray, "n 2"],
    y_cm: float,
    row: Markings,
    lane: tuple[int, int],
    settings: LaneFilterSettings,
) -> bool:
    """Whether enough of the edge points between the lines belong to the lines."""
    if settings.clear_share == 0.0:
        return True
    near = points_cm[np.abs(points_cm[:, 1] - y_cm) <= settings.agreement_cm]
    margin_cm = settings.marking_cm + _STEP_CM
    from_left_cm, from_right_cm = (
        near[:, 0] - row.middle_cm[k] - math.tan(row.direction_rad[k]) * (near[:, 1] - y_cm) for k in lane
    )
    inside = (from_left_cm >= -margin_cm) & (from_right_cm <= margin_cm)
    on_lines = inside & ((from_left_cm <= margin_cm) | (from_right_cm >= -margin_cm))
    return int(on_lines.sum()) >= settings.clear_share * int(inside.sum())


def _middle(row: Markings, chosen: int, settings: LaneFilterSettings) -> float:
    """Middle of all candidates of one marking; the innermost alone would be biased inwards."""
    x = row.middle_cm
    same = x[(np.abs(x - x[chosen]) <= 0.5 * settings.marking_cm) & (row.polarity == row.polarity[chosen])]
    return 0.5 * float(same[0] + same[-1])


class LaneFilterFile(Settings):
    """Settings file of ``lane-filter``: what differs from the defaults.

    Attributes:
        filter: Of :class:`LaneFilterSettings`; the lane width may be left out where the drive or the command
            line gives it.
        perception: How edge points are found in the frames.
    """

    filter: dict[str, Any] = Field(default_factory=dict)
    perception: PerceptionSettings = PerceptionSettings()


def lane_filter_settings(inputs: DetectorInputs) -> tuple[LaneFilterSettings, PerceptionSettings]:
    """Put together what the settings file, the command line and the source say.

    Raises:
        ConfigError: If nothing gives the lane width, or a value is unknown or out of range.
    """
    file = inputs.settings(LaneFilterFile)
    drive = {"lane_width_cm": inputs.drive_lane_width_cm}
    given = {"lane_width_cm": inputs.lane_width_cm, "marking_cm": inputs.marking_cm}
    data = {
        **{key: value for key, value in drive.items() if value is not None},
        **file.filter,
        **{key: value for key, value in given.items() if value is not None},
    }
    if "lane_width_cm" not in data:
        nowhere = (
            "neither the source nor a settings file has"
            if inputs.config is None
            else f"{inputs.config} lacks"
        )
        raise ConfigError(f"detector lane-filter: {nowhere} the lane width, expected one (--lane-width CM)")
    where = "lane filter" if inputs.config is None else f"{inputs.config}: filter"
    perception = file.perception if inputs.perception is None else inputs.perception
    return check_settings(LaneFilterSettings, data, where), perception


def _build(inputs: DetectorInputs) -> LaneFilter:
    assert inputs.camera is not None
    settings, perception = lane_filter_settings(inputs)
    return LaneFilter(RoadEdgeExtractor(inputs.camera, perception, inputs.mask), settings)


KIND = DetectorKind(
    "lane-filter",
    _build,
    settings=LaneFilterFile,
    takes_lane_width=True,
    takes_marking=True,
    takes_mask=True,
    build_on_edges=lambda inputs: LaneFilter(None, lane_filter_settings(inputs)[0]),
)
