"""A network's answers on all frames of some label sets, as they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from lanenet.learn.dataset import LaneSamples
from lanenet.learn.evaluate import ErrorTable, point_errors
from lanenet.learn.network import LaneNet, input_of_rasters

_BATCH = 256


@dataclass(frozen=True)
class Answers:
    """What a network says about frames, beside what their labels say.

    Attributes:
        points_cm: The six points.
        sigma_cm: Their standard deviations.
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


def predict(network: LaneNet, samples: LaneSamples) -> Answers:
    """Run a network over frames as they are; it is left in the mode in which it was."""
    was_training, device = network.training, network.mean_cm.device
    network.eval()
    parts: list[tuple[np.ndarray, ...]] = []
    with torch.inference_mode():
        for start in range(0, len(samples), _BATCH):
            chosen = np.arange(start, min(start + _BATCH, len(samples)))
            rasters, _, present = samples.plain_batch(chosen)
            output = network(input_of_rasters(torch.from_numpy(rasters).to(device)))
            values = (output.points_cm, output.sigma_cm, torch.sigmoid(output.presence_logit))
            parts.append((*(v.cpu().numpy().astype(np.float64) for v in values), present.astype(np.float64)))
    network.train(was_training)
    points, sigma, presence, present = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Answers(points, sigma, presence, samples.points_cm, present, samples.reference)
