import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rich.console import Console
from synthetic_labels import make_label_set

from lanenet.errors import LabelFormatError
from lanenet.geometry.lane import mirror_points
from lanenet.learn.evaluate import evaluate_detectors, format_table, point_errors

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


def test_detectors_are_compared_on_common_points():
    sets = [make_label_set(5, 0, source="truth"), make_label_set(5, 1, source="truth")]

    def shy(labels):
        answer = labels.points_cm + 1.0
        answer[:, 3:] = NAN
        return answer

    def bold(labels):
        answer = labels.points_cm + 2.0
        answer[:, 3:] += 8.0
        return answer

    tables = evaluate_detectors(sets, {"shy": shy, "bold": bold})
    assert tables["shy"].all.coverage == 0.5 and tables["bold"].all.coverage == 1.0
    assert tables["bold"].all.rmse_cm == pytest.approx(np.sqrt((4 + 100) / 2))
    assert tables["shy"].common_rmse_cm == pytest.approx(1.0)
    assert tables["bold"].common_rmse_cm == pytest.approx(2.0)
    assert tables["bold"].common_count == 30
    rich_table, markdown = format_table(tables)
    assert "against the truth" in markdown and "against the truth" in str(rich_table.title)
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines}) == 1 and len(lines) == 2 + 2 * 6
    assert lines[2].split("|")[1:4] == [" shy ", " RMSE ", " 1.00 "]
    assert lines[6].split("|")[1:5] == ["  ", " answered ", " 50% ", " 100% "]
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(rich_table)
    assert "bold" in console.export_text()


def test_the_reference_is_named():
    tables = evaluate_detectors([make_label_set(2, 0, source="map")], {"a": lambda s: s.points_cm})
    assert tables["a"].reference == "map" and tables["a"].as_dict()["reference"] == "map"
    assert "against the map" in format_table(tables)[1]


def test_wrong_answers_are_refused():
    with pytest.raises(LabelFormatError, match=r"'bad'.*\(1, 6\).*\(3, 6\)"):
        evaluate_detectors([make_label_set(3, 0)], {"bad": lambda s: s.points_cm[:1]})
    with pytest.raises(LabelFormatError, match="no label set"):
        evaluate_detectors([], {})
