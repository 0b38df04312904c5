"""What is set right after the training, on frames that the network did not learn from: doubt and presence."""

from __future__ import annotations

import numpy as np
import torch

from lanenet.learn.config import AugmentSettings
from lanenet.learn.dataset import LaneSamples
from lanenet.learn.loss import sigma_factors
from lanenet.learn.network import LaneNet
from lanenet.learn.predict import answer_rasters, predict

#: Share of the missing lines that are to be called absent, with a margin to the 95 % that are asked for.
_ABSENT_FOUND = 0.96
#: A network that needs more has not learned to tell lines, and would call most of them absent.
_MOST_SHIFT = 2.0


def calibrate_sigma(network: LaneNet, val: LaneSamples) -> None:
    """Scale a network's spread so that 68 % of its errors on frames it did not learn from lie within it."""
    answers = predict(network, val)
    factors = sigma_factors(answers.points_cm - answers.truth_cm, answers.sigma_cm)
    network.sigma_factor *= torch.from_numpy(factors).to(network.sigma_factor)


def calibrate_presence(network: LaneNet, val: LaneSamples) -> None:
    """Shift what a network says of lines so that it calls those absent that are.

    How often lines are missing in the training is no more than a setting, and with it where a probability of
    one half lies. It is put where 96 % of the lines that are taken out of frames it did not learn from are
    called absent, if it does not lie there already.
    """
    gone = AugmentSettings.only(missing_line=0.8, missing_both=0.2)
    batch = val.augmented_batch(np.arange(len(val)), gone, seed=0, epoch=0)
    odds = answer_rasters(network, batch.rasters, batch.lane_cm).presence_logit.double().cpu().numpy()
    absent = odds[batch.present == 0.0]
    if absent.size:
        network.lower_presence(min(max(float(np.quantile(absent, _ABSENT_FOUND)), 0.0), _MOST_SHIFT))
