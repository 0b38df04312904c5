"""Weights of particles: from scores, and back to equal ones by drawing anew."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit


def reweigh(
    weights: Float[np.ndarray, "p"], scores: Float[np.ndarray, "p"], effective_share: float
) -> Float[np.ndarray, "p"]:
    """Turn match scores into weights, as sharply as the particles can bear.

    Edge points of one line are not independent, so that the plain likelihood would leave one particle. The
    scores are tempered until the effective number of particles is at least ``effective_share`` of them.
    """
    new = np.empty(len(weights))
    temper(weights, scores, effective_share, new)
    return new


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def temper(weights, scores, effective_share, new):
    """Fill ``new`` with the weights of :func:`reweigh`."""
    highest, temperature = scores[0], 1.0
    for p in range(len(weights)):
        highest = max(highest, scores[p])
    for _ in range(20):
        total = 0.0
        for p in range(len(weights)):
            new[p] = weights[p] * np.exp((scores[p] - highest) / temperature)
            total += new[p]
        for p in range(len(weights)):
            new[p] /= total
        if count_effective(new) >= effective_share * len(new):
            break
        temperature *= 1.4


def effective_number(weights: Float[np.ndarray, "p"]) -> float:
    """How many equally weighted particles would be as good."""
    return float(count_effective(weights))


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def count_effective(weights):
    """See :func:`effective_number`."""
    total = 0.0
    for p in range(len(weights)):
        total += weights[p] * weights[p]
    return 1.0 / total


def systematic_resample(weights: Float[np.ndarray, "p"], rng: np.random.Generator) -> Int[np.ndarray, "p"]:
    """Draw as many particles as there are, each N times its weight on average, with one random number.

    Returns:
        Indices in ascending order, on which the ancestry relies: descendants of a particle stay neighbours.

    Source:
        Kitagawa 1996; copies of each particle differ from N * weight by less than one.
    """
    chosen = np.empty(len(weights), np.int64)
    draw_evenly(weights, rng.random(), chosen)
    return chosen


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def draw_evenly(weights, uniform, chosen):
    """Fill ``chosen`` as :func:`systematic_resample` returns it; ``uniform`` is its random number."""
    n = len(weights)
    at, cumulative = 0, weights[0]
    for k in range(n):
        position = (k + uniform) / n
        while at < n - 1 and cumulative <= position:
            at += 1
            cumulative += weights[at]
        chosen[k] = at
