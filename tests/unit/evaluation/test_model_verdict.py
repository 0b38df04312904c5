"""The verdict on a model says only what was measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_map import CAMERA, N, small_map

from lanenet.data.maps.folder import write_map
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.mapped_drive import LabelledFrames
from lanenet.evaluation.comparison import Comparison, SeenSource, SourceAnswers, compare_detectors
from lanenet.evaluation.tables import lay_out, main_tables
from lanenet.evaluation.verdict import verdict_sentence
from lanenet.perception.edges.road import PerceptionSettings

TRUTH = np.tile([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0], (N, 1))


def compared(answers_cm: np.ndarray, name: str) -> tuple[Comparison, list[SeenSource]]:
    frames = LabelledFrames(
        name, "map", CAMERA, 40.0, 2.0, PerceptionSettings(), np.arange(100, 100 + N), np.arange(N) == 0,
        TRUTH, lambda i: np.zeros((120, 160, 3), np.uint8),
    )  # fmt: skip
    source = SourceAnswers(name, "map", "map", TRUTH, {"network": answers_cm, "painter": TRUTH})
    return compare_detectors([source]), [SeenSource(frames, answers_cm, np.zeros(N, bool))]


def test_a_model_without_large_errors_needs_half_a_sentence():
    said = verdict_sentence(*compared(TRUTH + 0.6, "m"), "on the last lap")
    assert said == (
        "on the last lap it lies 0.60 cm from the map (median; 95 % of its answers within 0.60 cm) and "
        "answers 100 % of the points; no answer is off by more than 4 cm"
    )


@pytest.mark.parametrize(("row", "doubted"), [(9, True), (29, False)])
def test_the_worst_frame_is_named_and_the_maps_own_doubt_there(tmp_path: Path, row: int, doubted: bool):
    """The small map doubts its frames 108 to 115; what cannot be judged is no doubt."""
    drive_map = small_map()
    if not doubted:
        unknown = np.where(np.arange(6) == 3, np.nan, np.zeros((N, 6)))
        drive_map = replace(drive_map, errors=LabelErrors(unknown, unknown, unknown))
    write_map(tmp_path / "m", drive_map, {"frame": np.arange(2)}, {}, "given")
    answers = TRUTH + 0.5
    answers[row, 2] += 12.0
    answers[:15, 5] = np.nan
    said = verdict_sentence(*compared(answers, str(tmp_path / "m")), "here")
    assert f"the worst near frame {100 + row} by 12.5 cm" in said and "answers 92 % of" in said
    assert "0.61 % of its answers are off by more than 4 cm" in said
    assert ("map itself is in doubt" in said) == doubted


def test_a_model_that_answers_nothing_has_no_median():
    said = verdict_sentence(*compared(np.full_like(TRUTH, np.nan), "m"), "here")
    assert said == "not fit to drive with: here it answers none of the 180 points"


def test_a_model_that_answers_little_or_is_often_far_off_is_not_fit_to_drive_with():
    good = TRUTH + 0.5
    rarely, wrong = good.copy(), good.copy()
    rarely[: len(TRUTH) * 6 // 10] = np.nan
    wrong[::5] += 9.0
    told = [verdict_sentence(*compared(answers, "m"), "here") for answers in (good, rarely, wrong)]
    assert [said.startswith("not fit to drive with: here it lies") for said in told] == [False, True, True]


def test_one_table_holds_the_detectors_that_were_asked_for():
    comparison, _ = compared(TRUTH + 0.6, "m")
    shown, _ = main_tables(comparison, ["network"])
    assert {line[0] for line in shown.lines} == {"network", ""}
    assert {line[0] for line in lay_out(comparison)[0].lines} == {"network", "painter", ""}
    assert "painter" not in shown.note
