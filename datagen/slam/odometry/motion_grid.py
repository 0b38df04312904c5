"""The likeliest motion of a drive on a grid of steps and turns: a hidden Markov model, forward and backward.

The state is the typical step length and the turn of a frame. It changes slowly, and the images say how likely
each state is; both directions of time are combined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.slam.odometry.far_view import SeenTurns

#: Spacing of the steps as a logarithm, about the accuracy of one pair of images; how many spreads they reach
#: to either side; and the least reach. Chosen: 2.8 spreads hold 99.5 % of a normal distribution.
_SPACING, _SPREADS, _LEAST_REACH = 0.056, 2.8, 0.3
#: Variance per step of the birth-and-death chain, in cells, beyond which it would have to move by more than
#: one cell.
_CHAIN_VARIANCE = 0.5
#: Share and width of turns that change quickly, as when a driver catches a slide. Chosen: rare, and
#: wide enough for a slide.
_QUICK_SHARE, _QUICK_FACTOR = 0.1, 4.0
#: Cells around the likeliest state whose mean is taken. Chosen: the width of a peak.
_AROUND = 2
#: The steering's prediction is tempered, since its errors last for several frames, and its likelihood has a
#: floor, since it may be wrong altogether. Chosen: neighbouring frames count for about a third of one each.
_STEERING_TEMPER, _STEERING_FLOOR = 0.3, 0.02
#: Errors of turns seen in the distance last as well: each frame's sigma is widened, and there is a floor.
#: Chosen: lower than the steering's, as these turns are measured.
_SEEN_WIDER, _SEEN_FLOOR = 1.5, 0.005


@dataclass(frozen=True)
class MotionGrid:
    """States, and how they change.

    Attributes:
        typical: Step length about which the steps lie.
        spread: Standard deviation of the step about it, as a logarithm.
        keep: Share of the deviation that stays until the next frame.
        jump: Probability that the step changes to any other.
        turns_rad: Turns of the grid, evenly spaced.
    """

    typical: float
    spread: float
    keep: float
    jump: float
    turns_rad: Float[np.ndarray, "t"]

    @property
    def log_factors(self) -> Float[np.ndarray, "w"]:
        """Logarithms of the steps over the typical one."""
        half = int(np.ceil(max(_SPREADS * self.spread, _LEAST_REACH) / _SPACING))
        return _SPACING * np.arange(-half, half + 1)

    @property
    def steps(self) -> Float[np.ndarray, "w"]:
        """The grid's steps."""
        return self.typical * np.exp(self.log_factors)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of steps and of turns."""
        return len(self.log_factors), len(self.turns_rad)

    def step_changes(self) -> Float[np.ndarray, "w w"]:
        """Probability of each step (columns) after each other (rows): a walk that is pulled to the middle.

        Source:
            Ornstein-Uhlenbeck process as a birth-and-death chain with the same drift and variance per frame.
        """
        x = self.log_factors
        variance = self.spread**2 * (1.0 - self.keep**2) / _SPACING**2
        # A change of more than about a cell takes several steps of the chain.
        times = max(1, int(np.ceil(variance / _CHAIN_VARIANCE)))
        keep = self.keep ** (1.0 / times)
        drift = -(1.0 - keep) * x / _SPACING
        variance = self.spread**2 * (1.0 - keep**2) / _SPACING**2
        up, down = (np.clip(0.5 * (variance + sign * drift), 0.0, 0.5) for sign in (1.0, -1.0))
        up[-1] = down[0] = 0.0
        chain = np.diag(1.0 - up - down) + np.diag(up[:-1], 1) + np.diag(down[1:], -1)
        anywhere = np.exp(-0.5 * (x / self.spread) ** 2)
        jumps = self.jump * anywhere / anywhere.sum()
        changes: Float[np.ndarray, "w w"] = (1.0 - self.jump) * np.linalg.matrix_power(chain, times) + jumps
        return changes

    def turn_changes(self, walk_rad: float) -> Float[np.ndarray, "t t"]:
        """Probability of each turn (columns) after each other (rows)."""
        apart = self.turns_rad[:, None] - self.turns_rad[None, :]
        changes = np.zeros_like(apart)
        for share, sigma in ((1.0 - _QUICK_SHARE, walk_rad), (_QUICK_SHARE, _QUICK_FACTOR * walk_rad)):
            part = np.exp(-0.5 * (apart / sigma) ** 2)
            changes += share * part / part.sum(axis=1, keepdims=True)
        return changes


def follow_motion(
    grid: MotionGrid,
    log_likelihood: Float[np.ndarray, "n w t"],
    relative: Float[np.ndarray, "n"],
    turn_walk_rad: float,
    curvature: Float[np.ndarray, "n"],
    curvature_sigma: float,
    seen: SeenTurns | None = None,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Find each frame's step and turn, given all frames.

    Args:
        grid: States.
        log_likelihood: Log likelihood of each state given the images, at most 0.
        relative: Step length of each frame relative to the typical one.
        turn_walk_rad: Standard deviation of the change of turn from frame to frame.
        curvature: Predicted curvature.
        curvature_sigma: Standard deviation of the prediction.
        seen: Turns as seen in the distance, if any.

    Returns:
        Typical steps and turns: the mean over the states around the likeliest one.

    Source:
        Rabiner 1989, "A tutorial on hidden Markov models", eq. 19-27 (forward and backward, scaled).
    """
    n = len(log_likelihood)
    by_step, by_turn = grid.step_changes(), grid.turn_changes(turn_walk_rad)
    steps, turns_rad = grid.steps, grid.turns_rad

    def likelihood(k: int) -> Float[np.ndarray, "w t"]:
        likely: Float[np.ndarray, "w t"] = np.exp(log_likelihood[k].astype(np.float64))
        # One sigma for all steps: a prediction of the turn says nothing about the step.
        sigma = max(curvature_sigma * grid.typical * relative[k], 0.5 * turn_walk_rad)
        miss = (turns_rad[None, :] - curvature[k] * (steps[:, None] * relative[k])) / sigma
        likely = likely * (np.exp(-0.5 * miss**2) + _STEERING_FLOOR) ** _STEERING_TEMPER
        if seen is not None and np.isfinite(seen.turns_rad[k]):
            off = (turns_rad - seen.turns_rad[k]) / (_SEEN_WIDER * seen.sigma_rad)
            likely = likely * (np.exp(-0.5 * off**2) + _SEEN_FLOOR)
        return likely

    forward = np.empty(log_likelihood.shape, np.float32)
    # At the first frame the car may be in any motion.
    state = np.repeat(np.exp(-0.5 * (grid.log_factors / grid.spread) ** 2)[:, None], grid.shape[1], axis=1)
    for k in range(n):
        state = (by_step.T @ state @ by_turn if k else state) * likelihood(k)
        state /= state.sum()
        forward[k] = state
    step, turn = np.empty(n), np.empty(n)
    later = np.ones(grid.shape)
    for k in range(n - 1, -1, -1):
        both = forward[k] * later
        # The likeliest step over all turns, and the likeliest turn with that step.
        i = int(both.sum(axis=1).argmax())
        rows = slice(max(i - _AROUND, 0), i + _AROUND + 1)
        j = int(both[rows].sum(axis=0).argmax())
        columns = slice(max(j - _AROUND, 0), j + _AROUND + 1)
        near = both[rows, columns] / both[rows, columns].sum()
        step[k] = grid.typical * np.exp(near.sum(axis=1) @ grid.log_factors[rows])
        turn[k] = near.sum(axis=0) @ turns_rad[columns]
        later = by_step @ (later * likelihood(k)) @ by_turn.T
        later /= later.sum()
    return step, turn
