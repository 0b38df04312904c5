"""Reads trajectories that lanenet writes, in the way of other tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def read_tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times, [s], and poses (x, y, heading), [cm], [cm], [rad], heading unwrapped."""
    rows = np.loadtxt(path, ndmin=2)
    heading = 2.0 * np.arctan2(rows[:, 6], rows[:, 7])
    return rows[:, 0], np.concatenate([100.0 * rows[:, 1:3], np.unwrap(heading)[:, None]], axis=1)
