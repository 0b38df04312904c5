"""Piecewise cubics: through what is known, past outliers, over short gaps only."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.lanes.fit import FitSettings, LaneLine, fit_lines
from datagen.lanes.path import Path
from datagen.lanes.trace import TracedLane

HEIGHT_CM = 15.0
LANE_CM = 36.0
SETTINGS = FitSettings()
BRIDGE_CM = SETTINGS.bridge_heights * HEIGHT_CM


def _path(radius_cm: float | None, length_cm: float = 500.0) -> Path:
    s = np.arange(0.0, length_cm, 1.8)
    heading = np.zeros_like(s) if radius_cm is None else s / radius_cm
    xy = np.column_stack([s, np.zeros_like(s)])
    if radius_cm is not None:
        xy = radius_cm * np.column_stack([np.sin(heading), 1.0 - np.cos(heading)])
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    return Path(1.8, xy, left, np.arange(0.0, length_cm - 75.0, 3.0))


def _traced(path: Path, noise_cm: float = 0.0, seed: int = 0) -> tuple[TracedLane, np.ndarray]:
    """A lane whose centre wanders about the path, and that centre."""
    centre = 4.0 * np.sin(2.0 * np.pi * path.s_cm / 200.0)
    noise = noise_cm * np.random.default_rng(seed).normal(size=(2, len(centre)))
    left, right = centre + 0.5 * LANE_CM + noise[0], centre - 0.5 * LANE_CM + noise[1]
    return TracedLane(left, right, centre, LANE_CM, 2.0), centre


def _without(lane: TracedLane, left: np.ndarray, right: np.ndarray | None = None) -> TracedLane:
    return TracedLane(
        np.where(left, np.nan, lane.left_cm),
        lane.right_cm if right is None else np.where(right, np.nan, lane.right_cm),
        lane.centre_cm,
        lane.lane_cm,
        lane.tape_cm,
    )


def _across(path: Path, line: LaneLine, offset_cm: np.ndarray) -> np.ndarray:
    """Distance of the line from where it should be, across the path; NaN where unsupported."""
    return np.sum((line.points(path.s_cm) - path.points(offset_cm)) * path.left, axis=1)


@pytest.mark.parametrize("radius", [None, 90.0, -150.0])
def test_known_offsets_are_met_and_noise_is_smoothed(radius):
    path = _path(radius)
    lane, centre = _traced(path)
    left, right = fit_lines(path, lane, HEIGHT_CM, SETTINGS)
    assert (left.side, right.side) == ("left", "right")
    for line, offset in ((left, centre + 0.5 * LANE_CM), (right, centre - 0.5 * LANE_CM)):
        error = _across(path, line, offset)
        assert np.isfinite(error).all()
        assert np.abs(error).max() < 0.1
        np.testing.assert_allclose(line.supported_cm, [[path.s_cm[0], path.s_cm[-1]]])
    noisy, _ = _traced(path, noise_cm=0.3)
    for line, offset in zip(
        fit_lines(path, noisy, HEIGHT_CM, SETTINGS),
        (centre + 0.5 * LANE_CM, centre - 0.5 * LANE_CM),
        strict=True,
    ):
        error = _across(path, line, offset)
        assert np.sqrt(np.mean(error**2)) < 0.17
        assert np.abs(error).max() < 0.5
        assert line.residual_cm == pytest.approx(0.3, rel=0.25)


@pytest.mark.parametrize("seed", range(3))
def test_outliers_are_ignored(seed):
    path = _path(120.0)
    lane, centre = _traced(path, noise_cm=0.15, seed=seed)
    rng = np.random.default_rng(seed)
    spoilt = lane.left_cm.copy()
    wrong = rng.choice(len(spoilt), len(spoilt) // 12, replace=False)
    spoilt[wrong] += rng.choice([-6.0, 6.0], len(wrong))
    left, _ = fit_lines(path, TracedLane(spoilt, lane.right_cm, centre, LANE_CM, 2.0), HEIGHT_CM, SETTINGS)
    error = np.abs(_across(path, left, centre + 0.5 * LANE_CM))
    assert np.median(error) < 0.15
    assert np.nanmax(error) < 1.0
    assert left.residual_cm < 0.35


def test_a_short_gap_is_bridged_and_a_long_one_is_not():
    path = _path(150.0)
    lane, centre = _traced(path)
    s = path.s_cm
    short = (s > 100.0) & (s < 100.0 + 0.8 * BRIDGE_CM)
    long = (s > 250.0) & (s < 250.0 + 2.0 * BRIDGE_CM)
    left, right = fit_lines(path, _without(lane, short | long), HEIGHT_CM, SETTINGS)
    assert left.supported_cm.shape == (2, 2)
    assert left.supported(s[short]).all()
    assert not left.supported(s[long][2:-2]).any()
    points = left.points(s)
    assert np.isnan(points[long][2:-2]).all()
    assert np.isfinite(points[~long]).all()
    # The right line, a lane's width away, guides the cubic through the gap.
    error = np.abs(_across(path, left, centre + 0.5 * LANE_CM))
    assert error[short].max() < 0.5
    assert right.supported(s).all()


def test_both_lines_missing_follow_the_lanes_centre_over_a_short_gap():
    path = _path(150.0)
    lane, centre = _traced(path)
    gap = (path.s_cm > 200.0) & (path.s_cm < 245.0)
    left, right = fit_lines(path, _without(lane, gap, gap), HEIGHT_CM, SETTINGS)
    for line, offset in ((left, centre + 0.5 * LANE_CM), (right, centre - 0.5 * LANE_CM)):
        assert np.abs(_across(path, line, offset))[gap].max() < 0.5


def test_dashes_are_one_line():
    path = _path(200.0)
    lane, centre = _traced(path, noise_cm=0.1)
    missing = np.mod(path.s_cm, 40.0) > 15.0
    left, _ = fit_lines(path, _without(lane, missing), HEIGHT_CM, SETTINGS)
    assert left.supported_cm.shape == (1, 2)
    error = np.abs(_across(path, left, centre + 0.5 * LANE_CM))
    assert np.nanmax(error) < 0.4


def test_a_spot_in_a_long_gap_is_not_believed():
    path = _path(None)
    lane, _ = _traced(path)
    s = path.s_cm
    gap = (s > 150.0) & (s < 350.0) & ~((s > 245.0) & (s < 255.0))
    left, _ = fit_lines(path, _without(lane, gap), HEIGHT_CM, SETTINGS)
    assert left.supported_cm.shape == (2, 2)
    assert not left.supported(np.array([250.0])).any()


def test_a_line_that_was_never_seen_is_supported_nowhere():
    path = _path(150.0)
    lane, _ = _traced(path)
    everywhere = np.ones(len(path.s_cm), dtype=bool)
    left, right = fit_lines(path, _without(lane, everywhere), HEIGHT_CM, SETTINGS)
    assert left.supported_cm.shape == (0, 2)
    assert np.isnan(left.points(path.s_cm)).all()
    assert np.isnan(left.residual_cm)
    assert np.isfinite(right.points(path.s_cm)).all()


def test_points_outside_the_support_are_unknown():
    path = _path(None)
    lane, _ = _traced(path)
    left, _ = fit_lines(path, lane, HEIGHT_CM, SETTINGS)
    end = path.s_cm[-1]
    points = left.points(np.array([-5.0, -1e-3, 0.0, 250.0, end, end + 1e-3, end + 40.0]))
    np.testing.assert_array_equal(np.isfinite(points[:, 0]), [False, False, True, True, True, False, False])


@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_scaling_scales_every_length(factor):
    path = _path(120.0)
    lane, _ = _traced(path, noise_cm=0.2)
    gap = (path.s_cm > 200.0) & (path.s_cm < 320.0)
    left, _ = fit_lines(path, _without(lane, gap), HEIGHT_CM, SETTINGS)
    scaled = left.scaled(factor)
    s = np.linspace(-10.0, 510.0, 200)
    np.testing.assert_allclose(scaled.points(factor * s), factor * left.points(s), atol=1e-9)
    assert scaled.residual_cm == pytest.approx(factor * left.residual_cm)
    assert scaled.side == "left"


def test_moving_the_path_moves_the_lines():
    path = _path(120.0)
    lane, _ = _traced(path, noise_cm=0.2)
    c, s = np.cos(1.2), np.sin(1.2)
    rotation, shift = np.array([[c, -s], [s, c]]), np.array([-300.0, 700.0])
    moved = Path(path.step_cm, path.xy_cm @ rotation.T + shift, path.left @ rotation.T, path.s_frames_cm)
    for here, there in zip(
        fit_lines(path, lane, HEIGHT_CM, SETTINGS), fit_lines(moved, lane, HEIGHT_CM, SETTINGS), strict=True
    ):
        np.testing.assert_allclose(
            there.points(path.s_cm), here.points(path.s_cm) @ rotation.T + shift, atol=1e-6
        )
