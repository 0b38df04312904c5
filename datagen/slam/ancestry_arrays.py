"""The arrays of the shared map, as the numba kernels take them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int32, Int64

#: Entries per page.
PAGE_SIZE = 16
#: A node's number in an entry: its row above this many bits, its place in the row below.
PLACE_BITS = 16
PLACE = (1 << PLACE_BITS) - 1
#: Type of an index: without a sign, numba need not look whether it counts from the end.
U = np.uint32
#: Columns of a cell's state.
OWNER_X, OWNER_Y, PAGE, STAMP, PRUNED = range(5)


class Tree(NamedTuple):
    """Nodes of the last frames; those of frame k stand in row k % window, in the order of the particles.

    Attributes:
        span: First living particle that descends from the node, and one behind the last; the same for a
            dead node.
        nodes: Nodes per row.
        frame: Frame that the row belongs to.
        pose: Rear-axle pose of each node, frame map.
        points: Edge points that each frame wrote: x right, y ahead, normal x, normal y (frame car), weight.
        size: How many points each frame wrote.
        version: How often intervals have changed, and how many cells were pruned.
        fades: Fade by age in frames, from minus the window (what is newer counts more) to the window.
        mark: For pruning, by the particle that an entry's interval begins with: the last pruned cell with
            such an entry, and the interval's end, the frame and the place of that entry.
    """

    span: Int32[np.ndarray, "w p 2"]
    nodes: Int32[np.ndarray, "w"]
    frame: Int32[np.ndarray, "w"]
    pose: Float[np.ndarray, "w p 3"]
    points: Float[np.ndarray, "w m 5"]
    size: Int32[np.ndarray, "w"]
    version: Int64[np.ndarray, "2"]
    fades: Float[np.ndarray, "w21"]
    mark: Int64[np.ndarray, "p 4"]


class Cells(NamedTuple):
    """A wrapping grid; each cell has a root, which all particles share, and entries of single lineages.

    Attributes:
        state: Per cell: which cell of the unbounded plane it holds (ix, iy), its first page (-1: none), the
            frame of the newest content of its root (-1: none), and the version of the tree for which it was
            pruned.
        root: Sum of what all particles agree on, faded to the frame of its newest content.
    """

    state: Int32[np.ndarray, "s s 8"]
    root: Float[np.ndarray, "s s 2"]


class Pages(NamedTuple):
    """Entries of the cells, by the page: what one node saw in one cell.

    Attributes:
        following: Next page of the cell, or of the free ones; -1 at the end.
        used: Entries in each page.
        node: Who saw it: row << PLACE_BITS | place in the row.
        vector: What was seen.
        free: First free page, and how many are free.
    """

    following: Int32[np.ndarray, "n"]
    used: Int32[np.ndarray, "n"]
    node: Int32[np.ndarray, "n e"]
    vector: Float[np.ndarray, "n e 2"]
    free: Int32[np.ndarray, "2"]
