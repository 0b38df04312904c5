from dataclasses import replace

import numpy as np
from synthetic_labels import make_label_set

from lanenet.evaluation.card import model_card
from lanenet.evaluation.comparison import SourceAnswers, compare_detectors
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.network.model_file import ModelMeta

TRUTH = np.tile([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0], (50, 1))
METRICS = {"parameters": 97310, "epochs": 8, "best_epoch": 7, "val_frames": 12, "val_rmse_cm": 0.5}


def card(*errors_cm, meta=None, conditions=None, tests=(), verdict=None):
    answers = [
        SourceAnswers(f"d/t{k}", "map", "map", TRUTH, {"n": TRUTH + e}, conditions=conditions or {})
        for k, e in enumerate(errors_cm)
    ]
    training = [make_label_set(4, 0), make_label_set(5, 1, camera_hash="cam1")]
    training = [replace(one, meta=replace(one.meta, verdict=verdict)) for one in training]
    meta = meta or model_meta()
    return model_card("mine", meta, METRICS, training, tests, compare_detectors(answers), [])


def model_meta(**changes):
    known = {
        "window": BirdseyeWindow(),
        "camera_hashes": ("cam0",),
        "wheelbase_cm": 26.0,
        "lane_width_cm": 40.0,
        "training_hash": "0",
        "rmse_cm": (1.0,) * 6,
        "reference": "map",
    }
    return ModelMeta(**{**known, **changes})


def test_it_says_what_it_learned_from_and_how_good_it_is():
    text = card(1.0, 1.0)
    assert text.startswith("# mine\n") and "97,310 weights" in text
    assert "9 frames of 2 label sets, labels from the map; 2 cameras; lanes of 40 cm" in text
    assert "100 frames of 2 test drives" in text and "RMSE 1.00 cm" in text
    assert "No group of frames, point or drive has an RMSE of 1.5 times" in text
    assert "0.00 % of the points are off by more than 4 cm" in text


def test_a_test_on_the_map_that_was_learned_from_is_owned_up_to():
    same, other = make_label_set(6, 2), make_label_set(6, 3, camera_hash="cam9")
    truth = make_label_set(6, 2, source="truth")
    assert "Test and training are parts of one recording" in card(1.0, tests=[same])
    assert "1 of the 2 tests and training are parts" in card(1.0, tests=[same, other])
    assert "one recording" not in card(1.0, tests=[other, truth])


def test_labels_of_a_rejected_map_are_owned_up_to_at_the_top():
    text = card(1.0, verdict="reject")
    assert "was rejected, and labelled all the same" in text[: text.index("## ")]
    assert "rejected" not in card(1.0, verdict="usable")


def test_weak_spots_are_named_the_worst_drive_first():
    far = np.zeros(6)
    far[2] = 5.0
    text = card(0.1, 0.2, far)
    weak = [line for line in text.splitlines() if line.startswith("- ")]
    assert weak[0].startswith("- left line, 30 cm ahead: RMSE 2.8") and weak[1].startswith("- `t2`: RMSE 2.0")
    assert len(weak) == 2
    # One of six points of one of three drives.
    assert "5.56 % of the points are off by more than 4 cm" in text


def test_doubt_is_told_as_the_networks_own():
    """The comparison's tables speak of the first of several detectors; in the card there is one."""
    unsure = np.repeat([0.1, 0.9], [10, 40])
    wrong = np.where(unsure < 0.5, 6.0, 0.1)[:, None]
    text = card(wrong, conditions={"confidence": unsure})
    assert "- confidence of the network (a car slows down below 0.5 and stops below 0.2) under 0.2: " in text
    assert "first detector" not in text


def test_lane_widths_of_the_training_are_its_limits():
    text = card(1.0, meta=model_meta(lane_width_range_cm=(23.0, 74.6)))
    assert "lanes of 23 to 75 cm" in text and "narrower than 23 or wider than 75 cm" in text
    assert "over such drives" not in text


def test_it_says_what_the_network_sees_of_an_edge():
    assert "edges of brightness, 9" in card(1.0)
    assert "edges of brightness, with their directions and hues, 9" in card(1.0, meta=model_meta(planes=5))
