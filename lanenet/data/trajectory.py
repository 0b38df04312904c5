"""Trajectories in the TUM format: ``t x y z qx qy qz qw`` per line, seconds and metres.

Tools for trajectories (evo among them) read it. The car moves on a plane, so z is zero and the rotation is
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
_UNIT_TOLERANCE = 1e-3


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


def poses_from_tum(rows: Float[np.ndarray, "n 8"]) -> Float[np.ndarray, "n 3"]:
    """Convert rows of a TUM file to poses; inverse of :func:`tum_from_poses`.

    Args:
        rows: t, x, y, z, qx, qy, qz, qw; [s], [m]. z and tilt are dropped.

    Returns:
        x, y and heading, [cm], [cm], [rad]; the heading starts in (-pi, pi] and is unwrapped from there,
        which is right as long as the car turns less than half a circle from one row to the next.
    """
    x, y, z, w = rows[:, 4:].T
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.concatenate([_CM_PER_M * rows[:, 1:3], np.unwrap(heading)[:, None]], axis=1)


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
    """Lines of a TUM file below :data:`TUM_HEADER`; poses as for :func:`tum_from_poses`, all finite."""
    rows = tum_from_poses(t_s, poses_cm).tolist()
    return [f"{row[0]:.6f} " + " ".join(f"{value:.9f}" for value in row[1:]) + "\n" for row in rows]


def read_tum(path: Path) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Read a trajectory.

    Returns:
        Times, [s], and poses, [cm], [cm], [rad], heading unwrapped; see :func:`poses_from_tum`.

    Raises:
        MapFormatError: If the file is missing, a line does not hold eight finite numbers, a quaternion is not
            of unit length, or times go back; names the line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise MapFormatError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise MapFormatError(f"{path}: cannot be read as text ({error})") from None
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.partition("#")[0].split()
        if not fields:
            continue
        try:
            row = [float(value) for value in fields]
        except ValueError:
            row = []
        if len(row) != 8 or not np.isfinite(row).all():
            raise MapFormatError(
                f"{path}: line {number}: expected eight numbers, found {line.strip()[:80]!r}"
            )
        length = float(np.linalg.norm(row[4:]))
        if abs(length - 1.0) > _UNIT_TOLERANCE:
            raise MapFormatError(
                f"{path}: line {number}: expected a unit quaternion, found length {length:.3g}"
            )
        if rows and row[0] < rows[-1][0]:
            raise MapFormatError(f"{path}: line {number}: time {row[0]} after {rows[-1][0]}")
        rows.append(row)
    array = np.array(rows, dtype=np.float64).reshape(-1, 8)
    return array[:, 0], poses_from_tum(array)
