"""The map that all particles share: each cell knows what each lineage saw there.

Particles differ in where they were during the last frames only; before that they descend from one ancestor.
What a frame showed is entered once for each particle that survived its resampling (a node of the ancestry
tree). A particle sees what its own ancestors entered. Once all particles descend from a node, its entries
belong to all of them; once none does, they are dropped.

Source:
    Eliazar and Parr 2003 and 2004 (see :mod:`datagen.slam.filter.dp_slam`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from datagen.slam.filter.ancestry_kernels import (
    PAGE_SIZE,
    AncestryTree,
    Cells,
    MapArrays,
    Pages,
    collapse,
    grow,
    score,
    write,
)
from datagen.slam.odometry.scans import Scan

Likelihood = Literal["direction", "count"]

#: Frames that may be collapsed while one is entered: two bound the work of a frame and catch up in time.
_COLLAPSED_PER_FRAME = 2


@dataclass(frozen=True)
class MapLayout:
    """Geometry and limits of a shared map.

    Attributes:
        cell_cm: Side of a cell.
        size: Cells along each side of the grid, a power of two; the grid wraps around.
        memory_frames: Frames after which an entry has faded to 1/e.
        wheelbase_cm: Distance between the axles.
        points: How many edge points a frame may enter.
        window: Frames for which lineages are told apart.
        likelihood: What is entered and scored: blurred normals, or the occupied cells of the paper.
        pages: Room for the entries of single lineages, in pages of ``PAGE_SIZE``. Chosen: with them the
            whole map takes 26 MB (``tests/bench/bench_filter.py``).
    """

    cell_cm: float
    size: int
    memory_frames: float
    wheelbase_cm: float
    points: int
    window: int = 64
    likelihood: Likelihood = "direction"
    pages: int = 40_000


class AncestryMap:
    """The shared map; its memory is allocated at the start and never grows.

    Attributes:
        arrays: What it holds.
        forced: Frames that were collapsed although lineages still differed, because the window or the pages
            were full. They are entered for all particles at the mean pose of their ancestors.
    """

    def __init__(self, particles: int, layout: MapLayout) -> None:
        window, size, pages = layout.window, layout.size, layout.pages
        self.forced, self._oldest = 0, 0
        tree = AncestryTree(
            np.zeros((window, particles, 2), np.int32),
            np.zeros(window, np.int32),
            np.zeros(window, np.int32),
            np.zeros((window, particles, 3)),
            np.zeros((window, layout.points, 5)),
            np.zeros(window, np.int32),
            np.zeros(2, np.int64),
            np.exp(-np.arange(-window, window + 1) / layout.memory_frames),
            np.zeros((particles, 4), np.int64),
        )
        state = np.zeros((size, size, 8), np.int32)
        state[:, :, 2:] = -1
        following = np.arange(1, pages + 1, dtype=np.int32)
        following[-1] = -1
        pool = Pages(
            following,
            np.zeros(pages, np.int32),
            np.zeros((pages, PAGE_SIZE), np.int32),
            np.zeros((pages, PAGE_SIZE, 2)),
            np.array([0, pages], np.int32),
        )
        cells, counting = Cells(state, np.zeros((size, size, 2))), layout.likelihood == "count"
        self.arrays = MapArrays(
            tree, cells, pool, layout.cell_cm, layout.wheelbase_cm, layout.memory_frames, counting
        )

    @property
    def bytes(self) -> int:
        """Memory of the map."""
        return sum(array.nbytes for part in self.arrays[:3] for array in part)

    def score(self, poses: Float[np.ndarray, "p 3"], scan: Scan, frame: int) -> Float[np.ndarray, "p"]:
        """Score how well a frame's edges fit what each particle's lineage has seen.

        Args:
            poses: One per particle, in their order.
            scan: Edge points of the frame.
            frame: Number of the frame, later than all that was mapped.

        Returns:
            About the weighted number of matched points, one number per particle.
        """
        points = np.concatenate([scan.points_cm, scan.normals, scan.weights[:, None]], axis=1)
        return np.asarray(score(self.arrays, poses, points, frame))

    def descend(self, states: Float[np.ndarray, "p s"], chosen: Int[np.ndarray, "p"], frame: int) -> int:
        """Follow a resampling, and give the survivors nodes of this frame.

        Args:
            states: Particles before resampling, x, y and heading first.
            chosen: Index of each new particle's parent, ascending.
            frame: Number of the frame.

        Returns:
            Number of survivors.
        """
        tree = self.arrays.tree
        window = len(tree.nodes)
        if frame - self._oldest >= window:
            self._collapse_oldest()
        grow(tree, frame % window, frame, states, chosen)
        # Where lineages have met, frames can be collapsed: one a frame on average, sometimes many at once.
        for _ in range(_COLLAPSED_PER_FRAME):
            if self._oldest < frame and self._agreed(self._oldest % window):
                self._collapse_oldest()
        return int(tree.nodes[frame % window])

    def enter(self, scan: Scan, frame: int) -> None:
        """Enter a frame's edges as seen from each of its nodes."""
        tree = self.arrays.tree
        row, count = frame % len(tree.nodes), len(scan.weights)
        stored = tree.points[row, :count]
        stored[:, :2], stored[:, 2:4], stored[:, 4] = scan
        tree.size[row] = count
        done = 0
        while True:
            done = write(self.arrays, row, done)
            if done == count or self._oldest == frame:
                break
            self._collapse_oldest()

    def _agreed(self, row: int) -> bool:
        """Whether all particles descend from one node of a row."""
        tree = self.arrays.tree
        span = tree.span[row, : int(tree.nodes[row])]
        return bool(np.any(span[:, 1] - span[:, 0] == tree.span.shape[1]))

    def _collapse_oldest(self) -> None:
        """Free the row of the oldest frame."""
        row = self._oldest % len(self.arrays.tree.nodes)
        if collapse(self.arrays, row):
            self.forced += 1
            write(self.arrays, row, 0)
            collapse(self.arrays, row)
        self._oldest += 1
