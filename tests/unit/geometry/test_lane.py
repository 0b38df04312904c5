from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lanenet.geometry.lane import (
    N_POINTS,
    PARABOLA_FROM_POINTS,
    POINT_NAMES,
    ROWS_CM,
    SIDES,
    mirror_points,
    parabola_through,
    parabolas_from_points,
    row_crossings,
    rows_of_polyline,
)

six_points_cm = hnp.arrays(
    np.float64, st.tuples(st.integers(0, 5), st.just(N_POINTS)), elements=st.floats(-200.0, 200.0)
)


def test_contract_of_the_labels() -> None:
    assert ROWS_CM == (0.0, 15.0, 30.0)
    assert SIDES == ("left", "right")
    assert POINT_NAMES == (
        "left_0_cm",
        "left_15_cm",
        "left_30_cm",
        "right_0_cm",
        "right_15_cm",
        "right_30_cm",
    )
    assert len(POINT_NAMES) == N_POINTS


def test_parabola_matrix_by_hand() -> None:
    # a = (x0 - 2 x15 + x30) / 450, b = (-3 x0 + 4 x15 - x30) / 30, c = x0.
    expected = np.array([[1 / 450, -2 / 450, 1 / 450], [-3 / 30, 4 / 30, -1 / 30], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(PARABOLA_FROM_POINTS, expected, atol=1e-15)


def test_parabola_through_known_points() -> None:
    # Left line x = 0.01 y^2 - 20, right line x = 0.5 y + 20.
    parabolas = parabolas_from_points(np.array([-20.0, -17.75, -11.0, 20.0, 27.5, 35.0]))
    np.testing.assert_allclose(parabolas, [[0.01, 0.0, -20.0], [0.0, 0.5, 20.0]], atol=1e-12)


@given(six_points_cm)
def test_points_and_parabolas_are_one_to_one(points: np.ndarray) -> None:
    parabolas = parabolas_from_points(points)
    assert parabolas.shape == (len(points), 2, 3)
    for row, y_cm in enumerate(ROWS_CM):
        np.testing.assert_allclose(np.polyval(parabolas[:, 0].T, y_cm), points[:, row], atol=1e-9)
        np.testing.assert_allclose(np.polyval(parabolas[:, 1].T, y_cm), points[:, 3 + row], atol=1e-9)


@pytest.mark.parametrize("missing", range(N_POINTS))
def test_a_missing_point_loses_its_line_and_only_its_line(missing: int) -> None:
    points = np.arange(6.0)
    points[missing] = np.nan
    parabolas = parabolas_from_points(points)
    assert np.isnan(parabolas[missing // 3]).any()
    assert np.isfinite(parabolas[1 - missing // 3]).all()


def test_rows_of_a_slanted_line() -> None:
    # x = -20 + y / 3, sampled at points that are not the rows.
    y = np.array([-10.0, 5.0, 20.0, 50.0])
    line = np.stack([-20.0 + y / 3.0, y], axis=1)
    np.testing.assert_allclose(rows_of_polyline(line), [-20.0, -15.0, -10.0], atol=1e-12)


def test_rows_at_the_very_vertices() -> None:
    line = np.array([[1.0, 0.0], [2.0, 15.0], [3.0, 30.0], [4.0, 45.0]])
    np.testing.assert_array_equal(rows_of_polyline(line), [1.0, 2.0, 3.0])


def test_rows_that_the_line_does_not_reach_are_missing() -> None:
    line = np.array([[5.0, 10.0], [5.0, 20.0]])
    np.testing.assert_array_equal(rows_of_polyline(line), [np.nan, 5.0, np.nan])


def test_a_line_that_comes_back_is_answered_by_its_first_stretch() -> None:
    # A hairpin to the right: up along x = 0 to y = 20, and back down along x = 60.
    line = np.array([[0.0, -10.0], [0.0, 20.0], [60.0, 20.0], [60.0, -10.0]])
    np.testing.assert_array_equal(rows_of_polyline(line), [0.0, 0.0, np.nan])
    # Walked the other way round, the stretch that recedes is the other one.
    np.testing.assert_array_equal(rows_of_polyline(line[::-1]), [60.0, 60.0, np.nan])


@pytest.mark.parametrize("count", [0, 1])
def test_less_than_two_points_cross_no_row(count: int) -> None:
    assert np.isnan(rows_of_polyline(np.zeros((count, 2)))).all()


def test_crossings_of_several_lines_are_those_of_each() -> None:
    rng = np.random.default_rng(3)
    lines = rng.uniform(-20.0, 60.0, (40, 12, 2))
    lines[rng.random((40, 12)) < 0.1] = np.nan
    point, share = row_crossings(lines[..., 1])
    for line, k, part in zip(lines, point, share, strict=True):
        x = line[k, 0] + part * (line[k + 1, 0] - line[k, 0])
        np.testing.assert_array_equal(x, rows_of_polyline(line))
        known = np.isfinite(part)
        y = line[k, 1] + part * (line[k + 1, 1] - line[k, 1])
        np.testing.assert_allclose(y[known], np.array(ROWS_CM)[known], atol=1e-9)


def test_a_break_in_the_line_is_not_bridged() -> None:
    line = np.array([[0.0, -5.0], [0.0, 10.0], [np.nan, np.nan], [4.0, 20.0], [4.0, 40.0]])
    np.testing.assert_array_equal(rows_of_polyline(line), [0.0, np.nan, 4.0])


@pytest.mark.parametrize("n", [0, 1])
def test_a_line_of_no_stretch_has_no_rows(n: int) -> None:
    assert np.isnan(rows_of_polyline(np.zeros((n, 2)))).all()


def test_mirror_by_hand() -> None:
    mirrored = mirror_points(np.array([-20.0, -19.0, -18.0, 20.0, 22.0, np.nan]))
    np.testing.assert_array_equal(mirrored, [-20.0, -22.0, np.nan, 20.0, 19.0, 18.0])


@given(six_points_cm)
def test_mirroring_twice_changes_nothing_and_flips_the_parabolas(points: np.ndarray) -> None:
    np.testing.assert_array_equal(mirror_points(mirror_points(points)), points)
    mirrored = parabolas_from_points(mirror_points(points))
    np.testing.assert_allclose(mirrored, -parabolas_from_points(points)[:, ::-1], atol=1e-9)


def test_plain_numbers_give_the_same_parabola() -> None:
    points = np.random.default_rng(2).normal(0.0, 30.0, (50, 3))
    for line in points:
        np.testing.assert_allclose(parabola_through(*line.tolist()), PARABOLA_FROM_POINTS @ line, atol=1e-10)
    assert not np.isfinite(parabola_through(1.0, float("nan"), 2.0)[0])
