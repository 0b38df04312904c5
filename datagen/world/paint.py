"""Which stretches of a line are painted: intervals along the road."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

_MIN_INTERRUPTION_CM = 10.0
_FLAKE_CM = 1.5  # mean length of what flakes off a worn line


def paint_solid(length_cm: float) -> Float[np.ndarray, "1 2"]:
    """Return one stretch over the whole length, [cm]."""
    return np.array([[0.0, length_cm]])


def paint_dashes(
    length_cm: float, closed: bool, dash_cm: float, gap_cm: float, phase: float
) -> Float[np.ndarray, "k 2"]:
    """Return the stretches of a dashed line.

    Args:
        length_cm: Length of the road.
        closed: On a loop the period is stretched a little, so that a whole number of dashes fits.
        dash_cm: Painted length.
        gap_cm: Unpainted length.
        phase: Where the pattern starts, 0..1 of a period.

    Returns:
        Start and end of each dash within 0..length, [cm], ascending.
    """
    period_cm = dash_cm + gap_cm
    if closed:
        period_cm = length_cm / max(1, round(length_cm / period_cm))
    start = (np.arange(int(length_cm / period_cm) + 2) + phase - 1.0) * period_cm
    end = start + period_cm * dash_cm / (dash_cm + gap_cm)
    dashes = np.clip(np.stack([start, end], axis=1), 0.0, length_cm)
    return dashes[dashes[:, 1] - dashes[:, 0] > 1e-9]


def interrupt(
    painted_cm: Float[np.ndarray, "k 2"],
    length_cm: float,
    per_m: float,
    max_cm: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "m 2"]:
    """Scratch random stretches off the paint.

    Args:
        painted_cm: Painted stretches, ascending.
        length_cm: Length of the road.
        per_m: Expected number of interruptions per metre.
        max_cm: Longest interruption; the shortest is 10 cm.
        rng: Source of randomness.

    Returns:
        What is left of the paint, ascending.
    """
    for _ in range(rng.poisson(per_m * length_cm / 100.0)):
        start_cm = rng.uniform(0.0, length_cm)
        painted_cm = cut(painted_cm, start_cm, start_cm + rng.uniform(_MIN_INTERRUPTION_CM, max_cm))
    return painted_cm


def wear_off(
    painted_cm: Float[np.ndarray, "k 2"], length_cm: float, share: float, rng: np.random.Generator
) -> Float[np.ndarray, "m 2"]:
    """Let short stretches flake off.

    Args:
        painted_cm: Painted stretches, ascending.
        length_cm: Length of the road.
        share: Of the paint that is lost, on average.
        rng: Source of randomness.
    """
    if share <= 0.0:
        return painted_cm
    n = int(2.0 * length_cm * share / _FLAKE_CM) + 20
    lost = rng.exponential(_FLAKE_CM, n)
    kept = rng.exponential(_FLAKE_CM * (1.0 - share) / share, n)
    ends = np.cumsum(np.stack([kept, lost], axis=1).ravel())
    holes = ends.reshape(-1, 2)
    return subtract(painted_cm, holes[holes[:, 0] < length_cm])


def cut(painted_cm: Float[np.ndarray, "k 2"], from_cm: float, to_cm: float) -> Float[np.ndarray, "m 2"]:
    """Take one stretch off the paint."""
    before = np.stack([painted_cm[:, 0], np.minimum(painted_cm[:, 1], from_cm)], axis=1)
    after = np.stack([np.maximum(painted_cm[:, 0], to_cm), painted_cm[:, 1]], axis=1)
    pieces = np.concatenate([before, after])
    pieces = pieces[pieces[:, 1] - pieces[:, 0] > 1e-9]
    return pieces[np.argsort(pieces[:, 0])]


def subtract(
    painted_cm: Float[np.ndarray, "k 2"], holes_cm: Float[np.ndarray, "h 2"]
) -> Float[np.ndarray, "m 2"]:
    """Take many stretches off the paint; both lists are ascending and without overlap."""
    bounds = np.unique(np.concatenate([painted_cm.ravel(), holes_cm.ravel()]))
    middle = 0.5 * (bounds[1:] + bounds[:-1])
    keep = is_painted(painted_cm, middle) & ~is_painted(holes_cm, middle)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(np.int8)))
    pieces = bounds[edges].reshape(-1, 2)
    return pieces[pieces[:, 1] - pieces[:, 0] > 1e-9]


def is_painted(painted_cm: Float[np.ndarray, "k 2"], s_cm: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """Tell for each place whether it lies on a painted stretch."""
    if not len(painted_cm):
        return np.zeros(len(s_cm), bool)
    i = np.searchsorted(painted_cm[:, 0], s_cm, side="right") - 1
    return (i >= 0) & (s_cm < painted_cm[np.maximum(i, 0), 1])
