"""The trees that predict the errors of labels, against a plain reading of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from datagen.quality import label_error
from datagen.quality.evidence import LabelFeatures
from datagen.quality.label_error import Trees, predict_errors
from lanenet.geometry.lane import N_POINTS

NAMES, MODEL = label_error._model()


def drawn_features(count: int) -> np.ndarray:
    """Values at which the trees split, and beside them; a fifth is unknown."""
    rng = np.random.default_rng(5)
    values = rng.normal(0.0, 3.0, (count, len(NAMES)))
    for trees in MODEL.values():
        for column in range(len(NAMES)):
            thresholds = trees.threshold[trees.feature == column]
            if len(thresholds):
                chosen = rng.random(count) < 0.5
                values[chosen, column] = rng.choice(thresholds, chosen.sum())
    values[rng.random(values.shape) < 0.2] = np.nan
    return values.astype(np.float32)


def leaf(trees: Trees, tree: int, row: list[float]) -> float:
    """The leaf of one tree that one label falls into."""
    node = 0
    while (column := int(trees.feature[tree, node])) >= 0:
        value, to_left = row[column], bool(trees.missing_left[tree, node])
        if not math.isnan(value):
            to_left = value <= float(trees.threshold[tree, node])
        node = int((trees.left if to_left else trees.right)[tree, node])
    return float(trees.value[tree, node])


@pytest.mark.parametrize("name", MODEL)
def test_trees_are_summed_as_one_reads_them(name, monkeypatch):
    trees, features = MODEL[name], drawn_features(60)
    slope, intercept = trees.scale.tolist()
    expected = [
        slope * sum(leaf(trees, tree, row) for tree in range(len(trees.feature))) + intercept
        for row in features.tolist()
    ]
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(trees.predict(features), expected, rtol=1e-4, atol=1e-5)
    # Some at once, and none.
    monkeypatch.setattr(label_error, "_AT_ONCE", 7)
    np.testing.assert_allclose(trees.predict(features), expected, rtol=1e-4, atol=1e-5)
    assert trees.predict(features[:0]).shape == (0,)


def test_errors_are_probabilities_and_a_large_one_is_no_more_likely_than_a_small_one():
    values = drawn_features(600).reshape(100, N_POINTS, -1)
    s_cm = np.where(np.arange(600).reshape(100, -1) % 7 == 0, np.nan, 1.0)
    # More features than the trees ask for, in another order.
    names = ("another", *reversed(NAMES))
    values = np.concatenate([np.full((100, N_POINTS, 1), 9.0, np.float32), values[..., ::-1]], axis=2)
    found = predict_errors(LabelFeatures(names, values, np.zeros((100, N_POINTS), int), s_cm))
    judged = np.isfinite(s_cm)
    for errors in found:
        np.testing.assert_array_equal(np.isfinite(errors), judged)
    assert (found.off_3[judged] <= found.off_1[judged]).all() and (found.sigma_cm[judged] > 0.0).all()
    assert (found.off_3[judged] >= 0.0).all() and (found.off_1[judged] <= 1.0).all()
    assert np.ptp(found.off_1[judged]) > 0.5 and found.withheld[~judged].all()
    logits = MODEL["off_1"].predict(values[judged][:, :0:-1])
    np.testing.assert_allclose(found.off_1[judged], 1.0 / (1.0 + np.exp(-logits)), atol=1e-4)


def test_a_map_withholds_the_same_labels_when_it_is_read_back():
    """Its table has four decimals."""
    values = drawn_features(6).reshape(1, N_POINTS, -1)
    features = LabelFeatures(NAMES, values, np.zeros((1, N_POINTS), int), np.ones((1, N_POINTS)))
    errors = np.concatenate(predict_errors(features))
    np.testing.assert_array_equal(errors, np.round(errors, 4))
