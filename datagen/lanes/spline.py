"""Cubic B-splines over the position along a path, open or periodic, as sparse linear maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

_DEGREE = 3


@dataclass(frozen=True)
class CubicBasis:
    """Cubic B-splines with given breaks.

    A periodic basis has as many functions as intervals: those that reach over the seam are one and the same
    on both sides of it, so that value, slope and second derivative agree there by construction.

    Attributes:
        breaks_cm: Ends of the cubic pieces, growing.
        periodic: Whether the last break is the first one again.
    """

    breaks_cm: Float[np.ndarray, "b"]
    periodic: bool

    @property
    def size(self) -> int:
        """Number of free coefficients."""
        return len(self.breaks_cm) - 1 if self.periodic else len(self.breaks_cm) + 2

    @property
    def knots_cm(self) -> Float[np.ndarray, "k"]:
        """Knots, with three more on either side of the breaks."""
        b = self.breaks_cm
        if self.periodic:
            period = b[-1] - b[0]
            return np.concatenate([b[-4:-1] - period, b, b[1:4] + period])
        return np.concatenate([np.full(3, b[0]), b, np.full(3, b[-1])])

    def design(self, s_cm: Float[np.ndarray, "m"], derivative: int = 0) -> csr_array:
        """Matrix that turns coefficients into values, or a derivative of them, at given places."""
        if not len(s_cm):
            return csr_array((0, self.size))
        b, knots = self.breaks_cm, self.knots_cm
        s = np.mod(s_cm - b[0], b[-1] - b[0]) + b[0] if self.periodic else np.clip(s_cm, b[0], b[-1])
        inner = knots[derivative : len(knots) - derivative]
        matrix = csr_array(BSpline.design_matrix(s, inner, _DEGREE - derivative))
        for order in range(derivative, 0, -1):
            # Coefficients of the derivative are differences of coefficients over the span of their knots.
            degree, t = _DEGREE - order + 1, knots[order - 1 : len(knots) - order + 1]
            count = len(t) - degree - 1
            slope = degree / np.maximum(t[degree + 1 : degree + count] - t[1:count], 1e-12)
            matrix = matrix @ diags_array([-slope, slope], offsets=[0, 1], shape=(count - 1, count))
        return csr_array(matrix @ self._unfold()) if self.periodic else csr_array(matrix)

    def fitted(
        self, s_cm: Float[np.ndarray, "m"], values: Float[np.ndarray, "m *d"]
    ) -> Float[np.ndarray, "c *d"]:
        """Coefficients that come closest to values at given places, of which every interval holds some."""
        design = self.design(s_cm)
        return np.asarray(splu(csc_array(design.T @ design)).solve(np.asarray(design.T @ values)))

    def unfolded(self, coefficients: Float[np.ndarray, "c *d"]) -> Float[np.ndarray, "c2 *d"]:
        """Coefficients for the full list of knots."""
        return np.concatenate([coefficients, coefficients[:_DEGREE]]) if self.periodic else coefficients

    def _unfold(self) -> csr_array:
        count = self.size + _DEGREE
        columns = np.arange(count) % self.size
        return csr_array((np.ones(count), (np.arange(count), columns)), shape=(count, self.size))


def adapted_breaks(
    curvature_per_cm: Float[np.ndarray, "m"], step_cm: float, widest_cm: float, narrowest_cm: float
) -> Float[np.ndarray, "b"]:
    """Breaks along a path, denser in bends.

    Args:
        curvature_per_cm: Curvature at even samples of the path.
        step_cm: Distance between these.
        widest_cm: Spacing where the path is straight.
        narrowest_cm: Spacing in the tightest bends.

    Returns:
        From 0 to the end of the last step, at least eight intervals.
    """
    # A cubic over an interval that turns by a quarter of a radian stays within a thousandth of its length.
    spacing = np.clip(0.25 / np.maximum(np.abs(curvature_per_cm), 1e-9), narrowest_cm, widest_cm)
    count = np.concatenate([[0.0], np.cumsum(step_cm / spacing)])
    breaks = np.linspace(0.0, count[-1], max(8, round(count[-1])) + 1)
    return np.interp(breaks, count, np.arange(len(count)) * step_cm)
