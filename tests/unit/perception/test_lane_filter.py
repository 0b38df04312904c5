from __future__ import annotations

import functools
import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.config import check_settings
from lanenet.errors import CalibrationError, ConfigError
from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.lane_filter import LaneFilter, LaneFilterSettings, find_row

SETTINGS = LaneFilterSettings(lane_width_cm=40.0)


def line_edges(x_at_0_cm: float, slope: float, marking_cm: float = 2.0) -> np.ndarray:
    """Both edges of a straight marking of that thickness, sampled every 0.25 cm along y."""
    y = np.arange(-5.0, 60.0, 0.25)
    half = 0.5 * marking_cm * math.hypot(1.0, slope)
    middle = x_at_0_cm + slope * y
    return np.concatenate([np.stack([middle + side * half, y], axis=1) for side in (-1.0, 1.0)])


def lane_edges(centre_cm: float, slope: float = 0.0, width_cm: float = 40.0) -> np.ndarray:
    half = 0.5 * width_cm * math.hypot(1.0, slope)
    return np.concatenate([line_edges(centre_cm - half, slope), line_edges(centre_cm + half, slope)])


@functools.cache
def extractor() -> RoadEdgeExtractor:
    K = np.array([[120.0, 0.0, 159.5], [0.0, 120.0, 119.5], [0.0, 0.0, 1.0]])
    camera = Camera("pinhole", 320, 240, K, np.zeros(5), Mounting(22.0, np.deg2rad(40.0)), 26.0)
    return RoadEdgeExtractor(camera, PerceptionSettings())


def lane_filter(settings: LaneFilterSettings = SETTINGS) -> LaneFilter:
    return LaneFilter(extractor(), settings)


def frame_of_lane(centre_cm: float, slope: float) -> np.ndarray:
    """A frame of two white lines, painted by the road point of each pixel."""
    cam = extractor().camera
    scale = 4
    u, v = np.meshgrid(
        (np.arange(cam.width * scale) + 0.5) / scale - 0.5,
        (np.arange(cam.height * scale) + 0.5) / scale - 0.5,
    )
    road = cam.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))
    across = (road[:, 0] - centre_cm - slope * road[:, 1]) / math.hypot(1.0, slope)
    with np.errstate(invalid="ignore"):
        white = np.abs(np.abs(across) - 20.0) <= 1.0
    fine = np.where(white, 230, 60).astype(np.uint8).reshape(u.shape)
    gray = cv2.resize(fine, (cam.width, cam.height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR))


def test_hand_made_row() -> None:
    # Edges of two markings at -21..-19 and 19..21, and a lone edge between them.
    x = np.array([-21.0, -19.0, 3.0, 19.0, 21.0])
    points = np.stack([x, np.full(5, 15.0)], axis=1)
    assert find_row(points, 15.0, SETTINGS) == pytest.approx((-20.0, 20.0))


@pytest.mark.parametrize(
    "x",
    [
        [],
        [-21.0, -19.0],
        [-21.0, 21.0],
        [-21.0, -19.0, 19.0, 24.0],
        [-27.0, -25.0, 25.0, 27.0],
        [-15.0, -13.0, 13.0, 15.0],
    ],
    ids=["nothing", "one line", "single edges", "too thick", "too wide", "too narrow"],
)
def test_rows_that_are_no_lane(x: list[float]) -> None:
    points = np.stack([np.array(x), np.full(len(x), 15.0)], axis=1).reshape(-1, 2)
    assert find_row(points, 15.0, SETTINGS) is None


def test_points_fall_on_grid_nodes() -> None:
    rng = np.random.default_rng(1)
    lane = np.array([-21.0, -19.0, 19.0, 21.0])
    for _ in range(20):
        x = lane + rng.uniform(-0.099, 0.099, 4)
        points = np.stack([x, np.full(4, 15.0)], axis=1)
        assert find_row(points, 15.0, SETTINGS) == pytest.approx((-20.0, 20.0))


def test_search_moves_outward_and_stops_at_the_tolerance() -> None:
    def row(y: float, shift: float) -> np.ndarray:
        return np.stack([np.array([-21.0, -19.0, 19.0, 21.0]) + shift, np.full(4, y)], axis=1)

    near, far = row(15.9, 1.0), row(17.0, 3.0)
    assert find_row(np.concatenate([far, near]), 15.0, SETTINGS) == pytest.approx((-19.0, 21.0))
    assert find_row(far, 15.0, SETTINGS) == pytest.approx((-17.0, 23.0))
    assert find_row(row(18.0, 0.0), 15.0, SETTINGS) is None
    exact = SETTINGS.model_copy(update={"row_tolerance_cm": 0.0})
    assert find_row(near, 15.0, exact) is None


def test_of_several_lanes_the_expected_one_counts() -> None:
    # Three lines bound two lanes, with centres at 0 and 40.
    points = np.concatenate([line_edges(x, 0.0) for x in (-20.0, 20.0, 60.0)])
    assert find_row(points, 15.0, SETTINGS) == pytest.approx((-20.0, 20.0))
    assert find_row(points, 15.0, SETTINGS, expected_centre_cm=30.0) == pytest.approx((20.0, 60.0))


@given(
    st.lists(st.floats(-80.0, 80.0), max_size=60),
    st.floats(-30.0, 30.0),
    st.floats(0.5, 6.0),
)
def test_matches_plain_search_over_all_pairs(x: list[float], expected: float, tolerance: float) -> None:
    settings = SETTINGS.model_copy(update={"lane_width_tolerance_cm": tolerance, "row_tolerance_cm": 0.0})
    points = np.stack([np.array(x), np.full(len(x), 15.0)], axis=1).reshape(-1, 2)
    pair = find_row(points, 15.0, settings, expected)

    nodes = sorted({round(v / 0.2) for v in x})
    middles = sorted(
        {0.1 * (p + q) for p in nodes for q in nodes if 1.2 - 1e-9 <= 0.2 * (q - p) <= 2.8 + 1e-9}
    )
    lanes = [(p, q) for p in middles for q in middles if abs(q - p - 40.0) <= tolerance + 1e-9]
    assert (pair is None) == (not lanes)
    if pair is not None:
        best = min(abs(0.5 * (p + q) - expected) for p, q in lanes)
        # The middles of the chosen markings, taken over all their candidates, lie within half a marking.
        assert abs(0.5 * (pair[0] + pair[1]) - expected) <= best + 1.0 + 1e-9
        assert abs(pair[1] - pair[0] - 40.0) <= tolerance + 2.0 + 1e-9


@given(st.floats(-12.0, 12.0), st.floats(-0.25, 0.25))
def test_straight_lane_is_found_to_the_grid(centre: float, slope: float) -> None:
    estimate = lane_filter().estimate(lane_edges(centre, slope))
    half = 20.0 * math.hypot(1.0, slope)
    rows = np.array(ROWS_CM)
    truth = np.concatenate([centre - half + slope * rows, centre + half + slope * rows])
    assert np.abs(estimate.points_cm[[1, 2, 4, 5]] - truth[[1, 2, 4, 5]]).max() <= 0.25
    # Twice the near row less the far row: three times the error of a row.
    assert np.abs(estimate.points_cm - truth).max() <= 0.75
    assert estimate.confidence == 1.0
    assert estimate.steering_rad == pytest.approx(math.atan2(-(centre + 15.0 * slope), 15.0), abs=0.02)


def test_mirrored_points_mirror_the_estimate() -> None:
    rng = np.random.default_rng(3)
    points = np.concatenate([lane_edges(4.0, 0.1), rng.uniform([-80.0, 0.0], [80.0, 60.0], (150, 2))])
    one = lane_filter().estimate(points)
    other = lane_filter().estimate(points * [-1.0, 1.0])
    mirrored = -other.points_cm[[3, 4, 5, 0, 1, 2]]
    assert one.points_cm == pytest.approx(mirrored, abs=1e-6)
    assert one.steering_rad == pytest.approx(-other.steering_rad)


def test_row_zero_needs_both_rows() -> None:
    points = lane_edges(0.0)
    near_only = lane_filter().estimate(points[points[:, 1] < 20.0])
    assert near_only.mask.tolist() == [False, True, False, False, True, False]
    assert near_only.confidence == 0.5 and math.isfinite(near_only.steering_rad)
    far_only = lane_filter().estimate(points[points[:, 1] > 20.0])
    assert far_only.mask.tolist() == [False, False, True, False, False, True]
    assert far_only.confidence == 0.5 and math.isnan(far_only.steering_rad)


def test_no_points_no_lane() -> None:
    estimate = lane_filter().estimate(np.empty((0, 2)))
    assert not estimate.mask.any()
    assert estimate.confidence == 0.0 and math.isnan(estimate.steering_rad)
    with_nan = np.concatenate([lane_edges(0.0), np.full((5, 2), np.nan)])
    assert lane_filter().estimate(with_nan).mask.all()


def test_follows_a_lane_sideways_until_reset() -> None:
    lines = (-60.0, -20.0, 20.0, 60.0)
    detector = lane_filter()
    for shift in np.arange(0.0, 34.0, 3.0):
        points = np.concatenate([line_edges(x - shift, 0.0) for x in lines])
        centre = detector.estimate(points).points_cm[[1, 4]].mean()
        assert centre == pytest.approx(-shift, abs=0.2)
    detector.reset()
    assert detector.estimate(points).points_cm[[1, 4]].mean() == pytest.approx(40.0 - shift, abs=0.2)


@pytest.mark.parametrize("look_ahead", [15.0, 30.0, 22.0])
def test_steering_aims_at_the_look_ahead(look_ahead: float) -> None:
    settings = SETTINGS.model_copy(update={"look_ahead_cm": look_ahead})
    estimate = lane_filter(settings).estimate(lane_edges(2.0, 0.2))
    assert estimate.steering_rad == pytest.approx(math.atan2(-(2.0 + 0.2 * look_ahead), look_ahead), abs=0.01)


@pytest.mark.parametrize(("centre", "slope"), [(0.0, 0.0), (5.0, 0.1), (-4.0, -0.15)])
def test_lane_in_a_frame(centre: float, slope: float) -> None:
    estimate = lane_filter().detect(frame_of_lane(centre, slope))
    assert estimate.mask.all()
    half = 20.0 * math.hypot(1.0, slope)
    rows = np.array(ROWS_CM[1:])
    truth = np.concatenate([centre - half + slope * rows, centre + half + slope * rows])
    # The paper promises 10 mm at 15 cm; row 30 is further away and may be a row of the tolerance beside.
    assert np.abs(estimate.points_cm[[1, 2, 4, 5]] - truth).max() <= 1.0


def test_frame_of_another_size_is_refused() -> None:
    with pytest.raises(CalibrationError, match="160x120"):
        lane_filter().detect(np.zeros((120, 160, 3), np.uint8))


def test_without_a_camera_it_takes_points_only() -> None:
    detector = LaneFilter(None, SETTINGS)
    assert detector.estimate(lane_edges(0.0)).mask.all()
    with pytest.raises(CalibrationError, match="without a camera"):
        detector.detect(np.zeros((240, 320, 3), np.uint8))


def test_settings_need_the_lane_width() -> None:
    with pytest.raises(ConfigError, match="lane_width_cm"):
        check_settings(LaneFilterSettings, {}, "test")
    with pytest.raises(ConfigError, match="marking_cm"):
        check_settings(LaneFilterSettings, {"lane_width_cm": 40.0, "marking_cm": 0.0}, "test")


def test_eq_3_by_hand() -> None:
    """L = -15, R = 25 and so A = 5 on the row 15 cm ahead: atan(5 / 15) to the right."""
    x = np.array([-16.0, -14.0, 24.0, 26.0])
    points = np.concatenate([np.stack([x, np.full(4, y)], axis=1) for y in (15.0, 30.0)])
    estimate = LaneFilter(None, SETTINGS).estimate(points)
    assert estimate.points_cm == pytest.approx([-15.0, -15.0, -15.0, 25.0, 25.0, 25.0])
    assert estimate.steering_rad == pytest.approx(-0.3217506, abs=1e-6)
    far = LaneFilter(None, SETTINGS.model_copy(update={"look_ahead_cm": 30.0})).estimate(points)
    # atan(5 / 30)
    assert far.steering_rad == pytest.approx(-0.1651487, abs=1e-6)
