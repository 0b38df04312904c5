"""The compiled loops of the network's detector, where they are: the bytes of NumPy in a fraction of the time.

As :mod:`lanenet.perception.edges.compiled`; the callers explain each step, and do it where there are none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from lanenet.perception.edges.compiled import loops_of
from lanenet.perception.edges.road import RoadEdges

_kernels: Any = loops_of("lanenet.perception.network")

#: Numbers per line that :func:`refine` returns, and :func:`corners`.
_PER_LINE, _PER_CORNER = 15, 3


def is_here() -> bool:
    """Tell whether the compiled loops are installed."""
    return _kernels is not None


def refine(
    asked: Float[np.ndarray, "m 10"], edges: RoadEdges, numbers: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "m 15"]:
    """Fit lines to edge points as :func:`lanenet.perception.network.refinement.refined` does.

    Args:
        asked: Of each line what is known before.
        edges: The frame's edge points, all float32 or all float64.
        numbers: The settings, in the order of ``Numbers`` in ``_kernels.cpp``.
    """
    looks = edges.points_cm, edges.normals, edges.hues
    seen = [None if x is None else np.ascontiguousarray(x) for x in looks]
    lines = np.ascontiguousarray(asked, np.float64)
    found = _kernels.refine(lines, *seen, numbers, edges.points_cm.dtype == np.float32)
    return np.frombuffer(found).reshape(-1, _PER_LINE)


def corners(
    lines: Float[np.ndarray, "m 4"], edges: RoadEdges, numbers: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "m 3"]:
    """Find the corners at which tape turns off lines, as :mod:`lanenet.perception.network.corner`.

    Args:
        lines: Of each line its points and the width of its marking.
        edges: The frame's edge points, all float32 or all float64.
        numbers: The settings, in the order of ``CornerNumbers`` in ``_kernels.cpp``.
    """
    points, normals = np.ascontiguousarray(edges.points_cm), np.ascontiguousarray(edges.normals)
    asked = np.ascontiguousarray(lines, np.float64)
    found = _kernels.corners(asked, points, normals, numbers, points.dtype == np.float32)
    return np.frombuffer(found).reshape(-1, _PER_CORNER)


def distances(
    lefts_cm: Float[np.ndarray, "l 3"],
    rights_cm: Float[np.ndarray, "r 3"],
    basis: Float[np.ndarray, "3 3"],
    compared: Float[np.ndarray, "k"],
    between: tuple[int, int],
) -> Float[np.ndarray, "l r"]:
    """Compare lines as :func:`lanenet.perception.network.tracking.pair.distances_cm` does.

    Args:
        lefts_cm: x at the label rows.
        rights_cm: Likewise.
        basis: (a, b, c) = x at the label rows @ basis.
        compared: y at which the lines are compared.
        between: The first of these that counts, and the one after the last.
    """
    lefts, rights = (np.ascontiguousarray(x, np.float64) for x in (lefts_cm, rights_cm))
    found = _kernels.distances(lefts, rights, basis, compared, *between)
    return np.frombuffer(found).reshape(len(lefts), -1)
