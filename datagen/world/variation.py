"""Random functions of the frame number: any frame can be asked for at any time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_WAVES = 5


class Wander:
    """Smooth, with unit variance: a few sines of random period and phase."""

    def __init__(
        self, count: int, shortest_frames: float, longest_frames: float, rng: np.random.Generator
    ) -> None:
        """Draw ``count`` independent functions whose waves last between so many frames."""
        # Even in the logarithm: slow and quick movements alike.
        exponent = rng.uniform(np.log(shortest_frames), np.log(longest_frames), (count, _WAVES))
        self._pace = 2.0 * np.pi / np.exp(exponent)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (count, _WAVES))

    def at(self, frame: int) -> Float[np.ndarray, "count"]:
        """Return the values at a frame."""
        return np.asarray(np.sqrt(2.0 / _WAVES) * np.sin(self._pace * frame + self._phase).sum(axis=1))


class Steps:
    """Constant for a while, then another value, with unit variance."""

    def __init__(self, count: int, every_frames: float, rng: np.random.Generator) -> None:
        """Draw ``count`` functions that all step at the same frames, every so many."""
        self._count, self._every = count, every_frames
        self._seed, self._phase = int(rng.integers(2**62)), float(rng.random())
        self._last: tuple[int, Float[np.ndarray, "count"]] | None = None  # neighbouring frames share it

    def at(self, frame: int) -> Float[np.ndarray, "count"]:
        """Return the values at a frame."""
        block = int(np.floor(frame / self._every + self._phase))
        if self._last is None or self._last[0] != block:
            self._last = (block, np.random.default_rng((self._seed, block)).standard_normal(self._count))
        return self._last[1]
