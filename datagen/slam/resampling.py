"""Weights of particles: from scores, and back to equal ones by drawing anew."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def reweigh(
    weights: Float[np.ndarray, "p"], scores: Float[np.ndarray, "p"], effective_share: float
) -> Float[np.ndarray, "p"]:
    """Turn match scores into weights, as sharply as the particles can bear.

    Edge points of one line are not independent, so that the plain likelihood would leave one particle. The
    scores are tempered until the effective number of particles is at least ``effective_share`` of them.
    """
    relative = scores - scores.max()
    temperature = 1.0
    for _ in range(20):
        new = weights * np.exp(relative / temperature)
        new /= new.sum()
        if effective_number(new) >= effective_share * len(new):
            break
        temperature *= 1.4
    return new


def effective_number(weights: Float[np.ndarray, "p"]) -> float:
    """How many equally weighted particles would be as good."""
    return 1.0 / float(weights @ weights)


def systematic_resample(weights: Float[np.ndarray, "p"], rng: np.random.Generator) -> Int[np.ndarray, "p"]:
    """Draw as many particles as there are, each N times its weight on average, with one random number.

    Returns:
        Indices in ascending order, on which the ancestry relies: descendants of a particle stay neighbours.

    Source:
        Kitagawa 1996; copies of each particle differ from N * weight by less than one.
    """
    n = len(weights)
    positions = (np.arange(n) + rng.random()) / n
    cumulative = np.cumsum(weights)
    cumulative[-1] = 1.0
    return np.searchsorted(cumulative, positions, side="right").clip(0, n - 1)
