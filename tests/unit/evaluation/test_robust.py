import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_labels import make_label_set

from lanenet.data.files import write_json
from lanenet.errors import LabelFormatError, ModelMismatchError
from lanenet.evaluation.answers import RasterAnswers, RasterModel
from lanenet.evaluation.robustness import CHANGES, as_dict, change_settings, measure_robustness, robust_table
from lanenet.geometry.birdseye import BirdseyeWindow

FINE = BirdseyeWindow()
LABELS = make_label_set(40, 0, window=FINE)


class ColumnModel(RasterModel):
    """Answers with the mean column of each half of the raster, and says that a half with cells has a line.

    For a half without, it guesses a lane of the width that it is told, or of one of its own.
    """

    def __init__(self, window=FINE, takes_width=False, own_width_cm=36.0, guess_sigma_cm=20.0):
        self.window, self.meta = window, SimpleNamespace(takes_width=takes_width, window=window)
        self.own_width_cm, self.guess_sigma_cm = own_width_cm, guess_sigma_cm
        self.told = []

    def check_edges(self, perception):
        if perception != LABELS.meta.perception:
            raise ModelMismatchError("other edges")

    def answer(self, rasters, lane_cm=None):
        n = len(rasters)
        lane_cm = lane_cm if self.meta.takes_width else None
        self.told.append(None if lane_cm is None else set(lane_cm.tolist()))
        widths_cm = np.full(n, self.own_width_cm) if lane_cm is None else lane_cm
        points, presence = np.full((n, 6), np.nan), np.zeros((n, 2))
        for i, raster in enumerate(rasters[:, 0]):
            seen = self.window.points(np.argwhere(raster).astype(float))
            for side, sign in enumerate((-1.0, 1.0)):
                half = seen[sign * seen[:, 0] > 0.0]
                if len(half) > 12:
                    presence[i, side] = 1.0
                    points[i, 3 * side : 3 * side + 3] = half[:, 0].mean()
                else:
                    points[i, 3 * side : 3 * side + 3] = sign * 0.5 * widths_cm[i]
        sigma = np.where(presence.repeat(3, axis=1) > 0.5, 5.0, self.guess_sigma_cm)
        return RasterAnswers(points, sigma, presence)


def rows(models=None, sets=(LABELS,)):
    models = {"columns": ColumnModel()} if models is None else models
    return measure_robustness(models, sets, [f"set {k}" for k in range(len(sets))])


def test_every_change_is_measured_and_only_what_it_says_is_changed():
    found = {row.change: row for row in rows()}
    # Nobody tells this model the width: it is unknown where nothing else is said.
    assert list(found) == [change for change in CHANGES if change != "same, width unknown"]
    # Only the missing line's points count where one is missing.
    assert found["one line missing"].errors.truth_count == 3 * 40
    assert found["none"].errors.truth_count == 6 * 40
    # The lines of these lanes are 40 cm apart, so that the one tells the other; the model guesses 18 at 20.
    known, unknown = found["same, width known"].errors, found["one line missing"].errors
    assert known.truth_count == unknown.truth_count and known.rmse_cm < unknown.rmse_cm
    assert found["both lines missing"].errors is None
    assert found["both lines missing"].presence.absent_recall == 1.0
    assert found["both lines missing"].presence.there == 0
    assert found["none"].presence.absent == 0
    # A centimetre per degree or so: turned roads are far from the middle of their columns.
    assert found["heading and offset"].errors.rmse_cm > found["none"].errors.rmse_cm
    assert change_settings("none").model_copy(update={"missing_line": 1.0}) == change_settings(
        "one line missing"
    )
    assert change_settings("pitch 1 deg wrong").pitch_rad == pytest.approx(math.radians(1.0))


def test_a_model_that_can_be_told_the_width_is_told_it_but_where_it_is_unknown():
    # So sure of its guess that nothing is rebuilt: what is left is whether it was told.
    model = ColumnModel(takes_width=True, guess_sigma_cm=1.0)
    found = {row.change: row for row in rows({"columns": model})}
    assert list(found) == [change for change in CHANGES if change != "same, width known"]
    unknown = list(found).index("same, width unknown")
    assert [told is None for told in model.told] == [k == unknown for k in range(len(found))]
    assert model.told[0] == {40.0}
    told, untold = found["one line missing"].errors, found["same, width unknown"].errors
    assert told.truth_count == untold.truth_count == 3 * 40 and told.rmse_cm < untold.rmse_cm


def test_with_the_width_known_the_missing_line_is_rebuilt_by_either_kind_of_model():
    models = {"plain": ColumnModel(), "told": ColumnModel(takes_width=True)}
    found = {(row.change, row.model): row.errors for row in rows(models)}
    # Of what it guesses by itself nothing is left, whatever it was told: the memory is surer.
    assert found["one line missing", "told"] == found["same, width known", "plain"]
    # Nor does one model's guess without the width differ from the other's.
    assert found["same, width unknown", "told"] == found["one line missing", "plain"]


def test_lines_of_one_change_stay_together_in_the_table():
    models = {"told": ColumnModel(takes_width=True), "plain": ColumnModel()}
    table = robust_table(rows(models))
    two = [change for change in CHANGES if not change.startswith("same")]
    assert [line[0] for line in table.lines if line[1] == "told"] == [
        "same, width unknown" if change == "same, width known" else change
        for change in CHANGES
        if change != "same, width unknown"
    ]
    rich = table.as_rich()
    ends = [line[0] for line, row in zip(table.lines, rich.rows, strict=True) if row.end_section]
    assert ends == [change for change in CHANGES if change in two[:-1] or change.startswith("same")]
    alone = robust_table(rows({"told": ColumnModel(takes_width=True)})).as_rich()
    assert not any(row.end_section for row in alone.rows)


def test_all_models_see_the_same_and_the_table_has_a_line_for_each(tmp_path):
    found = rows({"a": ColumnModel(), "b": ColumnModel()}, [LABELS, make_label_set(9, 1, window=FINE)] * 2)
    for first, second in zip(found[::2], found[1::2], strict=True):
        assert (first.model, second.model) == ("a", "b") and first.errors == second.errors
        assert first.interval_cm == second.interval_cm
    assert found[0].interval_cm is not None
    table = robust_table(found)
    assert len(table.lines) == 2 * (len(CHANGES) - 1)
    write_json(tmp_path / "r.json", as_dict(found))
    data = json.loads((tmp_path / "r.json").read_text())
    assert (
        data["format"] == "lanenet-robustness/1" and data["changes"]["30 % clutter"]["clutter_share"] == 0.3
    )
    assert data["rows"][0]["errors"]["rmse_cm"] == pytest.approx(found[0].errors.rmse_cm)


def test_the_table_fits_a_terminal():
    import io

    from rich.console import Console

    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(robust_table(rows({"network": ColumnModel()}, [LABELS] * 3)).as_rich())
    assert "…" not in console.export_text()


def test_what_cannot_be_changed_is_refused():
    nothing = (np.empty((0, 2)), np.empty((0, 2)))
    with pytest.raises(LabelFormatError, match="set 0: has no lane lines"):
        rows(sets=[replace(LABELS, lines=[nothing] * len(LABELS))])
    in_colour = replace(LABELS, meta=replace(LABELS.meta, perception=LABELS.meta.perception.with_colours()))
    with pytest.raises(ModelMismatchError):
        rows(sets=[in_colour])


def test_each_model_sees_the_window_that_it_is_for():
    models = {"fine": ColumnModel(), "coarse": ColumnModel(BirdseyeWindow(cell_cm=1.0))}
    found = {row.model: row.errors for row in rows(models) if row.change == "none"}
    assert found["coarse"].truth_count == found["fine"].truth_count
    # The coarse window reaches further, where these lanes bend away.
    assert found["coarse"].rmse_cm != found["fine"].rmse_cm
