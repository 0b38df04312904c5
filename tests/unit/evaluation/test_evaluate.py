import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lanenet.evaluation.errors import point_errors
from lanenet.geometry.lane import mirror_points

NAN = float("nan")


def test_hand_computed_errors():
    truth = np.array([[0.0, 0.0, 0.0, 10.0, 10.0, 10.0], [0.0, NAN, 0.0, 10.0, 10.0, 10.0]])
    pred = np.array([[3.0, 0.0, 0.0, 10.0, 10.0, 10.0], [-4.0, 5.0, NAN, 10.0, 10.0, 11.0]])
    table = point_errors(pred, truth, "truth")
    near_left = table.groups["left_0_cm"]
    assert near_left.rmse_cm == pytest.approx(np.sqrt((9 + 16) / 2))
    assert (near_left.worst_cm, near_left.median_cm, near_left.count) == (4.0, 3.5, 2)
    # The label that is missing does not count, the answer that is missing costs coverage.
    assert table.groups["left_15_cm"].truth_count == 1
    assert table.groups["left_30_cm"].coverage == 0.5
    assert table.groups["y = 30 cm"].rmse_cm == pytest.approx(np.sqrt(1 / 3))
    assert table.groups["left"].rmse_cm == pytest.approx(np.sqrt(25 / 4))
    assert table.groups["right"].worst_cm == 1.0
    assert (table.all.count, table.all.truth_count) == (10, 11)
    assert table.all.rmse_cm == pytest.approx(np.sqrt(26 / 10))
    assert table.point_rmse_cm[5] == pytest.approx(np.sqrt(0.5))


def test_p95_is_the_percentile_of_the_absolute_error():
    truth = np.zeros((101, 6))
    pred = np.tile(np.arange(-100.0, 1.0)[:, None], (1, 6))
    stats = point_errors(pred, truth).groups["right_0_cm"]
    assert (stats.p95_cm, stats.median_cm, stats.worst_cm) == (95.0, 50.0, 100.0)


points = arrays(np.float64, (7, 6), elements=st.floats(-100, 100) | st.just(NAN))


@given(points, points, st.floats(-50, 50))
def test_errors_do_not_change_when_all_is_mirrored_or_moved(pred, truth, shift):
    table = point_errors(pred, truth)
    mirrored = point_errors(mirror_points(pred), mirror_points(truth))
    moved = point_errors(pred + shift, truth + shift)
    np.testing.assert_allclose(mirrored.groups["left"].p95_cm, table.groups["right"].p95_cm, atol=1e-9)
    for name in table.groups:
        assert moved.groups[name].count == table.groups[name].count
        np.testing.assert_allclose(moved.groups[name].rmse_cm, table.groups[name].rmse_cm, atol=1e-6)


def test_without_answers_there_is_no_number():
    table = point_errors(np.full((3, 6), NAN), np.zeros((3, 6)))
    assert np.isnan(table.all.rmse_cm) and table.all.coverage == 0.0
    nothing = point_errors(np.zeros((3, 6)), np.full((3, 6), NAN))
    assert np.isnan(nothing.all.rmse_cm) and np.isnan(nothing.all.coverage)


def test_plain_values_carry_units_and_the_reference():
    data = point_errors(np.zeros((2, 6)), np.ones((2, 6)), "map").as_dict()
    assert data["reference"] == "map"
    assert data["groups"]["left_15_cm"] == {
        "rmse_cm": 1.0,
        "median_cm": 1.0,
        "p95_cm": 1.0,
        "worst_cm": 1.0,
        "count": 2,
        "coverage": 1.0,
    }
