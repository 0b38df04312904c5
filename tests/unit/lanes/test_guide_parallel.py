"""Lines side by side: parallel on the map, whatever the path does."""

from __future__ import annotations

import numpy as np
import pytest
from lane_edges import arc_path, ring_path

from datagen.lanes.fit import distance_across, interpolation_error, parallel_offset
from datagen.lanes.path import Path

APART_CM = 60.0


def _offset_of(path: Path, points_cm: np.ndarray) -> np.ndarray:
    """Offset of a curve, given densely, at each path sample, by the tangent of its nearest point."""
    away = points_cm[None] - path.xy_cm[:, None]
    nearest = np.argmin(np.sum(away**2, axis=2), axis=1)
    away = away[np.arange(len(path.xy_cm)), nearest]
    ahead = away[:, 0] * path.left[:, 1] - away[:, 1] * path.left[:, 0]
    along = np.gradient(points_cm, axis=0)[nearest]
    slope = np.sum(along * path.left, axis=1) / (
        along[:, 0] * path.left[:, 1] - along[:, 1] * path.left[:, 0]
    )
    return np.sum(away * path.left, axis=1) - slope * ahead


@pytest.mark.parametrize("apart_cm", [APART_CM, -APART_CM])
def test_a_straight_line_oblique_to_a_straight_path(apart_cm):
    path = arc_path(None)
    slope = 0.4
    beside = parallel_offset(path, slope * path.s_cm - 50.0, np.full(len(path.s_cm), apart_cm))
    # The two lines are further apart across the path than across themselves.
    inner = slice(40, -40)
    expected = slope * path.s_cm - 50.0 + apart_cm * np.hypot(1.0, slope)
    np.testing.assert_allclose(beside[inner], expected[inner], atol=1e-6)


def test_an_oblique_line_along_a_bend():
    path = arc_path(200.0, 200.0)
    start, along = np.array([0.0, -30.0]), np.array([np.cos(0.5), np.sin(0.5)])
    t = np.arange(-100.0, 500.0, 0.5)
    line, other = (
        start + t[:, None] * along + shift * np.array([-along[1], along[0]]) for shift in (0.0, APART_CM)
    )
    found = parallel_offset(path, _offset_of(path, line), np.full(len(path.s_cm), APART_CM))
    part = (path.s_cm > 70.0) & (path.s_cm < 130.0)
    np.testing.assert_allclose(found[part], _offset_of(path, other)[part], atol=0.15)


def test_on_a_lap_the_seam_is_like_any_other_place():
    path = ring_path(150.0)
    wave = 15.0 * np.sin(2.0 * np.pi * 3.0 * path.s_cm / (path.period_cm or 1.0))
    turned = 40
    apart = np.full(len(wave), APART_CM)
    found = parallel_offset(path, wave, apart)
    shifted = parallel_offset(path, np.roll(wave, turned), apart)
    np.testing.assert_allclose(np.roll(found, turned), shifted, atol=1e-9)
    np.testing.assert_allclose(
        distance_across(path, wave, found, np.ones(len(wave), dtype=bool)), APART_CM, atol=0.12
    )


def test_the_distance_is_known_where_the_other_line_is():
    path = arc_path(None)
    known = (path.s_cm < 200.0) | (path.s_cm > 300.0)
    slope = 0.3
    found = distance_across(path, slope * path.s_cm, slope * path.s_cm + 40.0, known)
    # The place opposite lies further back along the path, by the sine of the angle.
    opposite = path.s_cm - 40.0 * slope / np.hypot(1.0, slope) ** 2
    expected = (opposite < 200.0) | (opposite > 300.0)
    inner = (path.s_cm > 40.0) & (path.s_cm < 460.0)
    near_end = np.minimum(np.abs(opposite - 200.0), np.abs(opposite - 300.0)) < 3.0
    assert (np.isfinite(found) == expected)[inner & ~near_end].all()
    good = inner & np.isfinite(found)
    np.testing.assert_allclose(found[good], 40.0 / np.hypot(1.0, slope), atol=0.05)


def test_what_varies_along_the_road_is_not_known_in_a_long_gap():
    path = arc_path(None)
    width = 40.0 + 10.0 * np.sin(2.0 * np.pi * path.s_cm / 160.0)
    gap = np.abs(path.s_cm - 250.0) < 30.0
    error = interpolation_error(path, np.where(gap, np.nan, width))
    assert error[~gap].max() == 0.0
    assert error[gap].max() > 3.0
    # Where the nearest known width is a few centimetres away, it is nearly that.
    assert error[gap][1] < 0.5
    level = interpolation_error(path, np.where(gap, np.nan, 40.0))
    np.testing.assert_allclose(level, 0.0)


def test_inside_a_corner_the_parallel_does_not_run_back():
    """Inside a corner of 90 degrees it goes from one leg to the other, without a swallowtail."""
    path = arc_path(None)
    at = 0.5 * path.s_cm[-1]
    corner = np.abs(path.s_cm - at)
    found = parallel_offset(path, corner, np.full(len(path.s_cm), 50.0))
    # The legs' parallels meet above the corner: the distance over the cosine of 45 degrees.
    away = np.abs(path.s_cm - at)
    inner = away < 0.5 * at
    np.testing.assert_allclose(found[inner], (corner + 50.0 * np.sqrt(2.0))[inner], atol=2.5)
    assert (np.abs(np.diff(found))[inner[1:]] < 1.2 * path.step_cm).all()


def test_the_same_on_a_closed_path():
    """A ring whose line has a corner: the parallel inside passes every place once."""
    path = ring_path(200.0)
    at, period = path.s_cm[len(path.s_cm) // 2], path.period_cm
    away = np.abs(np.mod(path.s_cm - at + 0.5 * period, period) - 0.5 * period)
    corner = np.maximum(40.0 - away, 0.0)
    found = parallel_offset(path, corner, np.full(len(path.s_cm), -APART_CM))
    assert found.shape == path.s_cm.shape
    assert np.isfinite(found).all()
    far = away > 150.0
    np.testing.assert_allclose(found[far], -APART_CM, atol=0.5)
