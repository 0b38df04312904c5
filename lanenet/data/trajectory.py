"""Trajectories in the TUM format: ``t x y z qx qy qz qw`` per line, seconds and metres.

The format of evo and other tools for trajectories. The car moves on a plane: z is zero, and the rotation is
about z.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from lanenet.data.files import write_text
from lanenet.errors import MapFormatError

TUM_HEADER = "# t_s x_m y_m z_m qx qy qz qw\n"
_CM_PER_M = 100.0


def tum_from_poses(
    t_s: Float[np.ndarray, "n"], poses_cm: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 8"]:
    """Convert poses to rows of a TUM file.

    Args:
        t_s: Times.
        poses_cm: x, y and heading, [cm], [cm], [rad], frame map.

    Returns:
        t, x, y, z, qx, qy, qz, qw; [s], [m].
    """
    zeros = np.zeros(len(t_s))
    half = 0.5 * poses_cm[:, 2]
    x_m, y_m = poses_cm[:, 0] / _CM_PER_M, poses_cm[:, 1] / _CM_PER_M
    return np.stack([t_s, x_m, y_m, zeros, zeros, zeros, np.sin(half), np.cos(half)], axis=1)


def write_tum(path: Path, t_s: Float[np.ndarray, "n"], poses_cm: Float[np.ndarray, "n 3"]) -> None:
    """Write a trajectory, atomically; poses as for :func:`tum_from_poses`.

    Raises:
        MapFormatError: If a value is not finite.
    """
    rows = tum_from_poses(t_s, poses_cm)
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise MapFormatError(f"{path}: the pose of row {int(np.flatnonzero(bad)[0])} is not finite")
    write_text(path, "".join([TUM_HEADER, *tum_lines(t_s, poses_cm)]))


def tum_lines(t_s: Float[np.ndarray, "n"], poses_cm: Float[np.ndarray, "n 3"]) -> list[str]:
    """Return the lines of a TUM file below :data:`TUM_HEADER`; finite poses as for :func:`tum_from_poses`."""
    rows = tum_from_poses(t_s, poses_cm).tolist()
    return [f"{row[0]:.6f} " + " ".join(f"{value:.9f}" for value in row[1:]) + "\n" for row in rows]
