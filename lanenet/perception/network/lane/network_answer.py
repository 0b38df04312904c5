"""What a network says of one frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class NetworkAnswer(NamedTuple):
    """What a network says of one frame.

    Attributes:
        points_cm: The six points, frame car.
        sigma_cm: Their sigmas.
        presence: Probability that each line can be seen.
        log_share: Log probability of each place, of each point.
        places_cm: x of the places, evenly spaced.
    """

    points_cm: Float[np.ndarray, "6"]
    sigma_cm: Float[np.ndarray, "6"]
    presence: Float[np.ndarray, "2"]
    log_share: Float[np.ndarray, "6 b"]
    places_cm: Float[np.ndarray, "b"]

    @classmethod
    def of_one_mode(
        cls,
        points_cm: Float[np.ndarray, "6"],
        sigma_cm: Float[np.ndarray, "6"],
        presence: Float[np.ndarray, "2"],
        places_cm: Float[np.ndarray, "b"],
    ) -> NetworkAnswer:
        """Return the answer of a model without probabilities of places: one mode with its sigma."""
        log_share = -0.5 * ((places_cm - points_cm[:, None]) / sigma_cm[:, None]) ** 2
        log_share -= np.logaddexp.reduce(log_share, axis=1, keepdims=True)
        return cls(points_cm, sigma_cm, presence, log_share, places_cm)

    @property
    def is_finite(self) -> bool:
        """Whether all of it are numbers."""
        return bool(np.isfinite(self.points_cm.sum() + self.sigma_cm.sum() + self.presence.sum())) and not (
            np.isnan(self.log_share).any()
        )
