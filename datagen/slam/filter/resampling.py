"""Weights of particles: from match scores to weights, and by resampling back to equal ones."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

#: Factor between the temperatures that are tried, and how many: 1.4^20 = 840 flattens any scores of 80
#: points.
_COOLER, _TEMPERATURES = 1.4, 20


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def reweigh(weights, scores, effective_share):
    """Turn match scores into weights, as sharply as the particles can bear.

    Edge points of one line are not independent, and the plain likelihood would leave one particle. The scores
    are tempered until the effective number of particles is at least ``effective_share`` of them.

    Args:
        weights: Weights before, one per particle.
        scores: Log likelihoods.
        effective_share: Least effective share of the particles, 0 to 1.

    Returns:
        Weights that add up to 1.
    """
    new = np.empty(len(weights))
    highest, temperature = scores[0], 1.0
    for p in range(len(weights)):
        highest = max(highest, scores[p])
    for _ in range(_TEMPERATURES):
        total = 0.0
        for p in range(len(weights)):
            new[p] = weights[p] * np.exp((scores[p] - highest) / temperature)
            total += new[p]
        for p in range(len(weights)):
            new[p] /= total
        if effective_number(new) >= effective_share * len(new):
            break
        temperature *= _COOLER
    return new


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def effective_number(weights):
    """Return how many equally weighted particles would be as good: 1 / sum of squares."""
    total = 0.0
    for p in range(len(weights)):
        total += weights[p] * weights[p]
    return 1.0 / total


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def systematic_resample(weights, uniform):
    """Draw as many particles as there are, each N times its weight on average, with one random number.

    Args:
        weights: Weights that add up to 1.
        uniform: The random number, in [0, 1).

    Returns:
        Indices in ascending order. The ancestry relies on it: descendants of a particle stay neighbours.

    Source:
        Kitagawa 1996; copies of each particle differ from N * weight by less than one.
    """
    n = len(weights)
    chosen = np.empty(n, np.int64)
    at, cumulative = 0, weights[0]
    for k in range(n):
        position = (k + uniform) / n
        while at < n - 1 and cumulative <= position:
            at += 1
            cumulative += weights[at]
        chosen[k] = at
    return chosen
