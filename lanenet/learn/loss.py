"""What the training minimises: a robust likelihood of the points, and the presence of the lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lanenet.geometry.lane import N_POINTS, ROWS_CM
from lanenet.learn.config import LossSettings
from lanenet.learn.network import LaneOutput

#: Share of a normal distribution within one standard deviation.
ONE_SIGMA = 0.6827
#: Degrees of freedom of Student's distribution. Chosen: heavy tails, of finite variance.
_FREEDOM = 4.0
#: Half the width of the interval that holds 68.27 %, over the scale: of Student's distribution with four
#: degrees of freedom, and of Laplace's. Derived from their quantiles.
_STUDENT_SIGMA, _LAPLACE_SIGMA = 1.1417, 1.1479
#: Up to this distance of the mean, errors count by their squares, beyond it by their size, [cm]. Chosen: a
#: tape.
_NEAR_CM = 2.0
#: Fewer points do not give a share of 68 %. Chosen: the standard error of the share is 7 % at 50 points.
_ENOUGH_POINTS = 50


class Known(NamedTuple):
    """How many labels of a batch are known.

    Attributes:
        points: Of its points.
        lines: Lines of which it is known whether they can be seen.
    """

    points: int
    lines: int


def count_known(labels_cm: Float[Tensor, "n 6"], present: Float[Tensor, "n 2"]) -> Known:
    """Count the known labels of a batch, as :func:`lane_loss` takes them."""
    return Known(int(torch.isfinite(labels_cm).sum()), int(torch.isfinite(present).sum()))


def lane_loss(
    output: LaneOutput,
    labels_cm: Float[Tensor, "n 6"],
    present: Float[Tensor, "n 2"],
    settings: LossSettings,
    counts: Known | None = None,
) -> Float[Tensor, ""]:
    """Return the mean negative log likelihood of the known labels, and the cross-entropy of the presence.

    With bins a label belongs to the two bins beside it, by its distance to each. The distance of the mean is
    added, since the cross-entropy knows no near miss. Without bins the points themselves are judged. The
    predicted sigma is half the width of the interval that holds 68.27 % of the errors, for each kind of
    distribution; the scale follows from it.

    Args:
        output: Answers of the network.
        labels_cm: NaN where masked; such points add nothing to the loss and give no gradient.
        present: 1 for a line that can be seen, 0 for one that cannot, NaN where that is unknown.
        settings: Kind and weights.
        counts: Of the whole batch, where this is a part of it: the losses of all parts add up to its loss.
            None: this is all of it.

    Returns:
        The loss; zero, with a gradient of zero, if nothing is known.

    Source:
        The weighting by the predicted sigma: Seitzer et al. 2022, "On the pitfalls of heteroscedastic
        uncertainty estimation with probabilistic neural networks", eq. 5. Bins: Li et al. 2020, "Generalized
        focal loss", eq. 6.
    """
    # Index, not multiply: 0 * NaN is NaN, and so would be its gradient.
    n_points, n_lines = counts or count_known(labels_cm, present)
    known = torch.isfinite(labels_cm)
    error = output.points_cm[known] - labels_cm[known]
    if output.log_share is not None and output.bins_cm is not None:
        terms = _cross_entropy(output.log_share[known], labels_cm[known], output.bins_cm)
        terms = terms + settings.distance * nn.functional.smooth_l1_loss(
            error, torch.zeros_like(error), beta=_NEAR_CM, reduction="none"
        )
        points = terms.sum() / max(n_points, 1)
        # Sigma is learned from the errors, without moving the points.
        likelihood = _likelihood(error.detach(), output.sigma_cm[known], settings, n_points)
        points = points + settings.distance * likelihood
    else:
        points = _likelihood(error, output.sigma_cm[known], settings, n_points)
    known_lines = torch.isfinite(present)
    entropy = nn.functional.binary_cross_entropy_with_logits(
        output.presence_logit[known_lines], present[known_lines], reduction="sum"
    )
    return points + settings.presence * entropy / max(n_lines, 1)


def _cross_entropy(
    log_share: Float[Tensor, "k b"], labels_cm: Float[Tensor, "k"], bins_cm: Float[Tensor, "b"]
) -> Float[Tensor, "k"]:
    """Cross-entropy between labels, each between two bins, and distributions over the bins."""
    last = len(bins_cm) - 1
    place = ((labels_cm - bins_cm[0]) / (bins_cm[-1] - bins_cm[0]) * last).clamp(0.0, last)
    lower = place.floor().clamp(max=last - 1)
    upper_share = (place - lower)[:, None]
    first = lower.long()[:, None]
    shares = (1.0 - upper_share) * log_share.gather(1, first) + upper_share * log_share.gather(1, first + 1)
    return -shares[:, 0]


def _likelihood(
    error: Float[Tensor, "k"], sigma: Float[Tensor, "k"], settings: LossSettings, count: int
) -> Float[Tensor, ""]:
    """Negative log likelihood of errors, weighted by a power of their sigma: sum over ``count``."""
    if settings.kind == "student":
        z = error * _STUDENT_SIGMA / sigma
        terms = 0.5 * (_FREEDOM + 1.0) * torch.log1p(z * z / _FREEDOM) + torch.log(sigma)
    elif settings.kind == "laplace":
        terms = error.abs() * _LAPLACE_SIGMA / sigma + torch.log(sigma)
    else:
        z = error / sigma
        terms = 0.5 * z * z + torch.log(sigma)
    weights = sigma.detach() ** settings.evenness
    return (weights * terms).sum() / max(count, 1)


def sigma_factors(
    error_cm: Float[np.ndarray, "n 6"], sigma_cm: Float[np.ndarray, "n 6"]
) -> Float[np.ndarray, "6"]:
    """Return the factors on the predicted sigmas that make 68.27 % of the errors lie within one sigma.

    Both sides share the factor of a row: a network that is trained with mirrored samples knows no side.

    Args:
        error_cm: Errors on held-out frames; NaN where there is no label.
        sigma_cm: The predicted sigmas.

    Returns:
        A factor per point; 1 for the points of a row with too few errors.
    """
    known = np.isfinite(error_cm)
    factors = np.ones(N_POINTS)
    for row in range(len(ROWS_CM)):
        columns = [row, row + len(ROWS_CM)]
        chosen = known[:, columns]
        if chosen.sum() >= _ENOUGH_POINTS:
            ratio = np.abs(error_cm[:, columns][chosen]) / sigma_cm[:, columns][chosen]
            factors[columns] = max(float(np.quantile(ratio, ONE_SIGMA)), 1e-3)
    return factors
