"""Hypotheses of where the lane is: states, covariances and log weights, and how measurements change them."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.perception.network.lane.shape import LOG_WIDTH, linearised

#: Variance that keeps correlated measurements apart, [cm^2]. Chosen: far below any other.
_LEAST_VARIANCE = 1e-3


class Hypotheses(NamedTuple):
    """Lanes, see :mod:`lanenet.perception.network.lane.shape`.

    Attributes:
        states: Of each lane, [cm], [1], [1/cm], [1], frame car.
        covariances: Of the states.
        log_weights: Natural logarithms; only their differences count.
    """

    states: Float[np.ndarray, "n 4"]
    covariances: Float[np.ndarray, "n 4 4"]
    log_weights: Float[np.ndarray, "n"]

    @classmethod
    def none(cls) -> Hypotheses:
        """Return no lane."""
        return cls(np.zeros((0, 4)), np.zeros((0, 4, 4)), np.zeros(0))

    def some(self, index: Int[np.ndarray, "m"]) -> Hypotheses:
        """Return some of them, in this order."""
        return Hypotheses(self.states[index], self.covariances[index], self.log_weights[index])

    def and_others(self, others: Hypotheses) -> Hypotheses:
        """Return these and others."""
        return Hypotheses(*(np.concatenate(pair) for pair in zip(self, others, strict=True)))

    def with_width(self, log_width: float, sigma: float) -> Hypotheses:
        """Return the hypotheses after a measurement of the logarithm of their width."""
        along = self.covariances[:, :, LOG_WIDTH]
        gain = along / (along[:, LOG_WIDTH, None] + sigma * sigma)
        states = self.states + gain * (log_width - self.states[:, LOG_WIDTH, None])
        covariances = self.covariances - gain[:, :, None] * along[:, None, :]
        return Hypotheses(states, covariances, self.log_weights)

    def updated(
        self,
        expected: tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 4"]],
        points_cm: Float[np.ndarray, "n 6"],
        sigma_cm: Float[np.ndarray, "n 6"],
        correlation: float,
    ) -> Hypotheses:
        """Return the hypotheses after one step of an extended Kalman filter; the weights stay.

        Args:
            expected: Points of the states and their derivatives, from ``linearised``.
            points_cm: Measured points.
            sigma_cm: Their standard deviations.
            correlation: Of the errors of neighbouring rows of a line.
        """
        points, change = expected
        noise = _correlation(correlation) * (sigma_cm[:, :, None] * sigma_cm[:, None, :]) + _LEAST
        to_points = change @ self.covariances
        total = to_points @ np.swapaxes(change, 1, 2) + noise
        gain = np.swapaxes(np.linalg.solve(total, to_points), 1, 2)
        states = self.states + (gain @ (points_cm - points)[..., None])[..., 0]
        return Hypotheses(states, self.covariances - gain @ to_points, self.log_weights)


def fitted(
    start: Hypotheses,
    points_cm: Float[np.ndarray, "n 6"],
    sigma_cm: Float[np.ndarray, "n 6"],
    correlation: float,
) -> Hypotheses:
    """Return lanes through points, with what is known of them before: a Gauss-Newton step more than one."""
    found = start
    for _ in range(2):
        points, change = linearised(found.states)
        # What the first step has moved is not counted twice.
        about = points + (change @ (start.states - found.states)[..., None])[..., 0]
        found = start.updated((about, change), points_cm, sigma_cm, correlation)
    return found


def variances(
    change: Float[np.ndarray, "n 6 4"], covariances: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "n 6"]:
    """Return the variances of lanes' points."""
    return ((change @ covariances) * change).sum(axis=2)


_LEAST = _LEAST_VARIANCE * np.eye(len(SIDES) * len(ROWS_CM))


@cache
def _correlation(neighbours: float) -> Float[np.ndarray, "6 6"]:
    rows = np.arange(len(ROWS_CM))
    return np.kron(np.eye(len(SIDES)), neighbours ** np.abs(np.subtract.outer(rows, rows)))
