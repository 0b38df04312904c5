"""Piecewise cubics: through the borders of the paint, past clutter, over gaps, without a seam."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from lane_edges import arc_path, joined, paint, ring_path, speckle

from datagen.lanes.fit import FitSettings, fit_lines
from datagen.lanes.path import Path, PathEdges
from datagen.lanes.trace import TracedLane, TraceSettings, trace_adjacent, trace_lane
from lanenet.data.maps.line import LaneLine

HEIGHT_CM = 15.0
LANE_CM = 36.0
TAPE_CM = 2.4
SETTINGS = FitSettings()
BRIDGE_CM = SETTINGS.bridge_heights * HEIGHT_CM


def _centre(path: Path) -> np.ndarray:
    """Offset of a lane's centre that wanders about the path, in whole waves of a closed one."""
    length = path.period_cm or 200.0 * max(1, round(path.s_cm[-1] / 200.0))
    return 4.0 * np.sin(2.0 * np.pi * path.s_cm * round(length / 200.0) / length)


def _everywhere(path: Path) -> np.ndarray:
    return np.ones(len(path.xy_cm), dtype=bool)


def _fit(path: Path, left: PathEdges, right: PathEdges, *others: PathEdges) -> list[LaneLine]:
    edges = joined(left, right, *others)
    lane = trace_lane(path, edges, HEIGHT_CM, LANE_CM, TraceSettings())
    lane = trace_adjacent(path, edges, lane, HEIGHT_CM, TraceSettings())
    return fit_lines(path, edges, lane, HEIGHT_CM, SETTINGS)


def _lane(
    path: Path, seed: int, left_seen: np.ndarray, right_seen: np.ndarray | None = None, **noise: Any
) -> list[LaneLine]:
    rng = np.random.default_rng(seed)
    centre = _centre(path)
    right = _everywhere(path) if right_seen is None else right_seen
    return _fit(
        path,
        paint(rng, path, centre + 0.5 * LANE_CM, left_seen, **noise),
        paint(rng, path, centre - 0.5 * LANE_CM, right, **noise),
        speckle(rng, path, 300),
    )


def _across(path: Path, line: LaneLine, offset_cm: np.ndarray) -> np.ndarray:
    """Distance of the line from where it should be, across the path; NaN where unsupported."""
    return np.sum((line.points(path.s_cm) - path.points(offset_cm)) * path.left, axis=1)


@pytest.mark.parametrize("radius", [None, 90.0, -150.0])
@pytest.mark.parametrize("seed", range(2))
def test_solid_lines_among_clutter_are_met(radius, seed):
    path = arc_path(radius)
    lines = _lane(path, seed, _everywhere(path))
    assert [(line.side, line.rank, line.index) for line in lines] == [("left", 0, 0), ("right", 0, 1)]
    for line, sign in zip(lines, (0.5, -0.5), strict=True):
        error = _across(path, line, _centre(path) + sign * LANE_CM)
        assert np.isfinite(error).all()
        assert np.sqrt(np.mean(error**2)) < 0.06
        assert np.abs(error).max() < 0.3
        assert line.residual_cm == pytest.approx(0.1, rel=0.3)
        assert line.marking_cm == pytest.approx(TAPE_CM, abs=0.05)


def test_a_single_border_does_not_pull_the_middle():
    rng = np.random.default_rng(0)
    path = arc_path(150.0)
    centre = _centre(path)
    worn = (path.s_cm > 200.0) & (path.s_cm < 225.0)
    left = joined(
        paint(rng, path, centre + 18.0, ~worn),
        # From 200 to 225 cm only the outer border is left.
        paint(rng, path, centre + 18.0, worn, borders=(1.0,)),
    )
    line = _fit(path, left, paint(rng, path, centre - 18.0, _everywhere(path)))[0]
    error = np.abs(_across(path, line, centre + 18.0))
    assert error[worn].max() < 0.15


def test_a_border_alone_far_from_the_paint_is_not_believed():
    rng = np.random.default_rng(0)
    path = arc_path(150.0)
    centre = _centre(path)
    gone = path.s_cm > 180.0
    left = joined(
        paint(rng, path, centre + 18.0, ~gone),
        # The seam of a carpet, where the paint has ended.
        paint(rng, path, centre + 18.0, gone, borders=(1.0,)),
    )
    line = _fit(path, left, paint(rng, path, centre - 18.0, _everywhere(path)))[0]
    assert not line.supported(np.array([300.0, 400.0])).any()


@pytest.mark.parametrize("period_cm", [9.0, 40.0])
def test_dashes_are_one_line(period_cm):
    path = arc_path(200.0)
    dashes = np.mod(path.s_cm, period_cm) < 0.5 * period_cm
    left, _ = _lane(path, 1, dashes)
    assert left.supported_cm.shape == (1, 2)
    error = np.abs(_across(path, left, _centre(path) + 0.5 * LANE_CM))
    assert np.nanpercentile(error, 95) < 0.3


def test_a_gap_is_bridged_with_growing_uncertainty_and_a_long_one_is_not():
    path = arc_path(150.0, 900.0)
    s = path.s_cm
    short = (s > 100.0) & (s < 100.0 + 0.6 * BRIDGE_CM)
    long = (s > 300.0) & (s < 300.0 + 3.2 * BRIDGE_CM)
    left, right = _lane(path, 0, ~(short | long))
    assert left.supported_cm.shape == (2, 2)
    assert left.supported(s[short]).all()
    middle = np.array([300.0 + 1.6 * BRIDGE_CM])
    assert np.isnan(left.points(middle)).all()
    assert np.isfinite(left.everywhere(middle)).all()
    # The right line, a lane's width away, guides the cubic through the gap.
    error = np.abs(_across(path, left, _centre(path) + 0.5 * LANE_CM))
    assert error[short].max() < 1.0
    at_gap, at_paint = left.sigma_cm(np.array([100.0 + 0.3 * BRIDGE_CM, 60.0]))
    assert at_gap > 3.0 * at_paint
    assert (error[short] < 3.0 * left.sigma_cm(s[short])).all()
    assert right.supported(s).all()


def test_paint_that_turns_off_at_a_junction_does_not_bend_the_line():
    rng = np.random.default_rng(0)
    path = arc_path(None)
    flat = np.zeros(len(path.s_cm))
    mouth = (path.s_cm > 200.0) & (path.s_cm < 270.0)
    # A quarter circle of 10 cm on either side of the mouth.
    into = np.clip(10.0 - np.minimum(np.abs(path.s_cm - 200.0), np.abs(path.s_cm - 270.0)), 0.0, 9.0)
    turning = flat - 18.0 - (10.0 - np.sqrt(100.0 - into**2))
    _, right = _fit(
        path,
        paint(rng, path, flat + 18.0, _everywhere(path)),
        paint(rng, path, turning, ~mouth),
    )
    inside = (path.s_cm > 185.0) & (path.s_cm < 285.0)
    assert np.abs(_across(path, right, flat - 18.0))[inside].max() < 0.8


def test_a_neighbouring_lane_with_two_solid_lines_does_not_take_over():
    rng = np.random.default_rng(2)
    path = arc_path(200.0)
    centre = _centre(path)
    dashes = np.mod(path.s_cm, 30.0) < 12.0
    everywhere = _everywhere(path)
    lines = _fit(
        path,
        paint(rng, path, centre + 18.0, dashes),
        paint(rng, path, centre - 18.0, everywhere & (np.mod(path.s_cm, 160.0) > 50.0)),
        paint(rng, path, centre + 54.0, everywhere),
        paint(rng, path, centre + 90.0, everywhere),
    )
    assert [line.index for line in lines] == [0, 1, -1]
    for line, offset in zip(lines, (18.0, -18.0, 54.0), strict=True):
        assert np.nanmedian(np.abs(_across(path, line, centre + offset))) < 0.1


def test_stop_lines_and_crossings_are_no_lines():
    rng = np.random.default_rng(3)
    path = arc_path(None)
    centre = _centre(path)
    across = []
    for place in (120.0, 240.0, 360.0):
        for border in (1.0, -1.0):
            n = 400
            s = place - 2.0 * border + 0.1 * rng.normal(size=n)
            d = rng.uniform(-20.0, 20.0, n)
            one = np.ones(n)
            across.append(
                PathEdges(s, d, 0.05 * one, border * one, one, 15.0 * one, (s / 3.0).astype(np.int64))
            )
    lines = _fit(
        path,
        paint(rng, path, centre + 18.0, _everywhere(path)),
        paint(rng, path, centre - 18.0, _everywhere(path)),
        *across,
    )
    assert [line.index for line in lines] == [0, 1]
    for line, sign in zip(lines, (18.0, -18.0), strict=True):
        assert np.abs(_across(path, line, centre + sign)).max() < 0.3


@pytest.mark.parametrize("seed", range(2))
def test_a_lap_has_no_seam(seed):
    path = ring_path(120.0)
    assert path.period_cm is not None
    period = path.period_cm
    gap = (path.s_cm < 15.0) | (path.s_cm > period - 20.0)
    lines = _lane(path, seed, ~gap if seed else _everywhere(path))
    for line, sign in zip(lines, (0.5, -0.5), strict=True):
        assert line.period_cm == pytest.approx(period)
        assert line.supported(np.array([0.0, period, -30.0, 1.5 * period])).all()
        error = np.abs(_across(path, line, _centre(path) + sign * LANE_CM))
        assert np.percentile(error, 95) < 0.5
        for derivative in range(3):
            here, there, before = (
                line.everywhere(np.array([s]), derivative) for s in (0.0, period, -1e-9 * period)
            )
            np.testing.assert_allclose(here, there, atol=1e-9)
            np.testing.assert_allclose(here, before, atol=1e-6)
        # The spline's own ends, not only what evaluation maps onto one another.
        np.testing.assert_allclose(line.coefficients_cm[:3], line.coefficients_cm[-3:], atol=1e-9)
        np.testing.assert_allclose(np.diff(line.knots_cm[:7]), np.diff(line.knots_cm[-7:]), atol=1e-9)
        np.testing.assert_allclose(line.sigma_cm(np.array([1.0])), line.sigma_cm(np.array([1.0 + period])))


@pytest.mark.parametrize(("noise", "pass_noise"), [(1.0, 0.0), (0.2, 0.3)])
def test_the_uncertainty_is_about_the_error(noise, pass_noise):
    path = arc_path(200.0)
    ratios = []
    for seed in range(4):
        dashes = np.mod(path.s_cm, 24.0) < 12.0
        for line, sign in zip(
            _lane(path, seed, dashes, noise_cm=noise, pass_noise_cm=pass_noise, passes=6),
            (0.5, -0.5),
            strict=True,
        ):
            error = _across(path, line, _centre(path) + sign * LANE_CM)
            known = np.isfinite(error) & (path.s_cm < 420.0)
            ratios.append(error[known] / line.sigma_cm(path.s_cm[known]))
    ratio = np.sqrt(np.mean(np.concatenate(ratios) ** 2))
    assert 0.6 < ratio < 1.6


def test_a_line_that_was_never_seen_is_supported_nowhere():
    rng = np.random.default_rng(0)
    path = arc_path(150.0)
    centre = _centre(path)
    edges = paint(rng, path, centre - 18.0, _everywhere(path))
    never = np.full(len(centre), np.nan)
    traced = TracedLane(never, centre - 18.0, centre, LANE_CM, TAPE_CM)
    left, right = fit_lines(path, edges, traced, HEIGHT_CM, SETTINGS)
    assert left.supported_cm.shape == (0, 2)
    assert np.isnan(left.points(path.s_cm)).all()
    assert np.isnan(left.residual_cm)
    assert np.isfinite(right.points(path.s_cm)).all()


@pytest.mark.parametrize("factor", [0.4, 2.5])
@pytest.mark.parametrize("closed", [True, False])
def test_scaling_scales_every_length(factor, closed):
    path = ring_path(90.0) if closed else arc_path(120.0)
    left, _ = _lane(path, 0, ~((path.s_cm > 150.0) & (path.s_cm < 400.0)))
    scaled = left.scaled(factor)
    s = np.linspace(-10.0, 610.0, 200)
    np.testing.assert_allclose(scaled.points(factor * s), factor * left.points(s), atol=1e-8)
    np.testing.assert_allclose(scaled.sigma_cm(factor * s), factor * left.sigma_cm(s), atol=1e-9)
    assert scaled.residual_cm == pytest.approx(factor * left.residual_cm)
    assert (scaled.side, scaled.rank) == ("left", 0)


def test_moving_the_path_moves_the_lines():
    path = arc_path(120.0)
    c, s = np.cos(1.2), np.sin(1.2)
    rotation, shift = np.array([[c, -s], [s, c]]), np.array([-300.0, 700.0])
    moved = Path(path.step_cm, path.xy_cm @ rotation.T + shift, path.left @ rotation.T, path.s_frames_cm)
    for here, there in zip(
        _lane(path, 0, _everywhere(path)), _lane(moved, 0, _everywhere(path)), strict=True
    ):
        np.testing.assert_allclose(
            there.points(path.s_cm), here.points(path.s_cm) @ rotation.T + shift, atol=1e-5
        )


@pytest.mark.parametrize("slope", [0.35, -0.35])
def test_a_gap_is_bridged_parallel_to_the_other_line_where_the_path_is_oblique(slope):
    rng = np.random.default_rng(5)
    path = arc_path(None)
    # The car weaves from side to side of a straight lane; seen from its path the lane weaves.
    centre = slope * 60.0 * np.sin(path.s_cm / 60.0)
    across = 0.5 * LANE_CM * np.hypot(1.0, np.gradient(centre) / path.step_cm)
    gap = (path.s_cm > 150.0) & (path.s_cm < 230.0)
    left = paint(rng, path, centre + across, ~gap)
    lines = _fit(path, left, paint(rng, path, centre - across, _everywhere(path)))
    assert lines[0].supported(path.s_cm[gap]).all()
    right = lines[1].points(path.s_cm)
    apart = [np.nanmin(np.linalg.norm(right - place, axis=1)) for place in lines[0].points(path.s_cm[gap])]
    np.testing.assert_allclose(apart, LANE_CM, atol=0.6)
