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

#: Numbers per line that :func:`refine` returns.
_PER_LINE = 15


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
