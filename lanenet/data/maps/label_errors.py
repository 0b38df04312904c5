"""How far the labels of a map are expected to be off, and which of them are given."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.lane import N_POINTS

#: Probabilities of being off by more than 1 cm, and by more than 3 cm, beyond which a label is withheld.
#: Chosen on 115 simulated drives, each left out of the fit: 95 % of the right labels stay, and 0.1 % of what
#: stays is off by more than 3 cm, 4 % in the worst drive.
MAX_OFF_1, MAX_OFF_3 = 0.5, 0.02


class LabelErrors(NamedTuple):
    """Predicted errors of the six labels of each frame; NaN where a label cannot be judged.

    Attributes:
        sigma_cm: Standard deviation of the label about the truth.
        off_1: Probability that it is off by more than 1 cm.
        off_3: Probability that it is off by more than 3 cm.
    """

    sigma_cm: Float[np.ndarray, "n 6"]
    off_1: Float[np.ndarray, "n 6"]
    off_3: Float[np.ndarray, "n 6"]

    @classmethod
    def none(cls, frames: int) -> LabelErrors:
        """Return the errors of labels that nobody doubts: those of a map that is not judged yet."""
        return cls(*(np.zeros((frames, N_POINTS)) for _ in cls._fields))

    @classmethod
    def withholding(cls, wrong: Bool[np.ndarray, "n 6"]) -> LabelErrors:
        """Return errors by which some labels are withheld and all others are given."""
        return cls(np.zeros(wrong.shape), wrong.astype(np.float64), wrong.astype(np.float64))

    @property
    def withheld(self) -> Bool[np.ndarray, "n 6"]:
        """Labels that are too likely to be wrong, or cannot be judged."""
        return ~((self.off_1 <= MAX_OFF_1) & (self.off_3 <= MAX_OFF_3))

    @property
    def doubted(self) -> Bool[np.ndarray, "n 6"]:
        """Labels that are too likely to be wrong, without those that cannot be judged."""
        return self.withheld & np.isfinite(self.off_3)
