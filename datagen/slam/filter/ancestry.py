"""The map that all particles share: each cell knows what each lineage saw there.

Particles differ in where they were during the last frames only; before that they descend from one ancestor.
What a frame showed is entered once for each particle that survived its resampling (a node of the ancestry
tree). A particle sees what its own ancestors entered. Once all particles descend from a node, its entries
belong to all of them; once none does, they are dropped.

Resampling keeps the order of the particles (systematic resampling draws ascending indices). The living
descendants of a node are therefore neighbours: one interval of particles. Whether a particle descends from a
node is two comparisons, and what a cell holds for each particle is a sum over intervals.

An entry whose interval is empty is dead. One whose interval holds everybody is the same for all particles and
moves into the root of its cell. Both are dealt with when a cell is visited, and at the latest when the
frame's row leaves the tree.

The entries of a cell are stored in pages, each of which is contiguous, and the loops over points are
outermost: following entries one by one through memory would take longer than all the arithmetic.

The loops spell out what NumPy would do with whole arrays: that takes numba three times as long to compile.

Source:
    Eliazar and Parr 2003 and 2004 (see :mod:`datagen.slam.filter.dp_slam`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int, Int32, Int64
from numba import njit

from datagen.slam.odometry.scans import Scan

Likelihood = Literal["direction", "count"]

#: Frames that may be collapsed while one is entered: two bound the work of a frame and catch up in time.
_COLLAPSED_PER_FRAME = 2
#: Entries per page. Chosen: a page of vectors is four cache lines.
PAGE_SIZE = 16
#: A node's number in an entry: its row in the bits above these, its place in the row below.
PLACE_BITS = 16
PLACE = (1 << PLACE_BITS) - 1
#: Type of an index: unsigned, so that numba need not check for indices from the end.
U = np.uint32
#: Columns of a cell's state.
OWNER_X, OWNER_Y, PAGE, STAMP, PRUNED = range(5)
#: Cells along each side of the square in which a node's last entries are remembered. Chosen: neighbouring
#: points are at most a patch apart, which is a cell.
_RECENT = 4
_NOWHERE = -(1 << 31)  # no cell has this number
#: A cell counts as occupied until what was seen in it has faded to this share: three memories, exp(-3).
_OCCUPIED = 0.05
#: Cells that the particles' views of one point may spread over to be looked up together. Chosen: 64 x 64
#: cells, far more than particles spread over while they track.
_BOX = 4096
#: Particles with the same cell up to which each is looked up singly. Chosen: it only changes the time.
_FEW = 4


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
        """Return the log likelihood of each particle: how well the edges fit what its lineage has seen.

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


class AncestryTree(NamedTuple):
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
        vector: What was seen: weighted normal, or weight.
        free: First free page, and how many are free.
    """

    following: Int32[np.ndarray, "n"]
    used: Int32[np.ndarray, "n"]
    node: Int32[np.ndarray, "n e"]
    vector: Float[np.ndarray, "n e 2"]
    free: Int32[np.ndarray, "2"]


class MapArrays(NamedTuple):
    """The shared map as the kernels take it.

    Attributes:
        tree: The living ancestry.
        cells: The grid.
        pages: Entries of single lineages.
        cell_cm: Side of a cell.
        wheelbase_cm: Distance between the axles.
        memory_frames: Frames after which an entry has faded to 1/e.
        counting: Whether (weight, 0) is entered into a point's own cell, and occupied cells are counted; else
            blurred normals are entered, and directions scored.
    """

    tree: AncestryTree
    cells: Cells
    pages: Pages
    cell_cm: float
    wheelbase_cm: float
    memory_frames: float
    counting: bool


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def grow(tree, row, frame, states, chosen):
    """Follow a resampling: give every node its new interval, and the survivors nodes of their own.

    Args:
        tree: The tree.
        row: Row of the new nodes.
        frame: Their frame.
        states: Particles before resampling; the first three columns are poses.
        chosen: Ascending index of each new particle's parent among them.
    """
    span, particles = tree.span, len(chosen)
    # How many new particles stand before the copies of each old one.
    before = np.zeros(particles + 1, np.int32)
    for p in range(particles):
        before[chosen[p] + 1] += 1
    for p in range(particles):
        before[p + 1] += before[p]
    for r in range(span.shape[0]):
        for i in range(tree.nodes[r]):
            span[r, i, 0] = before[span[r, i, 0]]
            span[r, i, 1] = before[span[r, i, 1]]
    count = 0
    for p in range(particles):
        if before[p + 1] > before[p]:
            span[row, count, 0] = before[p]
            span[row, count, 1] = before[p + 1]
            for c in range(3):
                tree.pose[row, count, c] = states[p, c]
            count += 1
    tree.nodes[row] = count
    tree.frame[row] = frame
    tree.version[0] += 1


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def prune(tree, cells, pages, a, b, memory):
    """Prune a cell: drop dead entries, and move those that all particles share into its root.

    Entries with the same descendants keep the same descendants: they are merged.
    """
    state, root = cells.state, cells.root
    following, used = pages.following, pages.used
    entered, vector = pages.node.reshape(-1), pages.vector.reshape((-1, 2))
    span, frames, fades, mark = tree.span, tree.frame, tree.fades, tree.mark
    window, particles = span.shape[0], span.shape[1]
    state[a, b, PRUNED] = tree.version[0]
    tree.version[1] += 1
    serial = tree.version[1]
    # Entries that stay move to the front; ``into`` is the page that is being filled, ``out`` the place.
    page = into = state[a, b, PAGE]
    out = into * PAGE_SIZE
    while page >= 0:
        first, stop_at = page * PAGE_SIZE, page * PAGE_SIZE + used[page]
        page = following[page]
        for at in range(first, stop_at):
            e = U(at)
            node = entered[e]
            row, place = U(node >> PLACE_BITS), U(node & PLACE)
            start, stop = U(span[row, place, 0]), np.int64(span[row, place, 1])
            size, frame = stop - np.int64(start), np.int64(frames[row])
            if size == particles:
                stamp, fade = state[a, b, STAMP], 1.0
                if stamp < frame:
                    old = np.exp((stamp - frame) / memory) if stamp >= 0 else 0.0
                    root[a, b, 0] *= old
                    root[a, b, 1] *= old
                    state[a, b, STAMP] = frame
                elif stamp > frame:
                    fade = np.exp((frame - stamp) / memory)
                root[a, b, 0] += fade * vector[e, 0]
                root[a, b, 1] += fade * vector[e, 1]
            elif size > 0:
                if mark[start, 0] == serial and mark[start, 1] == stop:
                    like, fade = U(mark[start, 3]), fades[U(window + mark[start, 2] - frame)]
                    vector[like, 0] += fade * vector[e, 0]
                    vector[like, 1] += fade * vector[e, 1]
                    continue
                if out == (into + 1) * PAGE_SIZE:
                    used[into] = PAGE_SIZE
                    into = following[into]
                    out = into * PAGE_SIZE
                entered[U(out)] = node
                vector[U(out), 0], vector[U(out), 1] = vector[e, 0], vector[e, 1]
                mark[start, 0], mark[start, 1], mark[start, 2], mark[start, 3] = serial, stop, frame, out
                out += 1
    rest, filled = state[a, b, PAGE], out - into * PAGE_SIZE
    if filled > 0:
        used[into] = filled
        rest = following[into]
        following[into] = -1
    else:
        state[a, b, PAGE] = -1
    _free(pages, rest)


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _free(pages, page):
    """Return a chain of pages to the free ones."""
    while page >= 0:
        following = pages.following[page]
        pages.following[page] = pages.free[0]
        pages.free[0] = page
        pages.free[1] += 1
        page = following


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def write(shared, row, start):
    """Enter the points of a row, seen from each of its nodes.

    Args:
        shared: The map.
        row: Row to enter.
        start: First point to enter.

    Returns:
        First point that was not entered, because the pages might not suffice for it.
    """
    tree, cells, pages = shared.tree, shared.cells, shared.pages
    wheelbase, cell_cm, plain = shared.wheelbase_cm, shared.cell_cm, shared.counting
    pose, points, state, root = tree.pose, tree.points, cells.state, cells.root
    following, used, free = pages.following, pages.used, pages.free
    entered, vector = pages.node.reshape(-1), pages.vector.reshape((-1, 2))
    nodes, mask = tree.nodes[row], state.shape[0] - 1
    wx, wy = np.empty(2), np.empty(2)
    wx[0] = wx[1] = wy[0] = wy[1] = 1.0
    reach, half = (1, 0.0) if plain else (2, 0.5)
    cosines, sines = np.empty(nodes), np.empty(nodes)
    for node in range(nodes):
        cosines[node], sines[node] = np.cos(pose[row, node, 2]), np.sin(pose[row, node, 2])
    # Neighbouring points share cells: the last entry of a node in each of a few cells takes both.
    recent = np.empty((nodes, _RECENT * _RECENT, 3), np.int32)
    _forget(recent)
    for i in range(start, tree.size[row]):
        if free[1] < reach * reach * nodes:
            return i
        right, forward = points[row, i, 0], points[row, i, 1] + wheelbase
        weight = points[row, i, 4]
        for node in range(nodes):
            c, s = cosines[node], sines[node]
            gx = (pose[row, node, 0] + forward * c + right * s) / cell_cm - half
            gy = (pose[row, node, 1] + forward * s - right * c) / cell_cm - half
            cx, cy = int(np.floor(gx)), int(np.floor(gy))
            nx, ny = 1.0, 0.0
            if not plain:
                nx = points[row, i, 3] * c + points[row, i, 2] * s
                ny = points[row, i, 3] * s - points[row, i, 2] * c
                # Shared among the four nearest cells by distance.
                tx, ty = gx - cx, gy - cy
                wx[0], wx[1] = 1.0 - tx, tx
                wy[0], wy[1] = 1.0 - ty, ty
            for jy in range(reach):
                for jx in range(reach):
                    share = weight * wx[jx] * wy[jy]
                    ix, iy = cx + jx, cy + jy
                    a, b = U(iy & mask), U(ix & mask)
                    slot = U((iy & (_RECENT - 1)) * _RECENT + (ix & (_RECENT - 1)))
                    if state[a, b, OWNER_X] != ix or state[a, b, OWNER_Y] != iy:
                        # The cell is taken over by another patch of road; what it held is dropped.
                        if state[a, b, PAGE] >= 0:
                            _free(pages, state[a, b, PAGE])
                            _forget(recent)
                        state[a, b, PAGE], state[a, b, STAMP] = -1, -1
                        root[a, b, 0], root[a, b, 1] = 0.0, 0.0
                        state[a, b, OWNER_X], state[a, b, OWNER_Y] = ix, iy
                    elif recent[node, slot, 0] == ix and recent[node, slot, 1] == iy:
                        like = U(recent[node, slot, 2])
                        vector[like, 0] += share * nx
                        vector[like, 1] += share * ny
                        continue
                    page = state[a, b, PAGE]
                    if page < 0 or used[U(page)] == PAGE_SIZE:
                        fresh = free[0]
                        free[0] = following[fresh]
                        free[1] -= 1
                        following[fresh] = page
                        used[fresh] = 0
                        state[a, b, PAGE] = page = fresh
                    out = page * PAGE_SIZE + used[U(page)]
                    used[U(page)] += 1
                    entered[U(out)] = row << PLACE_BITS | node
                    vector[U(out), 0] = share * nx
                    vector[U(out), 1] = share * ny
                    recent[node, slot, 0], recent[node, slot, 1], recent[node, slot, 2] = ix, iy, out
    return tree.size[row]


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def _forget(recent):
    """Forget the cells of all nodes."""
    for node in range(recent.shape[0]):
        for slot in range(recent.shape[1]):
            recent[node, slot, 0] = recent[node, slot, 1] = _NOWHERE


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def collapse(shared, row):
    """Collapse a row of the tree: its entries move into the roots or are dropped.

    Where lineages still differ, one node at their ancestors' mean pose is left in the row, to be entered and
    collapsed in turn.

    Args:
        shared: The map.
        row: Row to free.

    Returns:
        Whether lineages still differed.
    """
    tree, cells, pages = shared.tree, shared.cells, shared.pages
    wheelbase, cell_cm, plain = shared.wheelbase_cm, shared.cell_cm, shared.counting
    span, pose, points, state = tree.span, tree.pose, tree.points, cells.state
    particles, nodes, mask = span.shape[1], tree.nodes[row], state.shape[0] - 1
    reach, half = (1, 0.0) if plain else (2, 0.5)
    forced, mean = True, np.zeros(3)
    cosines, sines = np.empty(nodes), np.empty(nodes)
    for node in range(nodes):
        size = span[row, node, 1] - span[row, node, 0]
        forced &= size < particles
        for c in range(3):
            mean[c] += size / particles * pose[row, node, c]
        cosines[node], sines[node] = np.cos(pose[row, node, 2]), np.sin(pose[row, node, 2])
    if forced:
        for node in range(nodes):
            span[row, node, 0] = span[row, node, 1] = 0
        tree.version[0] += 1
    version = tree.version[0]
    for i in range(tree.size[row]):
        right, forward = points[row, i, 0], points[row, i, 1] + wheelbase
        for node in range(nodes):
            c, s = cosines[node], sines[node]
            cx = int(np.floor((pose[row, node, 0] + forward * c + right * s) / cell_cm - half))
            cy = int(np.floor((pose[row, node, 1] + forward * s - right * c) / cell_cm - half))
            for iy in range(cy, cy + reach):
                for ix in range(cx, cx + reach):
                    a, b = U(iy & mask), U(ix & mask)
                    if state[a, b, PAGE] >= 0 and state[a, b, PRUNED] != version:
                        prune(tree, cells, pages, a, b, shared.memory_frames)
    if forced:
        # No entry of single lineages is left; one node that everybody descends from takes their place.
        for c in range(3):
            pose[row, 0, c] = mean[c]
        span[row, 0, 1] = particles
        tree.nodes[row] = 1
        tree.version[0] += 1
    else:
        tree.nodes[row] = 0
        tree.size[row] = 0
    return forced


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def score(shared, poses, points, frame):
    """Return the log likelihood of each particle: its view of a frame against the map of its own lineage.

    Args:
        shared: The map.
        poses: Predicted poses, frame map.
        points: Edge points as in :class:`AncestryTree`.
        frame: Number of the frame, one more than the newest in the tree.

    Returns:
        About the weighted number of matched points, one number per particle.

    """
    tree, cells, pages, cell_cm = shared.tree, shared.cells, shared.pages, shared.cell_cm
    wheelbase, memory, particles = shared.wheelbase_cm, shared.memory_frames, len(poses)
    state, root, mask = cells.state, cells.root, cells.state.shape[0] - 1
    following, used = pages.following, pages.used
    entered, vector = pages.node.reshape(-1), pages.vector.reshape((-1, 2))
    span, window = tree.span, tree.span.shape[0]
    fade_of = np.empty(window)
    for row in range(window):
        fade_of[row] = tree.fades[window + min(frame - tree.frame[row], window)]
    cosines, sines = np.empty(particles), np.empty(particles)
    for p in range(particles):
        cosines[p], sines[p] = np.cos(poses[p, 2]), np.sin(poses[p, 2])
    values = np.empty((particles // _FEW + 1, particles + 1, 2))
    asked, rows = np.zeros(_BOX, np.int64), np.empty(_BOX, np.int64)
    ix, iy = np.empty(particles, np.int64), np.empty(particles, np.int64)
    seen_x, seen_y = np.empty(particles), np.empty(particles)
    scores = np.zeros(particles)
    for i in range(len(points)):
        right, forward, weight = points[i, 0], points[i, 1] + wheelbase, points[i, 4]
        for p in range(particles):
            ix[p] = int(np.floor((poses[p, 0] + forward * cosines[p] + right * sines[p]) / cell_cm))
            iy[p] = int(np.floor((poses[p, 1] + forward * sines[p] - right * cosines[p]) / cell_cm))
        low_x, low_y, high_x, high_y = ix[0], iy[0], ix[0], iy[0]
        for p in range(1, particles):
            low_x, low_y = min(low_x, ix[p]), min(low_y, iy[p])
            high_x, high_y = max(high_x, ix[p]), max(high_y, iy[p])
        wide, high = high_x - low_x + 1, high_y - low_y + 1
        boxed, filled = wide * high <= _BOX, 0
        if boxed:
            for box in range(wide * high):
                asked[box] = 0
            for p in range(particles):
                asked[(iy[p] - low_y) * wide + ix[p] - low_x] += 1
        for p in range(particles):
            x, y = 0.0, 0.0
            box = (iy[p] - low_y) * wide + ix[p] - low_x if boxed else 0
            if boxed and asked[box] == 0:
                # Looked up before for all particles.
                x, y = values[rows[box], p, 0], values[rows[box], p, 1]
            else:
                a, b = U(iy[p] & mask), U(ix[p] & mask)
                mine = state[a, b, OWNER_X] == ix[p] and state[a, b, OWNER_Y] == iy[p]
                page = -1
                if mine:
                    if state[a, b, PAGE] >= 0 and state[a, b, PRUNED] != tree.version[0]:
                        prune(tree, cells, pages, a, b, memory)
                    if state[a, b, STAMP] >= 0:
                        fade = np.exp((state[a, b, STAMP] - frame) / memory)
                        x, y = fade * root[a, b, 0], fade * root[a, b, 1]
                    page = state[a, b, PAGE]
                if boxed and asked[box] > _FEW:
                    held = values[filled]
                    for q in range(particles + 1):
                        held[q, 0] = held[q, 1] = 0.0
                    while page >= 0:
                        for at in range(page * PAGE_SIZE, page * PAGE_SIZE + used[page]):
                            e = U(at)
                            row, place = U(entered[e] >> PLACE_BITS), U(entered[e] & PLACE)
                            start, stop = U(span[row, place, 0]), U(span[row, place, 1])
                            vx, vy = fade_of[row] * vector[e, 0], fade_of[row] * vector[e, 1]
                            # Steps at both ends of the interval; the running sum makes them plateaus.
                            held[start, 0] += vx
                            held[start, 1] += vy
                            held[stop, 0] -= vx
                            held[stop, 1] -= vy
                        page = following[page]
                    for q in range(particles):
                        x += held[q, 0]
                        y += held[q, 1]
                        held[q, 0], held[q, 1] = x, y
                    rows[box], asked[box] = filled, 0
                    filled += 1
                    x, y = held[p, 0], held[p, 1]
                else:
                    while page >= 0:
                        for at in range(page * PAGE_SIZE, page * PAGE_SIZE + used[page]):
                            e = U(at)
                            row, place = U(entered[e] >> PLACE_BITS), U(entered[e] & PLACE)
                            if span[row, place, 0] <= p < span[row, place, 1]:
                                x += fade_of[row] * vector[e, 0]
                                y += fade_of[row] * vector[e, 1]
                        page = following[page]
            seen_x[p], seen_y[p] = x, y
        if shared.counting:
            for p in range(particles):
                scores[p] += weight * (seen_x[p] >= _OCCUPIED)
            continue
        # A loop of its own, so that it is vectorised.
        for p in range(particles):
            x, y = seen_x[p], seen_y[p]
            nx = points[i, 3] * cosines[p] + points[i, 2] * sines[p]
            ny = points[i, 3] * sines[p] - points[i, 2] * cosines[p]
            # Saturate: an edge that was seen often counts once.
            scores[p] += weight * (nx * x + ny * y) / (1.0 + np.sqrt(x * x + y * y))
    return scores
