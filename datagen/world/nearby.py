"""What lies near a place, at a cost that does not grow with the length of the road."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_CELL_CM = 200.0
_MAX_CELLS = 64


class Nearby:
    """Rows of a table by the place where the car is; neighbouring frames share the answer."""

    def __init__(
        self, rows: Float[np.ndarray, "n k"], reaches_cm: Float[np.ndarray, "n"], sight_cm: float
    ) -> None:
        """Keep a table.

        Args:
            rows: Each starts with x and y, [cm], frame map.
            reaches_cm: How far each extends, or moves, from there.
            sight_cm: How far from the car things count.
        """
        self._rows, self._reaches_cm, self._sight_cm = rows, reaches_cm, sight_cm
        self._cells: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def at(self, x_cm: float, y_cm: float) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m"]]:
        """Return all rows that reach into sight of a place, and some more, in the table's order; reaches."""
        cell = (int(np.floor(x_cm / _CELL_CM)), int(np.floor(y_cm / _CELL_CM)))
        found = self._cells.get(cell)
        if found is None:
            middle = (np.array(cell) + 0.5) * _CELL_CM
            gap = np.abs(self._rows[:, :2] - middle).max(axis=1, initial=0.0)
            near = gap <= 0.5 * _CELL_CM + self._sight_cm + self._reaches_cm
            found = (self._rows[near], self._reaches_cm[near])
            if len(self._cells) >= _MAX_CELLS:  # the oldest goes: memory stays flat on a long road
                del self._cells[next(iter(self._cells))]
            self._cells[cell] = found
        return found
