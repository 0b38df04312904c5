"""Runs of samples that follow one another and are alike."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int


def equal_runs(values: Int[np.ndarray, "n"] | Bool[np.ndarray, "n"]) -> list[Int[np.ndarray, "_"]]:
    """Return the indices of each longest run of equal values, in order; none of no values."""
    if not len(values):
        return []
    return np.split(np.arange(len(values)), np.flatnonzero(values[1:] != values[:-1]) + 1)


def true_runs(flags: Bool[np.ndarray, "n"], closed: bool = False) -> list[Int[np.ndarray, "_"]]:
    """Return the indices of each longest run of True, in order; in a closed row one may cross the seam."""
    runs = equal_runs(flags)
    if closed and len(runs) > 2 and flags[0] and flags[-1]:
        runs = [*runs[1:-1], np.concatenate([runs[-1], runs[0]])]
    return [run for run in runs if flags[run[0]]]
