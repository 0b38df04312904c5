"""The lane's width over frames, and a missing line rebuilt with it."""

from __future__ import annotations

import statistics
from collections import deque

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import lane_width_cm, parallel_points

#: Presence below which a line is missing, and above which it is certain. Chosen: more likely than not, and
#: nine in ten.
_SEEN, _SURE = 0.5, 0.9
#: Frames whose widths are remembered, and how many are needed. Chosen: 5 s and half a second at 20 frames/s.
_LENGTH, _ENOUGH = 100, 10
#: Sigma of a remembered width as a share of it. Chosen: 0.8 cm of a lane of 40 cm, laid by hand.
_WIDTH_SIGMA = 0.02
#: How far beyond its label rows a parabola is extrapolated; chosen: the distance of two rows.
_BEYOND_CM = 15.0


class LaneMemory:
    """The median width of the frames that showed both lines.

    With a known width, one line determines the other. A network trained on lanes of many widths cannot infer
    it from one line, but from earlier frames.

    Attributes:
        given_cm: A known width, used instead of the remembered one; None without one.
    """

    def __init__(self, given_cm: float | None = None) -> None:
        self.given_cm = given_cm
        self._widths_cm: deque[float] = deque(maxlen=_LENGTH)

    @property
    def width_cm(self) -> float | None:
        """The lane's width; None while it is unknown."""
        if self.given_cm is not None:
            return self.given_cm
        return statistics.median(self._widths_cm) if len(self._widths_cm) >= _ENOUGH else None

    def learn(self, points_cm: Float[np.ndarray, "6"], presence: Float[np.ndarray, "2"]) -> None:
        """Remember the width of a frame in which both lines are certain; other frames are ignored.

        Args:
            points_cm: The six points, frame car; NaN where unknown.
            presence: Probability that each line can be seen; NaN from a detector that answers only the lines
                it sees.
        """
        left, right = presence.tolist()
        if left <= _SURE or right <= _SURE:
            return
        width_cm = lane_width_cm(points_cm)
        if width_cm > 0.0:
            self._widths_cm.append(width_cm)

    def reset(self) -> None:
        """Forget the frames; a given width stays."""
        self._widths_cm.clear()

    def complete(
        self,
        points_cm: Float[np.ndarray, "6"],
        sigma_cm: Float[np.ndarray, "6"],
        presence: Float[np.ndarray, "2"],
    ) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Learn from a frame with both lines; rebuild the missing line of a frame with one.

        The rebuilt line is parallel to the visible one. It replaces the network's own guess only if its sigma
        is smaller, and if it needs no extrapolation far beyond the visible line's points. A missing line
        never replaces a visible one, whatever its sigma: a network has learned nothing of lines beside its
        window.

        Args:
            points_cm: The six points, frame car.
            sigma_cm: Their standard deviations.
            presence: Probability that each line can be seen.

        Returns:
            Points and standard deviations, changed for the missing line only.
        """
        width_cm = self.width_cm
        self.learn(points_cm, presence)
        if width_cm is None or (presence < _SEEN).sum() != 1:
            return points_cm, sigma_cm
        missing = int(np.argmin(presence))
        # The left line is 0: the missing right line lies to the right of it, and the other way round.
        side = 1.0 if missing == 1 else -1.0
        lines, sigmas = points_cm.reshape(2, 3).copy(), sigma_cm.reshape(2, 3).copy()
        rebuilt = parallel_points(lines[1 - missing], side * width_cm, _BEYOND_CM)
        rebuilt_sigma = np.hypot(sigmas[1 - missing], _WIDTH_SIGMA * width_cm)
        if np.isfinite(rebuilt).all() and rebuilt_sigma.mean() < sigmas[missing].mean():
            lines[missing], sigmas[missing] = rebuilt, rebuilt_sigma
        return lines.reshape(6), sigmas.reshape(6)
