"""The error of a label, predicted: its sigma, and the probabilities that it is off by more than 1 and 3 cm.

Three ensembles of regression trees take the evidence of :mod:`datagen.quality.evidence`. They were fitted on
simulated drives, of which the truth is known, by ``tests/bench/fit_label_error.py`` (``make fit-labels``),
are stored as plain arrays, and are read here with NumPy alone.

Source:
    Friedman 2001, "Greedy function approximation: a gradient boosting machine". The quality of a prediction
    from hand-made features of it: Schubert et al. 2023, "LidarMetaDetect".
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from importlib.resources import as_file, files
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from datagen.quality.evidence import LabelFeatures
from lanenet.data.maps.label_errors import MAX_OFF_1, MAX_OFF_3, LabelErrors

#: File of the trees, beside this module.
MODEL_NAME = "label_error.npz"
#: Errors whose probabilities are predicted, [cm].
BOUNDS_CM = (1.0, 3.0)
#: Kinds of evidence, by parts of the features' names: see :func:`doubted_by`.
KINDS = {
    "gaps": ("gap_before", "gap_after", "sideways"),
    "camera": ("ahead_cm", "focal_cm", "pitch_cm"),
    "line": ("sigma_cm", "bridged", "width_off", "turn_rad", "slope"),
    "unseen": ("_met", "_both", "_views", "visible"),
    "beside": ("_rival", "offset_cm", "_apart", "_shift", "one_border"),
}
#: Decimals of the errors, so that a map that is read back withholds the same labels. Chosen: a tenth of a
#: millimetre, a share of 0.01 %.
_DECIMALS = 4
#: Withheld labels that are explained at most. Chosen: a sample is enough for a share.
_MOST_EXPLAINED = 2000
#: Labels that are predicted at once: what the trees' numbers of them take is a few MB.
_AT_ONCE = 8192


class Trees(NamedTuple):
    """An ensemble of binary regression trees; each starts at its node 0.

    Attributes:
        feature: Column by which each node splits; -1 at a leaf.
        threshold: A label whose feature is at most this goes to the left.
        missing_left: Whether it goes to the left where the feature is unknown.
        left: Node to the left.
        right: Node to the right.
        value: What a leaf adds.
        scale: Slope and intercept of the calibrated logit, or logarithm, over the sum of the values.
    """

    feature: Int[np.ndarray, "t n"]
    threshold: Float[np.ndarray, "t n"]
    missing_left: Bool[np.ndarray, "t n"]
    left: Int[np.ndarray, "t n"]
    right: Int[np.ndarray, "t n"]
    value: Float[np.ndarray, "t n"]
    scale: Float[np.ndarray, "2"]

    def predict(self, features: Float32[np.ndarray, "m f"]) -> Float[np.ndarray, "m"]:
        """Return the calibrated sum of the leaves that each row falls into."""
        parts = [self._sum(features[i : i + _AT_ONCE]) for i in range(0, len(features), _AT_ONCE)]
        return self.scale[0] * np.concatenate([np.zeros(0), *parts]) + self.scale[1]

    def _sum(self, features: Float32[np.ndarray, "m f"]) -> Float[np.ndarray, "m"]:
        tree = np.arange(len(self.feature))
        node = np.zeros((len(features), len(tree)), np.int64)
        while True:
            column = self.feature[tree, node]
            if (column < 0).all():
                return np.asarray(self.value[tree, node].sum(axis=1))
            value = np.take_along_axis(features, np.maximum(column, 0), axis=1)
            goes_left = np.where(
                np.isnan(value), self.missing_left[tree, node], value <= self.threshold[tree, node]
            )
            after = np.where(goes_left, self.left[tree, node], self.right[tree, node])
            node = np.where(column < 0, node, after)


@cache
def _model() -> tuple[tuple[str, ...], dict[str, Trees]]:
    with as_file(files(__package__) / MODEL_NAME) as path, np.load(path) as stored:
        trees = {
            name: Trees(*(stored[f"{name}_{part}"] for part in Trees._fields))
            for name in ("off_1", "off_3", "log_error")
        }
        return tuple(stored["names"].tolist()), trees


def predict_errors(features: LabelFeatures) -> LabelErrors:
    """Predict the errors of a map's labels; NaN where the map's lines give none."""
    labels = np.isfinite(features.s_cm)
    predicted = _predict(features.names, features.values[labels])
    placed = np.full((len(predicted), *labels.shape), np.nan)
    placed[:, labels] = np.round(predicted, _DECIMALS)
    return LabelErrors(*placed)


def doubted_by(
    features: LabelFeatures, errors: LabelErrors, given: Bool[np.ndarray, "n 6"]
) -> dict[str, float]:
    """Share of the withheld labels by the kind of evidence that speaks most against each, the largest first.

    That is the kind without which the label would be doubted least: with values as given labels have them.
    What is not seen has no place beside the line either.
    """
    rows = features.values[errors.withheld & np.isfinite(features.s_cm)]
    if not len(rows) or not given.any():
        return {}
    rows = rows[:: len(rows) // _MOST_EXPLAINED + 1]
    known = (column[np.isfinite(column)] for column in features.values[given].T)
    usual = np.array([np.median(column) if len(column) else np.nan for column in known], np.float32)
    without = []
    of_kind = {
        kind: np.array([any(part in name for part in parts) for name in features.names])
        for kind, parts in KINDS.items()
    }
    unseen = np.isnan(rows) & of_kind["beside"]
    for kind, mine in of_kind.items():
        replaced = (mine | unseen) if kind == "unseen" else (mine & ~unseen)
        _, off_1, off_3 = _predict(features.names, np.where(replaced, usual, rows))
        without.append(np.maximum(off_1 / MAX_OFF_1, off_3 / MAX_OFF_3))
    counts = Counter(np.array(list(KINDS))[np.argmin(without, axis=0)].tolist())
    return {kind: count / len(rows) for kind, count in counts.most_common()}


def _predict(names: tuple[str, ...], values: Float32[np.ndarray, "m f"]) -> Float[np.ndarray, "3 m"]:
    """Sigma, and probabilities of being off by more than 1 and 3 cm, of some labels."""
    wanted, trees = _model()
    chosen = values[:, [names.index(name) for name in wanted]]
    off_1, off_3 = (1.0 / (1.0 + np.exp(-trees[name].predict(chosen))) for name in ("off_1", "off_3"))
    sigma_cm = 1.4826 * np.exp(trees["log_error"].predict(chosen))
    return np.stack([sigma_cm, off_1, np.minimum(off_1, off_3)])
