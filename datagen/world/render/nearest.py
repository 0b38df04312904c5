"""What lies near the car, at a cost that does not grow with the length of the road.

The nearest samples of the centre line come from a grid in square blocks, which are filled when the car comes
near and kept for a while: a road of 200 m needs hardly more memory than one of 10 m.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int

from datagen.world.render.compiled import compiled
from datagen.world.road.track import Track

#: Two samples of the centre line; the search from there takes a step or two.
_GRID_CELL_CM = 2.0
#: Around the markings, for pixels that reach over them from outside.
_GRID_MARGIN_CM = 10.0
_BLOCK_CELLS = 128
#: Some more than lie around a car.
_MAX_BLOCKS = 32
#: Cells of :class:`Nearby`, and how many are kept: as many as a car passes in 100 m.
_CELL_CM = 200.0
_MAX_CELLS = 64


class NearestGrid:
    """The nearest sample of the centre line for places near a road."""

    def __init__(self, track: Track) -> None:
        """Find which blocks each sample of a road touches."""
        #: How far from the centre line it answers.
        self.reach_cm = _GRID_MARGIN_CM + max(
            (abs(m.offset_cm) + 0.5 * m.width_cm for m in track.markings), default=0.0
        )
        self._low = track.xy_cm.min(axis=0) - self.reach_cm - _GRID_CELL_CM
        self._xy_cm = track.xy_cm
        self._samples = self._samples_by_block(track)
        self._blocks: dict[tuple[int, int], Int[np.ndarray, "b b"]] = {}
        self._window: tuple[tuple[int, ...], Int[np.ndarray, "r c"]] | None = None

    def around(
        self, low_cm: Float[np.ndarray, "2"], high_cm: Float[np.ndarray, "2"]
    ) -> tuple[Int[np.ndarray, "r c"], Float[np.ndarray, "3"]]:
        """Return the grid over a box of the map, and more.

        Args:
            low_cm: Smallest x and y, frame map.
            high_cm: Largest x and y.

        Returns:
            Nearest sample by cell, -1 away from the road; x and y of its origin and the size of a cell.
        """
        size_cm = _BLOCK_CELLS * _GRID_CELL_CM
        first = np.floor((low_cm - self._low) / size_cm).astype(int)
        last = np.floor((high_cm - self._low) / size_cm).astype(int)
        key = (int(first[0]), int(first[1]), int(last[0]), int(last[1]))
        # The blocks around the car stay the same for many frames.
        if self._window is None or self._window[0] != key:
            self._window = key, self._join(*key)
        return self._window[1], np.array([*(self._low + first * size_cm), _GRID_CELL_CM])

    def _join(self, column0: int, row0: int, column1: int, row1: int) -> Int[np.ndarray, "r c"]:
        n = _BLOCK_CELLS
        grid = np.full(((row1 - row0 + 1) * n, (column1 - column0 + 1) * n), -1, np.int32)
        for row in range(row0, row1 + 1):
            for column in range(column0, column1 + 1):
                if (row, column) in self._samples:
                    i, j = (row - row0) * n, (column - column0) * n
                    grid[i : i + n, j : j + n] = self._block(row, column)
        return grid

    def _block(self, row: int, column: int) -> Int[np.ndarray, "b b"]:
        """Return a block that the road touches."""
        block = self._blocks.get((row, column))
        if block is None:
            if len(self._blocks) >= _MAX_BLOCKS:  # the oldest goes: memory stays flat on a long road
                del self._blocks[next(iter(self._blocks))]
            block = np.full((_BLOCK_CELLS, _BLOCK_CELLS), -1, np.int32)
            x, y = self._low + np.array([column, row]) * (_BLOCK_CELLS * _GRID_CELL_CM)
            best = np.full(block.shape, 1e18)
            samples = self._samples[row, column]
            _fill_grid(self._xy_cm, samples, x, y, _GRID_CELL_CM, self.reach_cm, best, block)
            self._blocks[row, column] = block
        return block

    def _samples_by_block(self, track: Track) -> dict[tuple[int, int], Int[np.ndarray, "samples"]]:
        """Return for each block that the road touches the samples of the centre line near it."""
        size_cm = _BLOCK_CELLS * _GRID_CELL_CM
        low = np.floor((track.xy_cm - self.reach_cm - self._low) / size_cm).astype(int)
        high = np.floor((track.xy_cm + self.reach_cm - self._low) / size_cm).astype(int)
        samples: dict[tuple[int, int], list[int]] = {}
        for i in range(len(low)):
            for row in range(low[i, 1], high[i, 1] + 1):
                for column in range(low[i, 0], high[i, 0] + 1):
                    samples.setdefault((row, column), []).append(i)
        return {key: np.array(index) for key, index in samples.items()}


@compiled
@no_type_check
def _fill_grid(nodes_xy, index, origin_x, origin_y, cell, reach, best, grid):
    """Write into each cell within ``reach`` of the centre line the index of the nearest of some samples."""
    rows, columns = grid.shape
    span = int(np.ceil(reach / cell)) + 1
    for i in index:
        column0 = int(np.floor((nodes_xy[i, 0] - origin_x) / cell))
        row0 = int(np.floor((nodes_xy[i, 1] - origin_y) / cell))
        for row in range(max(0, row0 - span), min(rows, row0 + span + 1)):
            dy = origin_y + (row + 0.5) * cell - nodes_xy[i, 1]
            for column in range(max(0, column0 - span), min(columns, column0 + span + 1)):
                dx = origin_x + (column + 0.5) * cell - nodes_xy[i, 0]
                d = dx * dx + dy * dy
                if d < best[row, column] and d <= reach * reach:
                    best[row, column] = d
                    grid[row, column] = i


class Nearby:
    """Rows of a table near the car; neighbouring frames share the answer."""

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
        """Return the rows that may be in sight from a place, in the table's order, and their reaches."""
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
