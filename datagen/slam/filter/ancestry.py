"""One map that all particles share, each cell of which knows what each lineage saw there.

After Eliazar and Parr (DP-SLAM, 2003): particles differ in where they were during the last frames only;
before that they descend from the same ancestor. What a frame showed is entered once for each particle that
survived its resampling (a node of the ancestry), and a particle sees of it what its own ancestor entered.
Once all particles descend from one node, its entries belong to all; once none does, they are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from datagen.slam.filter.ancestry_kernels import PAGE_SIZE, Cells, Pages, Tree, forget, grow, score, write

Likelihood = Literal["direction", "count"]

#: A cell counts as occupied until what was seen in it has faded to this share (three memories).
_OCCUPIED = 0.05


@dataclass
class AncestryMap:
    """The shared map; its memory is taken at the start and never grows.

    Attributes:
        cell_cm: Side of a cell.
        memory_frames: Frames after which what was mapped has faded to 1/e.
        wheelbase_cm: Distance between the axles.
        likelihood: What is entered and scored: blurred normals, or the occupied cells of the paper.
        tree: The living ancestry.
        cells: The grid.
        pages: What single lineages saw.
        forced: Frames that were entered for all at the mean pose of their ancestors, because lineages still
            differed when the window or the pages were full.
    """

    cell_cm: float
    memory_frames: float
    wheelbase_cm: float
    likelihood: Likelihood
    tree: Tree
    cells: Cells
    pages: Pages
    forced: int = 0
    _oldest: int = 0

    @staticmethod
    def empty(
        particles: int,
        cell_cm: float,
        size: int,
        memory_frames: float,
        wheelbase_cm: float,
        points: int,
        window: int = 64,
        likelihood: Likelihood = "direction",
        pages: int = 40_000,
    ) -> AncestryMap:
        """Return a map with nothing in it.

        Args:
            particles: How many share it.
            cell_cm: Side of a cell.
            size: Cells along each side of the grid, a power of two; the grid wraps around.
            memory_frames: Frames after which what was mapped has faded to 1/e.
            wheelbase_cm: Distance between the axles.
            points: How many edge points a frame may enter.
            window: Frames for which lineages are told apart.
            likelihood: Which likelihood the map serves.
            pages: Room for what single lineages saw, in pages of 16 entries.
        """
        tree = Tree(
            np.zeros((window, particles, 2), np.int32),
            np.zeros(window, np.int32),
            np.zeros(window, np.int32),
            np.zeros((window, particles, 3)),
            np.zeros((window, points, 5)),
            np.zeros(window, np.int32),
            np.zeros(2, np.int64),
            np.exp(-np.arange(-window, window + 1) / memory_frames),
            np.zeros((particles, 4), np.int64),
        )
        state = np.zeros((size, size, 8), np.int32)
        state[:, :, 2:] = -1
        cells = Cells(state, np.zeros((size, size, 2)))
        following = np.arange(1, pages + 1, dtype=np.int32)
        following[-1] = -1
        pool = Pages(
            following,
            np.zeros(pages, np.int32),
            np.zeros((pages, PAGE_SIZE), np.int32),
            np.zeros((pages, PAGE_SIZE, 2)),
            np.array([0, pages], np.int32),
        )
        return AncestryMap(
            cell_cm,
            memory_frames,
            wheelbase_cm,
            likelihood,
            tree,
            cells,
            pool,
        )

    @property
    def bytes(self) -> int:
        """Memory of the map."""
        return sum(array.nbytes for part in (self.tree, self.cells, self.pages) for array in part)

    def score(
        self,
        poses: Float[np.ndarray, "p 3"],
        points_car_cm: Float[np.ndarray, "n 2"],
        normals_car: Float[np.ndarray, "n 2"],
        weights: Float[np.ndarray, "n"],
        frame: int,
    ) -> Float[np.ndarray, "p"]:
        """Score how well a frame's edges fit what each particle's lineage has seen.

        Args:
            poses: One per particle, in their order.
            points_car_cm: Edge points, frame car.
            normals_car: Their unit normals.
            weights: Trust in each.
            frame: Number of the frame, later than all that was mapped.

        Returns:
            About the weighted number of matched points, one number per particle.
        """
        scores = np.zeros(len(poses))
        points = np.concatenate([points_car_cm, normals_car, weights[:, None]], axis=1)
        occupied = _OCCUPIED if self.likelihood == "count" else 0.0
        score(
            self.tree,
            self.cells,
            self.pages,
            poses,
            points,
            frame,
            self.wheelbase_cm,
            self.cell_cm,
            self.memory_frames,
            occupied,
            scores,
        )
        return scores

    def descend(self, states: Float[np.ndarray, "p s"], chosen: Int[np.ndarray, "p"], frame: int) -> int:
        """Follow a resampling and give the survivors nodes of this frame.

        Args:
            states: Particles before resampling, x, y and heading first.
            chosen: Index of each new particle's parent, ascending.
            frame: Number of the frame.

        Returns:
            Number of survivors.
        """
        window = len(self.tree.nodes)
        if frame - self._oldest >= window:
            self._forget_oldest()
        grow(self.tree, frame % window, frame, states, chosen)
        # Lineages that have met free a frame each, some frames at once; to share the work, two at most.
        for _ in range(2):
            if self._oldest < frame and self._agreed(self._oldest % window):
                self._forget_oldest()
        return int(self.tree.nodes[frame % window])

    def enter(
        self,
        points_car_cm: Float[np.ndarray, "n 2"],
        normals_car: Float[np.ndarray, "n 2"],
        weights: Float[np.ndarray, "n"],
        frame: int,
    ) -> None:
        """Enter a frame's edges as seen from each of its nodes, [cm], frame car."""
        row = frame % len(self.tree.nodes)
        stored = self.tree.points[row, : len(weights)]
        stored[:, :2], stored[:, 2:4], stored[:, 4] = points_car_cm, normals_car, weights
        self.tree.size[row] = len(weights)
        plain, done = self.likelihood == "count", 0
        while True:
            done = write(self.tree, self.cells, self.pages, row, done, self.wheelbase_cm, self.cell_cm, plain)
            if done == len(weights) or self._oldest == frame:
                break
            self._forget_oldest()

    def _agreed(self, row: int) -> bool:
        """Whether all particles descend from one node of a row."""
        span = self.tree.span[row, : int(self.tree.nodes[row])]
        return bool(np.any(span[:, 1] - span[:, 0] == self.tree.span.shape[1]))

    def _forget_oldest(self) -> None:
        """Free the row of the oldest frame."""
        row = self._oldest % len(self.tree.nodes)
        plain = self.likelihood == "count"
        if self._forget(row):
            self.forced += 1
            write(self.tree, self.cells, self.pages, row, 0, self.wheelbase_cm, self.cell_cm, plain)
            self._forget(row)
        self._oldest += 1

    def _forget(self, row: int) -> bool:
        plain = self.likelihood == "count"
        return bool(
            forget(
                self.tree,
                self.cells,
                self.pages,
                row,
                self.wheelbase_cm,
                self.cell_cm,
                self.memory_frames,
                plain,
            )
        )
