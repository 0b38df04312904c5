"""A network's answers on all frames of some label sets, as they are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from lanenet.evaluation.errors import ErrorTable, point_errors
from lanenet.learn.network import LaneNet, LaneOutput, input_of_rasters
from lanenet.samples.dataset import LaneSamples

_BATCH = 256
#: Share of the errors that :func:`trimmed_rmse_cm` looks at.
_KEPT = 0.99


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


def answer_rasters(
    network: LaneNet, rasters: UInt8[np.ndarray, "n 1 r c"], lane_cm: Float[np.ndarray, "n"]
) -> LaneOutput:
    """Run a network over rasters of 0 and 255, of lanes so wide; it is left in the mode in which it was."""
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


def predict(network: LaneNet, samples: LaneSamples) -> Answers:
    """Run a network over frames as they are; it is left in the mode in which it was."""
    parts: list[tuple[np.ndarray, ...]] = []
    for start in range(0, len(samples), _BATCH):
        # A batch at a time: the rasters of many frames take more memory than the frames.
        batch = samples.plain_batch(np.arange(start, min(start + _BATCH, len(samples))))
        output = answer_rasters(network, batch.rasters, batch.lane_cm)
        values = (output.points_cm, output.sigma_cm, torch.sigmoid(output.presence_logit))
        present = batch.present.astype(np.float64)
        parts.append((*(v.cpu().numpy().astype(np.float64) for v in values), present))
    points, sigma, presence, present = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Answers(points, sigma, presence, samples.points_cm, present, samples.reference)


def trimmed_rmse_cm(error_cm: Float[np.ndarray, "n 6"]) -> float:
    """Return the RMSE without the largest hundredth of the errors; NaN, of masked labels, does not count."""
    sizes = np.sort(np.abs(error_cm[np.isfinite(error_cm)]))
    kept = sizes[: max(1, math.ceil(_KEPT * len(sizes)))]
    return float(np.sqrt(np.mean(kept**2))) if len(kept) else math.nan
