"""What a car believes its lane's width to be: common lanes, then what frames with both lines show."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

#: Logarithms of the widths that are told apart, [cm]: 8 to 200 cm in steps of 2.5 %.
_STEP = 0.025
_LOG_CM = np.arange(math.log(8.0), math.log(200.0), _STEP)
#: Share of lanes between the two widths of the prior, as a quantile of the normal distribution. Chosen: 90 %.
_QUANTILE = 1.645
#: Least sigma of the prior. Chosen: a network that was trained on one width may be used on another.
_LEAST_PRIOR = 0.3
#: Sigma of a frame's width, as a share of it; share of frames that show lines of other lanes; and frames that
#: count as one, since neighbours share their errors. Chosen.
_FRAME_SIGMA, _OTHERS, _ALIKE = 0.06, 0.15, 4.0
#: Frames that are remembered. 100, 300 and 1000 were tried and hardly differ: 15 s at 20 frames/s.
_LENGTH = 300.0
#: Density of a frame's own width where it is likeliest, of those of other lanes, and what a frame
#: keeps of the past.
_OWN = (1.0 - _OTHERS) / (_FRAME_SIGMA * math.sqrt(2.0 * math.pi))
_FLOOR = _OTHERS / float(_LOG_CM[-1] - _LOG_CM[0])
_KEPT = 1.0 - 1.0 / _LENGTH
#: What a belief that is kept across a gap still says against others, in nats. Chosen: ten frames undo it.
_KEPT_NATS = 8.0
#: Sigma of the logarithm below which the width is known. Chosen: 4 cm of a lane of 40 cm.
_KNOWN = 0.1


class WidthBelief:
    """A distribution over the logarithm of the lane's width, on a grid: several widths may live side by side.

    Each frame multiplies it by its likelihood, which leaves a share to the lines of other lanes; old frames
    fade towards the prior, so that a wrong width is unlearned.

    Attributes:
        mean_cm: The width, from the mean of its logarithm.
        sigma: Standard deviation of the logarithm.
    """

    def __init__(self, common_cm: tuple[float, float]) -> None:
        """Start from common lanes.

        Args:
            common_cm: Widths between which nine lanes of ten lie.
        """
        low, high = (math.log(width_cm) for width_cm in common_cm)
        sigma = max(0.5 * (high - low) / _QUANTILE, _LEAST_PRIOR)
        self._prior = -0.5 * ((_LOG_CM - 0.5 * (low + high)) / sigma) ** 2
        self.forget()

    def forget(self) -> None:
        """Return to the prior."""
        self._set(self._prior)

    def doubt(self) -> None:
        """Keep the width with little weight: after a gap, the lane is most likely of the same kind."""
        told = self._nats - self._prior
        contrast = float(told.max() - told.min())
        if contrast > _KEPT_NATS:
            self._set(self._prior + told * (_KEPT_NATS / contrast))

    def learn(self, width_cm: float) -> None:
        """Take in the distance of the two lines of a frame, [cm], positive."""
        off = (_LOG_CM - math.log(width_cm)) / _FRAME_SIGMA
        likely = np.log(_OWN * np.exp(-0.5 * off * off) + _FLOOR)
        told = _KEPT * (self._nats - self._prior) + likely / _ALIKE
        self._set(self._prior + told)

    def _set(self, nats: Float[np.ndarray, "n"]) -> None:
        self._nats = nats - nats.max()
        probability = np.exp(self._nats)
        probability /= probability.sum()
        mean = float(probability @ _LOG_CM)
        self.mean_cm, self.sigma = math.exp(mean), math.sqrt(float(probability @ (_LOG_CM - mean) ** 2))

    @property
    def width_cm(self) -> float | None:
        """The width; None while too many are possible."""
        return self.mean_cm if self.sigma < _KNOWN else None
