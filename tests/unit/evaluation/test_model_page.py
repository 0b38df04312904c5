"""The report page of a model: the sentence, the worst frames with what is off in them, tables folded."""

from __future__ import annotations

import re

import numpy as np
from small_map import CAMERA, N

from lanenet.data.maps.mapped_drive import LabelledFrames
from lanenet.evaluation.comparison import SeenSource, SourceAnswers, compare_detectors
from lanenet.evaluation.model_page import model_page
from lanenet.evaluation.verdict import verdict_sentence
from lanenet.perception.edges.road import PerceptionSettings

TRUTH = np.tile([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0], (N, 1))


def page_of_answers(answers_cm: np.ndarray, reference: str = "map", plain: bool = False) -> tuple[str, str]:
    """The page and its sentence."""
    frames = LabelledFrames(
        "maps/one", reference, CAMERA, 40.0, 2.0, PerceptionSettings(), np.arange(100, 100 + N),
        np.arange(N) == 0, TRUTH, lambda i: np.zeros((120, 160, 3), np.uint8),
    )  # fmt: skip
    answers = {"network": answers_cm, "painter": TRUTH + 1.0}
    comparison = compare_detectors([SourceAnswers("maps/one", "map", reference, TRUTH, answers)])
    seen = [SeenSource(frames, answers_cm, np.full(N, plain))]
    return model_page("mine", comparison, seen, "here"), verdict_sentence(comparison, seen, "here")


def test_the_sentence_is_that_of_the_terminal_and_the_worst_frame_says_what_is_off():
    answers = TRUTH + 0.5
    answers[7, 4] += 12.0
    page, sentence = page_of_answers(answers)
    assert f"<p>H{sentence[1:]}.</p>" in page
    captions = re.findall("<figcaption>(frame.*?)</figcaption>", page)
    assert captions[0] == "frame 107: right line 12.5 cm off, 15 cm ahead" and len(captions) > 1
    assert "the map is wrong" in page and "Wrong in plain sight" not in page
    # The other detectors come after all that is about this one, and folded.
    assert page.index("painter") > page.index("<details>") > page.index("Along the drive")
    row = r"<td class=text>right 15 cm</td><td>0.50</td><td>0.50</td><td>12.5</td>"
    assert re.search(row, page)


def test_a_truth_is_not_doubted_and_errors_in_plain_sight_have_their_own_frames():
    answers = TRUTH + 0.5
    answers[7, 4] += 12.0
    page, _ = page_of_answers(answers, "truth", plain=True)
    assert "is wrong" not in page and "Wrong in plain sight" in page
    assert page.count("frame 107: right line 12.5 cm off") == 4  # alt and caption, in both places


def test_a_line_beside_the_picture_is_said_to_be_out_of_view(monkeypatch):
    beside = TRUTH + np.where(np.arange(6) < 3, 0.0, 80.0)
    monkeypatch.setitem(globals(), "TRUTH", beside)
    answers = beside + 0.5
    answers[7, 4] += 12.0
    answers[29, 1] += 9.0
    page, _ = page_of_answers(answers)
    captions = re.findall("<figcaption>(frame.*?)</figcaption>", page)
    assert captions[0] == "frame 107: right line 12.5 cm off, 15 cm ahead (out of view)"
    assert captions[1] == "frame 129: left line 9.50 cm off, 15 cm ahead"


def test_a_model_that_answers_nothing_has_a_page():
    page, sentence = page_of_answers(np.full_like(TRUTH, np.nan))
    assert sentence[1:] in page and "Worst frames" not in page and "Along the drive" not in page
