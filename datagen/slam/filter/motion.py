"""Motion model of the filter: the Ackermann model with gains that are unknown and change slowly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

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
        wider: Factor on the noise of each frame's distance and curvature: over a gap both are less sure.
            None for a drive without gaps.
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
    wider: Float[np.ndarray, "n"] | None = None

    @property
    def numbers(self) -> Float[np.ndarray, "8"]:
        """The numbers that hold for every frame, as :func:`advance` takes them."""
        mean, _ = self.factor_start
        return np.array(
            [
                mean,
                self.factor_pull,
                self.factor_walk,
                self.offset_decay,
                self.offset_walk_per_cm,
                self.distance_noise,
                self.curvature_noise_per_cm,
                self.max_curvature_per_cm,
            ]
        )

    def start(self, particles: int, rng: np.random.Generator) -> Float[np.ndarray, "p 5"]:
        """Draw particles at the origin of the map, heading along +x."""
        states = np.zeros((particles, 5))
        mean, spread = self.factor_start
        states[:, FACTOR] = np.abs(rng.normal(mean, spread, particles))
        return states

    def predict(self, states: Float[np.ndarray, "p 5"], k: int, rng: np.random.Generator) -> None:
        """Move particles in place from frame k - 1 to frame k."""
        noise = rng.standard_normal((4, len(states)))
        if self.wider is not None:
            noise[2:] *= self.wider[k]
        advance(states, noise, self.distance_cm[k], self.curvature_per_cm[k], self.numbers)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def advance(states, noise, distance_cm, curvature_per_cm, numbers):
    """Move particles in place by one frame.

    Args:
        states: Particles.
        noise: Four normal numbers for each particle.
        distance_cm: Predicted distance.
        curvature_per_cm: Predicted curvature.
        numbers: See :attr:`MotionModel.numbers`.

    Source:
        Kozlowski et al. 2024, eq. 4-6, integrated exactly along an arc's chord (heading at mid-step), with
        normal noise on distance and curvature (V and tan(beta) / L there).
    """
    mean, pull, walk, decay, offset_walk, distance_noise, curvature_noise, limit = numbers
    for p in range(states.shape[0]):
        factor = states[p, FACTOR]
        factor = abs(factor + (pull * (mean - factor) + walk * noise[0, p]))
        offset = states[p, OFFSET]
        offset += -decay * offset + offset_walk * noise[1, p]
        states[p, FACTOR], states[p, OFFSET] = factor, offset
        distance = distance_cm * factor * (1.0 + distance_noise * noise[2, p])
        curvature = curvature_per_cm + offset + curvature_noise * noise[3, p]
        turn = distance * min(max(curvature, -limit), limit)
        middle = states[p, HEADING] + 0.5 * turn
        states[p, X] += distance * np.cos(middle)
        states[p, Y] += distance * np.sin(middle)
        states[p, HEADING] += turn


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def widen_steps(before, states, every, factor):
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
    particles = len(states)
    turns, steps = np.empty(particles), np.empty(particles)
    for p in range(particles):
        turns[p] = states[p, HEADING] - before[p, HEADING]
        middle = before[p, HEADING] + 0.5 * turns[p]
        # A step is a chord in the direction of the middle heading, see advance().
        dx, dy = states[p, X] - before[p, X], states[p, Y] - before[p, Y]
        steps[p] = dx * np.cos(middle) + dy * np.sin(middle)
    mean_turn, mean_step = 0.0, 0.0
    for p in range(particles):
        mean_turn, mean_step = mean_turn + turns[p], mean_step + steps[p]
    mean_turn, mean_step = mean_turn / particles, mean_step / particles
    for p in range(0, particles, every):
        turn = mean_turn + factor * (turns[p] - mean_turn)
        step = mean_step + factor * (steps[p] - mean_step)
        middle = before[p, HEADING] + 0.5 * turn
        states[p, X] = before[p, X] + step * np.cos(middle)
        states[p, Y] = before[p, Y] + step * np.sin(middle)
        states[p, HEADING] = before[p, HEADING] + turn
