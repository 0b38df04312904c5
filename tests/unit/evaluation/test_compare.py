import io
import json

import numpy as np
import pytest
from rich.console import Console

from lanenet.data.files import write_json
from lanenet.errors import LabelFormatError
from lanenet.evaluation.comparison import FORMAT, SourceAnswers, compare_detectors
from lanenet.evaluation.report import plot_errors
from lanenet.evaluation.tables import as_markdown, lay_out
from lanenet.image_header import image_size

NAN = float("nan")
TRUTH = np.tile([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0], (5, 1))


def source(name="a", reference="truth", **answers):
    return SourceAnswers(f"runs/{name}", "simulated drive", reference, TRUTH, answers)


def bold():
    answer = TRUTH + 2.0
    answer[:, 3:] += 8.0
    return answer


def shy():
    answer = TRUTH - 1.0
    answer[:, 3:] = NAN
    return answer


def test_each_detector_is_held_against_the_first_on_shared_points():
    found = compare_detectors([source(bold=bold(), shy=shy()), source("b", bold=bold(), shy=shy())])
    assert found.first == "bold" and list(found.shared) == ["shy"]
    assert found.tables["shy"].all.coverage == 0.5 and found.tables["bold"].all.coverage == 1.0
    assert found.tables["bold"].all.rmse_cm == pytest.approx(np.sqrt((4 + 100) / 2))
    shared = found.shared["shy"]
    assert shared.own.rmse_cm == pytest.approx(1.0)
    # The first detector's large errors lie on the right line, which the other did not answer.
    assert shared.first.rmse_cm == pytest.approx(2.0)
    assert shared.own.count == shared.first.count == 30
    assert shared.own.coverage == 0.5


def test_the_row_that_no_frame_shows_stands_apart():
    own = TRUTH + [9.0, 1.0, 1.0] * 2
    rows = compare_detectors([source(bold=bold(), own=own)]).shared_rows["own"]
    assert rows["y = 0"].own.rmse_cm == pytest.approx(9.0) and rows["y = 0"].own.count == 10
    assert rows["y = 15, 30"].own.rmse_cm == pytest.approx(1.0)
    assert rows["y = 15, 30"].first.rmse_cm == pytest.approx(np.sqrt((4 + 100) / 2))


def test_points_without_a_label_are_counted_beside_those_with_one():
    label = TRUTH.copy()
    label[:, 5] = NAN
    answer = TRUTH + [1.0, 1.0, 1.0, 1.0, 1.0, 7.0]
    masked = SourceAnswers("runs/a", "simulated drive", "truth", label, {"one": answer}, all_cm=TRUTH)
    found = compare_detectors([masked, source("b", one=TRUTH + 1.0)])
    whole = found.whole["one"]
    assert found.tables["one"].all.rmse_cm == pytest.approx(1.0)
    assert (whole.masked.rmse_cm, whole.masked.truth_count) == (pytest.approx(7.0), 5)
    assert (whole.all.rmse_cm, whole.all.truth_count) == (pytest.approx(np.sqrt(5.0)), 60)
    assert found.as_dict()["detectors"]["one"]["all_known"]["count"] == 60
    assert "| masked | 5 | 100% | 7.00 |" in as_markdown(found)
    assert not compare_detectors([source(one=TRUTH)]).whole


def test_a_detector_that_answers_nothing_spoils_no_other():
    mute = np.full_like(TRUTH, NAN)
    found = compare_detectors([source(bold=bold(), mute=mute, shy=shy())])
    assert found.shared["mute"].own.count == 0 and np.isnan(found.shared["mute"].first.rmse_cm)
    assert found.shared["shy"].first.rmse_cm == pytest.approx(2.0)


def test_sources_and_references_are_named():
    sources = [source(one=shy()), source("m", reference="map", one=TRUTH + 3.0)]
    found = compare_detectors(sources)
    assert found.reference == "map and truth"
    assert [(s.name, s.reference, s.frames) for s in found.sources] == [
        ("runs/a", "truth", 5),
        ("runs/m", "map", 5),
    ]
    assert [s.detectors["one"].rmse_cm for s in found.sources] == pytest.approx([1.0, 3.0])
    markdown = as_markdown(found)
    assert "against the map and truth" in markdown and "| a (truth) | 1.00 50% |" in markdown
    assert "against the truth" in as_markdown(compare_detectors(sources[:1]))


def test_json_holds_format_units_and_figures(tmp_path):
    answers = {"one": shy(), "two": bold()}
    write_json(tmp_path / "t.json", compare_detectors([source(**answers)]).as_dict())
    data = json.loads((tmp_path / "t.json").read_text())
    assert data["format"] == FORMAT == "lanenet-evaluation/1"
    assert data["units"]["*_cm"] == "centimetre" and data["rows_cm"] == [0.0, 15.0, 30.0]
    one, two = data["detectors"]["one"], data["detectors"]["two"]
    assert one["groups"]["right_15_cm"]["rmse_cm"] is None and one["shared"] is None
    assert two["shared_with"] == "one" and two["shared"]["rmse_cm"] == pytest.approx(2.0)
    assert two["first_on_shared"]["rmse_cm"] == pytest.approx(1.0)
    assert data["sources"][0]["detectors"]["two"]["worst_cm"] == pytest.approx(10.0)


def test_tables_have_whole_rows_and_fit_a_terminal():
    answers = dict.fromkeys(("network", "lane-filter", "hough", "hough-value", "painter"), TRUTH + 12.345)
    found = compare_detectors([source(**answers), source("held_out_drive", **answers)])
    tables = lay_out(found)
    assert len(tables) == 4
    for table in tables:
        lines = [line for line in table.as_markdown().splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in lines}) == 1 and len(lines) == 2 + len(table.lines)
        console = Console(width=80, file=io.StringIO(), record=True)
        console.print(table.as_rich())
        # An ellipsis is what rich leaves of a cell that does not fit.
        assert "…" not in console.export_text()
    assert tables[0].lines[0] == ["network", "RMSE", *["12.3"] * 7]
    assert tables[0].lines[4] == ["", "answered", *["100%"] * 7]


def test_one_detector_on_one_source_needs_two_tables():
    assert len(lay_out(compare_detectors([source(one=shy())]))) == 2


def test_the_picture_is_a_picture_even_where_nothing_was_answered():
    mute = np.full_like(TRUTH, NAN)
    exact = TRUTH.copy()
    for answers in ({"mute": mute}, {"shy": shy(), "mute": mute, "exact": exact}):
        size = image_size(plot_errors(compare_detectors([source(**answers)])))
        assert size is not None and min(size) > 200


def test_the_picture_shows_the_errors():
    small = plot_errors(compare_detectors([source(one=TRUTH + 1.0)]))
    assert small == plot_errors(compare_detectors([source(one=TRUTH - 1.0)]))
    assert small != plot_errors(compare_detectors([source(one=shy() + 0.5)]))


def test_what_cannot_be_compared_is_refused():
    with pytest.raises(LabelFormatError, match="no source"):
        compare_detectors([])
    with pytest.raises(LabelFormatError, match="runs/a: no detector"):
        compare_detectors([source()])
    with pytest.raises(LabelFormatError, match=r"runs/a, detector 'bad'.*\(1, 6\).*\(5, 6\)"):
        compare_detectors([source(bad=TRUTH[:1])])
    with pytest.raises(LabelFormatError, match="runs/b: answered by two, expected one"):
        compare_detectors([source(one=TRUTH), source("b", two=TRUTH)])
