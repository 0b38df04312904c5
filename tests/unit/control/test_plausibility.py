from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.plausibility import SETTLE_S, fault_of, misfit_of
from lanenet.control.steering import SteeringSettings
from lanenet.perception.estimate import LaneEstimate

LANE = LaneEstimate(
    np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0]), np.full(6, 0.5), 0.0, 1.0, presence=np.ones(2)
)
STEP_S = 0.05


def beside(offset_cm: float, **changes: object) -> LaneEstimate:
    return replace(LANE, points_cm=LANE.points_cm + offset_cm, **changes)  # type: ignore[arg-type]


def with_value(values: np.ndarray, value: float, at: int = 1) -> np.ndarray:
    return np.where(np.arange(len(values)) == at, value, values)


def controller(lane_width_cm: float | None = 40.0) -> LaneController:
    steering = SteeringSettings(wheelbase_cm=26.0, lane_width_cm=lane_width_cm)
    return LaneController(ControlSettings(steering=steering))


def only_left(x_cm: float) -> LaneEstimate:
    return LaneEstimate(np.array([x_cm] * 3 + [math.nan] * 3), confidence=1.0)


def only_right(x_cm: float) -> LaneEstimate:
    return LaneEstimate(np.array([math.nan] * 3 + [x_cm] * 3), confidence=1.0)


@pytest.mark.parametrize(
    ("answer", "word"),
    [
        (replace(LANE, sigma_cm=with_value(LANE.sigma_cm, math.nan)), "sigma"),
        (replace(LANE, sigma_cm=with_value(LANE.sigma_cm, math.inf)), "sigma"),
        (replace(LANE, sigma_cm=with_value(LANE.sigma_cm, -1.0)), "sigma"),
        (replace(LANE, presence=np.array([1.0, 4.85])), "presence"),
        (replace(LANE, presence=np.array([-0.1, 1.0])), "presence"),
        (replace(LANE, confidence=4.85), "confidence"),
        (replace(LANE, confidence=math.nan), "confidence"),
        (replace(LANE, steering_rad=math.inf), "steering"),
        (replace(LANE, steering_rad=2.0), "steering"),
        (replace(LANE, points_cm=with_value(LANE.points_cm, -math.inf)), "inf"),
        (beside(500.0), "520 cm"),
        (beside(60.0), "60 cm beside"),
        (only_left(75.0), "95 cm beside"),
        (only_right(-75.0), "95 cm beside"),
        (replace(LANE, points_cm=-LANE.points_cm), "cross"),
        (replace(LANE, points_cm=2.0 * LANE.points_cm), "80 cm wide, expected 40 cm"),
        (replace(LANE, points_cm=0.4 * LANE.points_cm), "16 cm wide, expected 40 cm"),
    ],
)
def test_an_answer_that_cannot_be_the_lane_is_none(answer: LaneEstimate, word: str) -> None:
    assert word in (fault_of(answer) or misfit_of(answer, 40.0))
    target = controller().target(answer, 1.0)
    assert word in target.fault and math.isnan(target.steering_rad)


@pytest.mark.parametrize(
    "answer",
    [
        LANE,
        beside(25.0),
        LaneEstimate(LANE.points_cm, confidence=0.5),
        only_right(20.0),
        only_left(20.0),
        LaneEstimate(),
        LaneEstimate(steering_rad=0.3, confidence=1.0),
    ],
)
def test_what_a_detector_does_not_know_is_no_fault(answer: LaneEstimate) -> None:
    assert fault_of(answer) == "" == misfit_of(answer, 40.0)


def faults(offsets_cm: list[float], step_s: float = STEP_S, **changes: object) -> list[bool]:
    car = controller()
    return [car.target(beside(x, **changes), i * step_s, 60.0).fault != "" for i, x in enumerate(offsets_cm)]


def test_a_lane_that_jumps_is_none_until_it_stays_there() -> None:
    seen = faults([0.0] * 5 + [40.0] * 15)
    waited = round(SETTLE_S / STEP_S)
    assert seen == [False] * 5 + [True] * waited + [False] * (15 - waited)


def test_one_wrong_frame_costs_one_frame() -> None:
    assert faults([0.0, 0.0, 40.0, 0.0, 0.0]) == [False, False, True, False, False]


def test_a_lane_that_goes_on_jumping_is_never_accepted() -> None:
    assert all(faults([0.0, *[40.0, -40.0] * 20])[1:])


def test_what_the_car_can_do_is_no_jump() -> None:
    # Sideways with the whole speed: 3 cm a frame; and with 0.3 s between the frames.
    assert not any(faults([3.0 * i - 30.0 for i in range(20)]))
    assert not any(faults([0.0, 18.0, 0.0, -18.0], step_s=0.3))


def test_the_place_of_a_line_that_is_not_seen_does_not_count() -> None:
    car = controller()
    guesses = [with_value(LANE.points_cm, x, at=4) for x in (20.0, 38.0, 18.0)]
    presence = np.array([1.0, 0.1])
    answers = [replace(LANE, points_cm=points, presence=presence) for points in guesses]
    assert not any(car.target(answer, i * STEP_S).fault for i, answer in enumerate(answers))


def test_a_line_that_takes_the_other_ones_place_is_a_jump() -> None:
    car = controller()
    assert not car.target(only_left(-20.0), 0.0).fault
    assert "40 cm" in car.target(only_right(-20.0), STEP_S).fault
    assert not car.target(only_right(20.0), 2.0 * STEP_S).fault
    assert not car.target(only_left(-20.0), 3.0 * STEP_S).fault
    # Nothing is known of the other line without a width.
    car = controller(None)
    assert not car.target(only_left(-20.0), 0.0).fault
    assert not car.target(only_right(-20.0), STEP_S).fault


def test_a_jump_counts_if_neither_line_is_probable() -> None:
    car, unsure = controller(), np.array([0.49, 0.49])
    assert not car.target(LANE, 0.0).fault
    assert "40 cm" in car.target(beside(40.0, presence=unsure), STEP_S).fault


def test_a_wrong_width_that_was_learned_is_forgotten() -> None:
    car, wrong = controller(None), replace(LANE, points_cm=0.5 * LANE.points_cm)
    for i in range(20):
        car.target(wrong, i * STEP_S)
    refused = [car.target(LANE, (20 + i) * STEP_S).fault != "" for i in range(60)]
    assert refused[0] and not any(refused[30:])


def test_the_first_lane_after_a_pause_or_a_reset_is_accepted() -> None:
    car = controller()
    assert not car.target(LANE, 0.0).fault
    assert not car.target(beside(40.0), 2.0 * SETTLE_S).fault
    car.reset()
    assert not car.target(LANE, 2.0 * SETTLE_S + STEP_S).fault
