"""A network's answers on held-out frames, and what is set by them after the training."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from lanenet.evaluation.errors import ErrorTable, point_errors
from lanenet.learn.loss import sigma_factors
from lanenet.learn.network import LaneNet, LaneOutput, input_of_rasters
from lanenet.samples.dataset import Samples
from lanenet.samples.settings import AugmentSettings

_BATCH = 256
#: Share of the errors that :func:`trimmed_rmse_cm` counts. Chosen: label sets of maps have up to 1 % of
#: points that are wrong by a lane.
_KEPT = 0.99
#: Share of the missing lines that are to be called absent: the 95 % that are wanted, with a margin.
_ABSENT_FOUND = 0.96
#: Largest shift of the log odds of presence. A network that needs more has not learned to tell lines, and
#: would call most of them absent. Chosen.
_MOST_SHIFT = 2.0


@dataclass(frozen=True)
class Answers:
    """A network's answers on frames, and their labels.

    Attributes:
        points_cm: The six points.
        sigma_cm: Their sigmas.
        presence: Probability that each line can be seen.
        truth_cm: Labels; NaN where masked.
        present: 1 for lines that can be seen, 0 for others, NaN where unknown.
        reference: Where the labels come from.
    """

    points_cm: Float[np.ndarray, "n 6"]
    sigma_cm: Float[np.ndarray, "n 6"]
    presence: Float[np.ndarray, "n 2"]
    truth_cm: Float[np.ndarray, "n 6"]
    present: Float[np.ndarray, "n 2"]
    reference: str

    @property
    def errors(self) -> ErrorTable:
        """Errors of the points."""
        return point_errors(self.points_cm, self.truth_cm, self.reference)


def answer_rasters(
    network: LaneNet, rasters: UInt8[np.ndarray, "n p r c"], lane_cm: Float[np.ndarray, "n"]
) -> LaneOutput:
    """Run a network over rasters, given the lane width of each; its mode is left as it was."""
    was_training, device = network.training, network.mean_cm.device
    network.eval()
    with torch.inference_mode():
        parts = [
            network(
                input_of_rasters(torch.from_numpy(rasters[start : start + _BATCH]).to(device)),
                torch.from_numpy(lane_cm[start : start + _BATCH]).to(device),
            )
            for start in range(0, len(rasters), _BATCH)
        ]
    network.train(was_training)
    columns = list(zip(*(part[:3] for part in parts), strict=True))
    return LaneOutput(*(torch.cat(column) for column in columns))


def predict(network: LaneNet, samples: Samples) -> Answers:
    """Run a network over frames as they are; its mode is left as it was."""
    parts: list[tuple[np.ndarray, ...]] = []
    for batch in samples.plain_batches(_BATCH):
        output = answer_rasters(network, batch.rasters, batch.lane_cm)
        values = (output.points_cm, output.sigma_cm, torch.sigmoid(output.presence_logit))
        present = batch.present.astype(np.float64)
        parts.append((*(v.cpu().numpy().astype(np.float64) for v in values), present))
    points, sigma, presence, present = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Answers(points, sigma, presence, samples.points_cm, present, samples.reference)


def judge(network: LaneNet, val: Samples) -> tuple[float, float]:
    """Return the RMSE of a network on held-out frames, [cm], and that of :func:`trimmed_rmse_cm`."""
    answers = predict(network, val)
    return answers.errors.all.rmse_cm, trimmed_rmse_cm(answers.points_cm - answers.truth_cm)


def trimmed_rmse_cm(error_cm: Float[np.ndarray, "n 6"]) -> float:
    """Return the RMSE without the largest hundredth of the errors; NaN (a masked label) does not count."""
    sizes = np.sort(np.abs(error_cm[np.isfinite(error_cm)]))
    kept = sizes[: max(1, math.ceil(_KEPT * len(sizes)))]
    return float(np.sqrt(np.mean(kept**2))) if len(kept) else math.nan


def calibrate_sigma(network: LaneNet, val: Samples) -> None:
    """Scale a network's sigma so that 68 % of its errors on held-out frames lie within it."""
    answers = predict(network, val)
    factors = sigma_factors(answers.points_cm - answers.truth_cm, answers.sigma_cm)
    network.sigma_factor *= torch.from_numpy(factors).to(network.sigma_factor)


def calibrate_presence(network: LaneNet, val: Samples) -> None:
    """Lower a network's presence, if needed, until it calls lines absent that are.

    How often lines are missing in the training is only a setting, and so is the meaning of a probability of
    one half. It is set where 96 % of the lines that are taken out of held-out frames are called absent.
    """
    missing = AugmentSettings.only(missing_line=0.8, missing_both=0.2)
    parts = [np.empty(0)]
    for batch in val.changed_batches(missing, 0, _BATCH):
        odds = answer_rasters(network, batch.rasters, batch.lane_cm).presence_logit.double().cpu().numpy()
        parts.append(odds[batch.present == 0.0])
    absent = np.concatenate(parts)
    if absent.size:
        network.lower_presence(min(max(float(np.quantile(absent, _ABSENT_FOUND)), 0.0), _MOST_SHIFT))
