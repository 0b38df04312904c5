from __future__ import annotations

import math

import numpy as np
import pytest

from lanenet.control.smoothing import LaneSmoother, SmoothingSettings, move_points
from lanenet.geometry.lane import ROWS_CM, mirror_points
from lanenet.perception.estimate import LaneEstimate

ROWS = np.array(ROWS_CM)
WHEELBASE_CM = 26.0


def lane(centre_cm: float = 0.0, slope: float = 0.0) -> np.ndarray:
    middle = centre_cm + slope * ROWS
    return np.concatenate([middle - 20.0, middle + 20.0])


def test_straight_ahead_shifts_a_line_along_itself() -> None:
    # x = 3 + 0.2 y; 10 cm further on the same line is at 3 + 0.2 (y + 10).
    moved = move_points(lane(3.0, 0.2).tolist(), 10.0, 0.0, WHEELBASE_CM)
    np.testing.assert_allclose(moved, lane(5.0, 0.2), atol=1e-9)


def test_a_turn_without_travel_turns_about_the_rear_axle() -> None:
    # A line through the rear axle (0, -26), at angle 0.1 rad left of ahead, is dead ahead after that turn.
    angle = 0.1
    line = -math.tan(angle) * (ROWS + WHEELBASE_CM)
    moved = move_points([*line.tolist(), *[math.nan] * 3], 0.0, angle, WHEELBASE_CM)
    np.testing.assert_allclose(moved[:3], 0.0, atol=1e-9)
    assert np.isnan(moved[3:]).all() and len(moved) == 6


def test_driving_along_a_circle_leaves_its_lane_where_it_is() -> None:
    # Rear axle on a circle of radius 150 cm to the left; the lane's lines are circles about the same centre.
    radius = 150.0
    points = np.concatenate(
        [np.sqrt((radius + off) ** 2 - (ROWS + WHEELBASE_CM) ** 2) - radius for off in (-20.0, 20.0)]
    )
    travel = 4.0
    turn = 2.0 * math.asin(0.5 * travel / radius)  # a chord of 4 cm
    moved = move_points(points.tolist(), travel, turn, WHEELBASE_CM)
    # A parabola through three points of a circle is not the circle: 0.2 mm.
    np.testing.assert_allclose(moved, points, atol=0.1)
    np.testing.assert_allclose(
        move_points(mirror_points(points).tolist(), travel, -turn, WHEELBASE_CM),
        mirror_points(np.array(moved)),
        atol=1e-9,
    )


def test_a_line_across_the_way_has_no_place_ahead() -> None:
    assert np.isnan(move_points(lane(0.0, 0.0).tolist(), 0.0, 1.55, WHEELBASE_CM)).all()


def test_noise_shrinks_and_a_standing_lane_keeps_its_place() -> None:
    rng = np.random.default_rng(1)
    smoother = LaneSmoother(SmoothingSettings(), WHEELBASE_CM)
    noisy, smooth = [], []
    for _ in range(300):
        estimate = LaneEstimate(lane(2.0) + rng.normal(0.0, 1.0, 6), np.ones(6), confidence=1.0)
        noisy.append(estimate.points_cm)
        smooth.append(smoother.update(estimate, 1.0 / 30.0).points_cm)
    error, before = np.array(smooth[50:]) - lane(2.0), np.array(noisy[50:]) - lane(2.0)
    assert error.std() < 0.75 * before.std()
    assert abs(error.mean()) < 0.1


def test_a_doubtful_frame_weighs_less() -> None:
    def after(confidence: float, sigma_cm: float) -> float:
        smoother = LaneSmoother(SmoothingSettings(), WHEELBASE_CM)
        smoother.update(LaneEstimate(lane(0.0), np.ones(6), confidence=1.0), 0.0)
        estimate = LaneEstimate(lane(10.0), np.full(6, sigma_cm), confidence=confidence)
        return float(smoother.update(estimate, 0.03).points_cm[0] + 20.0)

    # Variances 1 + 0.03 * 9 = 1.27 carried on, 1 measured: 10 * 1.27 / 2.27.
    assert after(1.0, 1.0) == pytest.approx(10.0 * 1.27 / 2.27)
    assert after(0.1, 1.0) == pytest.approx(10.0 * 1.27 / 11.27)
    assert after(1.0, 3.0) == pytest.approx(10.0 * 1.27 / 10.27)


def test_a_lost_line_is_carried_on_for_a_while() -> None:
    smoother = LaneSmoother(SmoothingSettings(hold_s=0.1), WHEELBASE_CM)
    smoother.update(LaneEstimate(lane(0.0, 0.1), confidence=1.0), 0.0)
    left_only = lane(0.0, 0.1)
    left_only[3:] = np.nan
    held = smoother.update(LaneEstimate(left_only, confidence=1.0), 0.08, travel_cm=5.0)
    assert held.points_cm[3] == pytest.approx(20.5)  # 5 cm further on a slope of 0.1
    assert held.sigma_cm[3] > held.sigma_cm[0]
    gone = smoother.update(LaneEstimate(left_only, confidence=1.0), 0.08)
    assert np.isnan(gone.points_cm[3:]).all() and np.isfinite(gone.points_cm[:3]).all()


@pytest.mark.parametrize("first", [0, 7, 19, 638])
def test_a_lost_line_is_carried_on_for_as_many_frames_at_any_time(first: int) -> None:
    smoother = LaneSmoother(SmoothingSettings(hold_s=0.25), WHEELBASE_CM)
    times_s = (first + np.arange(10)) * 0.05
    smoother.update(LaneEstimate(lane(0.0), confidence=1.0), 0.0)
    left_only = lane(0.0)
    left_only[3:] = np.nan
    seen = [smoother.update(LaneEstimate(left_only), dt_s).mask[3] for dt_s in np.diff(times_s)]
    assert seen == [True] * 5 + [False] * 4


def test_it_can_be_switched_off_and_reset() -> None:
    estimate = LaneEstimate(lane(4.0), confidence=0.3)
    off = LaneSmoother(SmoothingSettings(enabled=False), WHEELBASE_CM)
    off.update(LaneEstimate(lane(0.0), confidence=1.0), 0.0)
    assert off.update(estimate, 0.03) is estimate
    on = LaneSmoother(SmoothingSettings(), WHEELBASE_CM)
    on.update(LaneEstimate(lane(0.0), confidence=1.0), 0.0)
    on.reset()
    np.testing.assert_array_equal(on.update(estimate, 0.03).points_cm, estimate.points_cm)
