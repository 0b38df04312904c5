import json
import math
from dataclasses import replace

import numpy as np
import pytest
from synthetic_labels import make_label_set

from lanenet.data.files import write_json
from lanenet.errors import LabelFormatError, ModelMismatchError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.evaluate import RasterAnswers, RasterModel
from lanenet.learn.robust import CHANGES, as_dict, change_settings, measure_robustness, robust_table

FINE = BirdseyeWindow()
LABELS = make_label_set(40, 0, window=FINE)


class ColumnModel(RasterModel):
    """Answers with the mean column of each half of the raster, and says that a half with cells has a line."""

    def __init__(self, window=FINE):
        self.window = window

    def check_window(self, window):
        if window != self.window:
            raise ModelMismatchError("another window")

    def answer(self, rasters, lane_cm=None):
        n = len(rasters)
        points, presence = np.full((n, 6), np.nan), np.zeros((n, 2))
        for i, raster in enumerate(rasters[:, 0]):
            seen = self.window.points(np.argwhere(raster).astype(float))
            for side, sign in enumerate((-1.0, 1.0)):
                half = seen[sign * seen[:, 0] > 0.0]
                if len(half) > 12:
                    presence[i, side] = 1.0
                    points[i, 3 * side : 3 * side + 3] = half[:, 0].mean()
                else:
                    points[i, 3 * side : 3 * side + 3] = sign * 20.0
        return RasterAnswers(points, np.where(presence.repeat(3, axis=1) > 0.5, 5.0, 20.0), presence)


def rows(models=None, sets=(LABELS,)):
    models = {"columns": ColumnModel()} if models is None else models
    return measure_robustness(models, sets, [f"set {k}" for k in range(len(sets))])


def test_every_change_is_measured_and_only_what_it_says_is_changed():
    found = {row.change: row for row in rows()}
    assert list(found) == list(CHANGES)
    # Only the missing line's points count where one is missing.
    assert found["one line missing"].errors.truth_count == 3 * 40
    assert found["none"].errors.truth_count == 6 * 40
    # The lines of these lanes are 40 cm apart, so that the one tells the other; the model guesses 20.
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


def test_all_models_see_the_same_and_the_table_has_a_line_for_each(tmp_path):
    found = rows({"a": ColumnModel(), "b": ColumnModel()}, [LABELS, make_label_set(9, 1, window=FINE)] * 2)
    for first, second in zip(found[::2], found[1::2], strict=True):
        assert (first.model, second.model) == ("a", "b") and first.errors == second.errors
        assert first.interval_cm == second.interval_cm
    assert found[0].interval_cm is not None
    table = robust_table(found)
    assert len(table.lines) == 2 * len(CHANGES)
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
    with pytest.raises(ModelMismatchError):
        rows({"a": ColumnModel(BirdseyeWindow(cell_cm=1.0))})
