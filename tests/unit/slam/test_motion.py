"""Prediction: arcs without noise, the stated spreads with it, and the bounds."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.slam.filter.motion import FACTOR, HEADING, OFFSET, MotionModel, X, Y, widen_steps

N = 20_000


def _model(
    frames: int, curvature_per_cm: float = 0.0, distance_cm: float = 3.0, **changes: object
) -> MotionModel:
    plain: dict[str, object] = {
        "distance_cm": np.full(frames, distance_cm),
        "curvature_per_cm": np.full(frames, curvature_per_cm),
        "factor_start": (1.0, 0.0),
        "factor_walk": 0.0,
        "factor_pull": 0.0,
        "distance_noise": 0.0,
        "offset_walk_per_cm": 0.0,
        "offset_decay": 0.0,
        "curvature_noise_per_cm": 0.0,
        "max_curvature_per_cm": 1.0,
    }
    return MotionModel(**(plain | changes))  # type: ignore[arg-type]


def _drive(model: MotionModel, particles: int, seed: int = 0, frames: int | None = None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    states = model.start(particles, rng)
    for k in range(1, len(model.distance_cm) if frames is None else frames):
        model.predict(states, k, rng)
    return states


@pytest.mark.parametrize("curvature", [1.0 / 60.0, -1.0 / 60.0, 1.0 / 400.0])
@pytest.mark.parametrize("distance", [1.0, 3.0, 8.0])
def test_without_noise_the_car_drives_the_analytic_arc(curvature, distance):
    frames = 61
    state = _drive(_model(frames, curvature, distance), 3)[0]
    turned = curvature * distance * (frames - 1)
    exact = np.array([np.sin(turned), 1.0 - np.cos(turned)]) / curvature
    assert state[HEADING] == pytest.approx(turned, abs=1e-9)
    # The step is taken as the chord, so that the circle is larger by (half a turn) / sin(half a turn).
    half = 0.5 * curvature * distance
    np.testing.assert_allclose(state[[X, Y]], exact * half / np.sin(half), atol=1e-9)
    # At 1:10 speeds that is nothing: a part in 24 of the turn per step, squared.
    assert np.linalg.norm(state[[X, Y]] - exact) <= 1.01 * half**2 / 6.0 * np.linalg.norm(exact) + 1e-9


def test_positive_curvature_turns_left():
    state = _drive(_model(10, 0.01), 1)[0]
    assert state[Y] > 0.0
    assert state[HEADING] > 0.0


def test_the_distance_factor_scales_the_path():
    state = _drive(_model(11, 0.0, factor_start=(1.3, 0.0)), 1)[0]
    assert state[X] == pytest.approx(1.3 * 3.0 * 10)


@pytest.mark.parametrize("curvature", [0.5, -0.5])
def test_curvature_is_bounded_so_that_the_heading_cannot_spin(curvature):
    model = _model(
        11, curvature, max_curvature_per_cm=0.02, curvature_noise_per_cm=1.0, offset_walk_per_cm=1.0
    )
    states = _drive(model, 500)
    assert np.abs(states[:, HEADING]).max() <= 0.02 * 3.0 * 10 + 1e-9
    steady = _drive(_model(11, curvature, max_curvature_per_cm=0.02), 1)[0]
    assert steady[HEADING] == pytest.approx(np.sign(curvature) * 0.02 * 3.0 * 10)


@pytest.mark.parametrize("seed", range(3))
def test_particles_spread_as_stated(seed):
    one = _drive(_model(2, distance_noise=0.05, curvature_noise_per_cm=0.004), N, seed)
    assert np.std(one[:, X]) == pytest.approx(0.05 * 3.0, rel=0.03)
    assert np.std(one[:, HEADING]) == pytest.approx(0.004 * 3.0, rel=0.03)
    # White noise adds up with the root of the number of frames.
    many = _drive(_model(26, distance_noise=0.05), N, seed)
    assert np.std(many[:, X]) == pytest.approx(0.05 * 3.0 * 5.0, rel=0.03)
    walked = _drive(_model(26, offset_walk_per_cm=0.001, factor_walk=0.004), N, seed)
    assert np.std(walked[:, OFFSET]) == pytest.approx(0.001 * 5.0, rel=0.03)
    assert np.std(walked[:, FACTOR]) == pytest.approx(0.004 * 5.0, rel=0.03)


def test_the_offset_is_forgotten_and_the_factor_pulled_back():
    # A walk with decay d is stationary at sigma / sqrt(1 - (1 - d)^2).
    settled = _drive(_model(120, offset_walk_per_cm=0.001, offset_decay=0.1), N)
    assert np.std(settled[:, OFFSET]) == pytest.approx(0.001 / np.sqrt(1.0 - 0.9**2), rel=0.03)
    model = _model(21, factor_start=(2.0, 0.0), factor_pull=0.1)
    states = model.start(1, np.random.default_rng(0))
    states[:, FACTOR] = 1.0
    for k in range(1, 21):
        model.predict(states, k, np.random.default_rng(0))
    assert states[0, FACTOR] == pytest.approx(2.0 - 0.9**20)


@pytest.mark.parametrize("seed", range(3))
def test_factors_are_positive_however_wide_the_start(seed):
    model = _model(20, factor_start=(0.5, 2.0), factor_walk=0.3)
    rng = np.random.default_rng(seed)
    states = model.start(2000, rng)
    assert states[:, FACTOR].min() > 0.0
    assert not states[:, [X, Y, HEADING, OFFSET]].any()
    for k in range(1, 20):
        model.predict(states, k, rng)
        assert states[:, FACTOR].min() > 0.0


def test_the_start_has_the_stated_mean_and_spread():
    factors = _model(2, factor_start=(3.0, 0.5)).start(N, np.random.default_rng(0))[:, FACTOR]
    assert np.mean(factors) == pytest.approx(3.0, abs=0.02)
    assert np.std(factors) == pytest.approx(0.5, rel=0.03)


def test_one_in_some_strays_so_many_times_as_far():
    model = _model(2, 0.01, distance_noise=0.05, curvature_noise_per_cm=0.004)
    rng = np.random.default_rng(0)
    before = model.start(N, rng)
    before[:, [X, Y, HEADING]] = rng.normal(size=(N, 3))
    states = before.copy()
    model.predict(states, 1, rng)
    predicted = states.copy()
    widen_steps(before, states, 5, 4.0)
    strays = np.arange(N) % 5 == 0
    np.testing.assert_array_equal(states[~strays], predicted[~strays])

    def steps(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = states[rows] - before[rows]
        return np.hypot(moved[:, X], moved[:, Y]), moved[:, HEADING]

    for few, most in zip(steps(strays), steps(~strays), strict=True):
        assert np.std(few) == pytest.approx(4.0 * np.std(most), rel=0.05)
        assert np.mean(few) == pytest.approx(np.mean(most), abs=0.1 * np.std(few))
    np.testing.assert_array_equal(states[:, [FACTOR, OFFSET]], predicted[:, [FACTOR, OFFSET]])
    # Nobody strays at factor one, or where none shall.
    for every, factor in ((5, 1.0), (0, 4.0)):
        same = predicted.copy()
        widen_steps(before, same, every, factor)
        np.testing.assert_allclose(same, predicted, atol=1e-9)
