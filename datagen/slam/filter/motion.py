"""Motion model of the filter: the Ackermann model with gains that are unknown and change slowly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

#: Columns of a particle: x, y, heading of the rear axle, distance factor, curvature offset.
X, Y, HEADING, FACTOR, OFFSET = range(5)


@dataclass(frozen=True)
class MotionModel:
    """Predicted motion per frame, and how far the car may stray from it.

    Attributes:
        distance_cm: Predicted distance from the previous frame to this one.
        curvature_per_cm: Predicted curvature of the path, positive left.
        factor_start: Mean and spread of the distance factor at the start.
        factor_walk: Standard deviation of the factor's change per frame; small, as the gain of a speed.
        factor_pull: Share by which the factor returns to its mean per frame: a prior against creeping.
        distance_noise: Standard deviation of the distance per frame, relative.
        offset_walk_per_cm: Change of the curvature offset per frame (trim, servo lag).
        offset_decay: Share of the offset that is forgotten per frame.
        curvature_noise_per_cm: Standard deviation of the curvature per frame.
        max_curvature_per_cm: Bound of the total curvature, so that the heading cannot spin.
    """

    distance_cm: Float[np.ndarray, "n"]
    curvature_per_cm: Float[np.ndarray, "n"]
    factor_start: tuple[float, float]
    factor_walk: float
    factor_pull: float
    distance_noise: float
    offset_walk_per_cm: float
    offset_decay: float
    curvature_noise_per_cm: float
    max_curvature_per_cm: float

    def start(self, particles: int, rng: np.random.Generator) -> Float[np.ndarray, "p 5"]:
        """Draw particles at the origin of the map, heading along +x."""
        states = np.zeros((particles, 5))
        mean, spread = self.factor_start
        states[:, FACTOR] = np.abs(rng.normal(mean, spread, particles))
        return states

    def predict(self, states: Float[np.ndarray, "p 5"], k: int, rng: np.random.Generator) -> None:
        """Move particles in place from frame k - 1 to frame k.

        Source:
            Kozlowski et al. 2024, eq. 4-6, integrated exactly along an arc's chord (heading at mid-step),
            with normal noise on distance and curvature (V and tan(beta) / L there).
        """
        noise = rng.standard_normal((4, len(states)))
        heading, factor, offset = states[:, HEADING], states[:, FACTOR], states[:, OFFSET]
        pull = self.factor_pull * (self.factor_start[0] - factor)
        factor[:] = np.abs(factor + (pull + self.factor_walk * noise[0]))
        offset += self.offset_walk_per_cm * noise[1] - self.offset_decay * offset
        distance = self.distance_cm[k] * factor * (1.0 + self.distance_noise * noise[2])
        curvature = self.curvature_per_cm[k] + offset + self.curvature_noise_per_cm * noise[3]
        turn = distance * np.clip(curvature, -self.max_curvature_per_cm, self.max_curvature_per_cm)
        middle = heading + 0.5 * turn
        states[:, X] += distance * np.cos(middle)
        states[:, Y] += distance * np.sin(middle)
        heading += turn


def widen_steps(
    before: Float[np.ndarray, "p 5"], states: Float[np.ndarray, "p 5"], every: int, factor: float
) -> None:
    """Let some particles stray further from the mean step than the motion model does, in place.

    Recorded drives jerk: a frame is missing, a wheel slips, the camera nods. Normal noise that is wide enough
    for such a frame is far too wide for all others. A few particles that stray far keep track.

    Args:
        before: Particles before the prediction.
        states: Particles after it.
        every: One of so many particles strays; 0 for none.
        factor: How many times as far.

    Source:
        Mixture of two normal distributions; own derivation.
    """
    if every <= 0:
        return
    x, y, turns = (states - before)[:, : HEADING + 1].T
    middle = before[:, HEADING] + 0.5 * turns
    # A step is a chord in the direction of the middle heading, see MotionModel.predict.
    steps = x * np.cos(middle) + y * np.sin(middle)
    turn = turns.mean() + factor * (turns[::every] - turns.mean())
    step = steps.mean() + factor * (steps[::every] - steps.mean())
    middle = before[::every, HEADING] + 0.5 * turn
    moved = np.stack([step * np.cos(middle), step * np.sin(middle), turn], axis=1)
    states[::every, : HEADING + 1] = before[::every, : HEADING + 1] + moved
