"""The residuals of the bundle adjustment: which points are moved into which frames, and what they miss.

What the bundle adjustment believes without looking at the pictures: level frames, a car that rolls.

The normal equations of the bundle adjustment: a sparse matrix of the frames, bordered by the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import bsr_matrix, coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from datagen.slam.adjustment.kernels import N_CAMERA, N_FRAME, accumulate, associate, lift_points
from datagen.slam.adjustment.state import CAMERA_NAMES, BundleSettings, BundleState
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import EdgePixels

#: Shorter commanded ways than this, 1 where they are usual, count as this one.
_LEAST_WAY = 0.1


def frame_priors(
    state: BundleState,
    settings: BundleSettings,
    joined: Int[np.ndarray, "m"],
    expected: Float[np.ndarray, "n"],
    recorded: bool = False,
) -> tuple[float, csc_matrix, Float[np.ndarray, "u"]]:
    """Cost, normal matrix and downhill slope of the priors of all frames.

    Args:
        state: Where.
        settings: Standard deviations.
        joined: Frames that the next one follows.
        expected: Commanded way from the frame before, 1 where it is usual.
        recorded: Whether these come from a recorded speed; else they only say how ways change.
    """
    s, n = settings, len(state.poses)
    rows: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    values: list[np.ndarray] = []
    errors: list[np.ndarray] = []
    count = 0

    def add(error: np.ndarray, sigma: float, *terms: tuple[np.ndarray, np.ndarray]) -> None:
        nonlocal count
        errors.append(error / sigma)
        for column, derivative in terms:
            rows.append(count + np.arange(len(error)))
            columns.append(column)
            values.append(np.broadcast_to(derivative, error.shape) / sigma)
        count += len(error)

    frames = N_FRAME * np.arange(n)
    for offset, (value, sigma) in enumerate(
        zip(state.tilt.T, (s.frame_pitch, s.frame_roll), strict=True), start=3
    ):
        add(value, sigma, (frames + offset, np.ones(n)))
    i, j = joined, joined + 1
    c, si = np.cos(state.poses[i, 2]), np.sin(state.poses[i, 2])
    dx, dy = (state.poses[j] - state.poses[i])[:, :2].T
    turn = state.poses[j, 2] - state.poses[i, 2]
    ahead, left = c * dx + si * dy, c * dy - si * dx
    half = 0.5 * turn
    # On an arc the rear axle moves along the heading at half of the turn.
    xi, yi, ti, xj, yj, tj = (N_FRAME * k + d for k in (i, j) for d in (0, 1, 2))
    along = np.cos(half) * ahead + np.sin(half) * left
    across = np.cos(half) * left - np.sin(half) * ahead
    cm, sm = np.cos(state.poses[i, 2] + half), np.sin(state.poses[i, 2] + half)
    one = np.ones(len(i))
    add(across, s.slip, (xi, sm), (yi, -cm), (xj, -sm), (yj, cm), (ti, -0.5 * along), (tj, -0.5 * along))
    follows = np.flatnonzero(j[:-1] == i[1:])
    a, b = follows, follows + 1
    # Ways in proportion to what was commanded; where the car was told to stand, its way is left alone.
    per = np.where(expected[j] > 0.0, 1.0 / np.maximum(expected[j], _LEAST_WAY), 0.0)
    per_a, per_b = per[a] * (per[b] > 0.0), per[b] * (per[a] > 0.0)
    add(
        per_b * along[b] - per_a * along[a],
        s.speed_change,
        (xj[b], per_b * cm[b]),
        (yj[b], per_b * sm[b]),
        (xi[b], -per_b * cm[b] - per_a * cm[a]),
        (yi[b], -per_b * sm[b] - per_a * sm[a]),
        (xi[a], per_a * cm[a]),
        (yi[a], per_a * sm[a]),
        *((k, 0.5 * per_b * across[b]) for k in (ti[b], tj[b])),
        *((k, -0.5 * per_a * across[a]) for k in (ti[a], tj[a])),
    )
    # Of a car that hardly moves the recorded speed says little of the way.
    told = np.flatnonzero(expected[j] >= _LEAST_WAY) if recorded else np.zeros(0, np.int64)
    if told.size:
        # Of the gain the ways themselves are asked: what all have in common is left to the pictures.
        usual = max(float(np.median(per[told] * along[told])), 1e-6)
        by = per[told] / usual
        add(
            by * along[told] - 1.0,
            s.recorded_speed,
            (xj[told], by * cm[told]),
            (yj[told], by * sm[told]),
            (xi[told], -by * cm[told]),
            (yi[told], -by * sm[told]),
            *((k[told], 0.5 * by * across[told]) for k in (ti, tj)),
        )
    add(turn[b] - turn[a], s.turn_change, (tj[b], one[b]), (ti[b], -2.0 * one[b]), (ti[a], one[a]))
    # The first pose stays.
    add(np.zeros(3), 1e-6, (np.arange(3), np.ones(3)))
    e = np.concatenate(errors)
    jac = coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(count, N_FRAME * n)
    ).tocsc()
    return 0.5 * float(e @ e), (jac.T @ jac).tocsc(), -(jac.T @ e)


@dataclass(frozen=True)
class Equations:
    """Normal equations about a state.

    Attributes:
        cost: Robust cost there, priors included.
        frames: Between the frames' numbers.
        border: Between the frames' numbers and those of the camera that are free.
        camera: Between the latter.
        rhs: Downhill slope of the cost, frames first.
        residual_px: Residual of each link; NaN where it has none.
    """

    cost: float
    frames: csc_matrix
    border: Float[np.ndarray, "u f"]
    camera: Float[np.ndarray, "f f"]
    rhs: Float[np.ndarray, "v"]
    residual_px: Float[np.ndarray, "r"]

    def step(self, damping: float) -> Float[np.ndarray, "v"]:
        """Solve with the camera's few dense columns eliminated last.

        Args:
            damping: Share added to the diagonal.
        """
        count = len(self.border)
        frames = (self.frames + damping * diags(self.frames.diagonal())).tocsc()
        reduced = _factorised(frames).solve(np.column_stack([self.rhs[:count], self.border]))
        if not self.border.shape[1]:
            return np.asarray(reduced[:, 0])
        camera = self.camera + damping * np.diag(np.diag(self.camera))
        schur = camera - self.border.T @ reduced[:, 1:]
        found = np.linalg.solve(schur, self.rhs[count:] - self.border.T @ reduced[:, 0])
        return np.concatenate([reduced[:, 0] - reduced[:, 1:] @ found, found])

    def camera_sigma(self) -> Float[np.ndarray, "f"]:
        """Standard deviations of the camera's free numbers when all else is free, too."""
        if not self.border.shape[1]:
            return np.zeros(0)
        schur = self.camera - self.border.T @ _factorised(self.frames).solve(self.border)
        return np.sqrt(np.maximum(np.diag(np.linalg.inv(schur)), 0.0))


def _factorised(matrix: csc_matrix) -> SuperLU:
    """Factors of a positive definite matrix: no pivoting, and an order that suits symmetry."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


class FramePattern:
    """Where the blocks of pairs of frames go in the matrix; found once, since the pairs stay."""

    def __init__(self, pairs: Int[np.ndarray, "p 2"], frames: int) -> None:
        i, j = pairs.T
        # In the order of a pair's quarters: (i, i), (i, j), (j, i), (j, j); every frame has its diagonal.
        each = np.arange(frames)
        row = np.concatenate([np.stack([i, i, j, j], axis=1).ravel(), each])
        column = np.concatenate([np.stack([i, j, i, j], axis=1).ravel(), each])
        places, slot = np.unique(row * frames + column, return_inverse=True)
        self._order = np.argsort(slot[: 4 * len(pairs)], kind="stable")
        sorted_slot = slot[self._order]
        self._first = np.flatnonzero(np.diff(sorted_slot, prepend=-1))
        self._filled = sorted_slot[self._first]
        size = N_FRAME * N_FRAME
        numbered = np.arange(len(places) * size).reshape(-1, N_FRAME, N_FRAME)
        starts = np.searchsorted(places // frames, np.arange(frames + 1))
        # Numbers counted from 1, since a conversion may drop zeros.
        blocks = bsr_matrix((numbered + 1.0, places % frames, starts), shape=(N_FRAME * frames,) * 2).tocsc()
        blocks.sort_indices()
        self._at = blocks.data.astype(np.int64) - 1
        self._indices, self._starts, self._shape = blocks.indices, blocks.indptr, blocks.shape
        self._blocks = len(places)

    def matrix(self, blocks: Float[np.ndarray, "p 10 10"]) -> csc_matrix:
        """Sum the pairs' blocks into the matrix."""
        count = len(blocks)
        quarters = blocks.reshape(count, 2, N_FRAME, 2, N_FRAME).transpose(0, 1, 3, 2, 4)
        quarters = quarters.reshape(4 * count, N_FRAME, N_FRAME)
        summed = np.zeros((self._blocks, N_FRAME, N_FRAME))
        if count:
            summed[self._filled] = np.add.reduceat(quarters[self._order], self._first, axis=0)
        return csc_matrix((summed.ravel()[self._at], self._indices, self._starts), shape=self._shape)


#: Shares of pictures in which a point meets an edge by chance, and in which one of the road does.
_CHANCE, _SURE, _LEAST_TRUST = 0.4, 0.9, 0.02
#: Cosine of the angle by which a moved edge and the one that it meets may differ.
_LEAST_COSINE = 0.8
#: Pixels from the rim of what is seen, in images of 160 px, over which a point may be misplaced beyond it.
_RIM_PX = 1.0

_Lifted = tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 8 2"], Float[np.ndarray, "m 2"]]


@dataclass(frozen=True)
class Links:
    """Which point meets which edge, sorted by pair.

    Attributes:
        point: Moved points.
        edge: The edge that each meets.
        sigma: Standard deviation of each residual, in that of an edge's place in its own picture.
        pair_starts: First link of each pair of frames, and one behind the last.
    """

    point: Int[np.ndarray, "r"]
    edge: Int[np.ndarray, "r"]
    sigma: Float[np.ndarray, "r"]
    pair_starts: Int[np.ndarray, "p1"]


@dataclass(frozen=True)
class Observations:
    """What the frames of a drive show, and what was commanded: the same for every adjustment of them.

    Attributes:
        edges: Edge pixels per frame, only such that see the road.
        keep: Pixels in which edges were looked for; None for all.
        relative_steps: Commanded step length to each frame, 1 where it is typical; None for
            steps of equal length.
        speed_recorded: Whether these come from a recorded speed.
        breaks: Frames that do not follow the one before them; None for one segment.
    """

    edges: Sequence[EdgePixels]
    keep: UInt8[np.ndarray, "h w"] | None = None
    relative_steps: Float[np.ndarray, "n"] | None = None
    speed_recorded: bool = False
    breaks: Bool[np.ndarray, "n"] | None = None


class BundleProblem:
    """Points, edges and pairs of frames, which stay; see :func:`datagen.slam.adjustment.adjust.adjust`."""

    def __init__(
        self,
        observed: Observations,
        camera: Camera,
        settings: BundleSettings,
        rng: np.random.Generator,
        free: Sequence[str] = CAMERA_NAMES,
        loops: Sequence[tuple[int, int]] = (),
        prior_camera: Camera | None = None,
    ) -> None:
        edges, breaks = observed.edges, observed.breaks
        self.settings, self.camera, self.n = settings, camera, len(edges)
        self.prior_camera = camera if prior_camera is None else prior_camera
        self.fisheye = camera.model == "fisheye"
        self.free = np.array([name in free for name in CAMERA_NAMES])
        counts = np.array([len(e.uv_px) for e in edges])
        self.edge_starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        edge_uv = np.concatenate([e.uv_px for e in edges]).astype(np.float64)
        edge_normals = np.concatenate([e.normals for e in edges]).astype(np.float64)
        chosen = [
            start + np.sort(rng.choice(count, min(count, settings.points), replace=False))
            for start, count in zip(self.edge_starts[:-1], counts, strict=True)
        ]
        self.point_starts = np.concatenate([[0], np.cumsum([len(c) for c in chosen])]).astype(np.int64)
        index = np.concatenate(chosen)
        self.uv, self.normals = edge_uv[index], edge_normals[index]
        # In the order of their rows, in which the kernels look for them.
        by_row = np.lexsort((edge_uv[:, 1], np.repeat(np.arange(self.n), counts)))
        self.edge_uv, self.edge_normals = edge_uv[by_row], edge_normals[by_row]
        segment = np.zeros(self.n, int) if breaks is None else np.cumsum(breaks)
        self.pairs = _pairs(settings.lags, segment, loops, rng)
        self.inner = inner_pixels(camera, observed.keep)
        self.moved_points = int(np.diff(self.point_starts)[self.pairs[:, 0]].sum())
        self.joined = np.flatnonzero(segment[1:] == segment[:-1])
        self.weight = np.full(len(self.uv), 1.0 / settings.pixel_sigma**2)
        self.recorded = observed.speed_recorded
        steps = observed.relative_steps
        self.expected = np.ones(self.n) if steps is None else steps
        self._lifted: tuple[BundleState, _Lifted] | None = None
        self.pattern = FramePattern(self.pairs, self.n)
        scale = camera.width / 160.0
        s = settings
        self.camera_sigmas = np.array(
            [s.focal, s.centre_px * scale, s.centre_px * scale, s.k1, s.pitch, s.roll, s.yaw, s.lever]
        )

    def lift(self, state: BundleState) -> _Lifted:
        """Points on the road, their slopes by the camera, and points half a pixel across each edge."""
        if self._lifted is not None and self._lifted[0] is state:
            # Edges are looked for, and residuals taken, from the same state.
            return self._lifted[1]
        out, normal = np.empty((len(self.uv), 2)), np.empty((len(self.uv), 2))
        by = np.empty((len(self.uv), N_CAMERA, 2))
        lift_points(
            self.fisheye,
            state.lens,
            state.mount,
            state.tilt,
            self.point_starts,
            self.uv,
            self.normals,
            out,
            by,
            normal,
        )
        self._lifted = state, (out, by, normal)
        return out, by, normal

    def associate(self, state: BundleState, gate_px: float) -> Links:
        """Let every moved point look for its edge, and weigh the points by how often they find one."""
        lifted, _, normal = self.lift(state)
        point, edge, pair = (np.empty(self.moved_points, np.int64) for _ in range(3))
        sigma = np.empty(self.moved_points)
        in_view, matched = np.zeros(len(self.uv), np.int64), np.zeros(len(self.uv), np.int64)
        count = associate(
            self.fisheye,
            state.lens,
            state.mount,
            state.tilt,
            state.poses,
            self.pairs,
            self.point_starts,
            lifted,
            normal,
            self.edge_starts,
            self.edge_uv,
            self.edge_normals,
            gate_px * self.camera.width / 160.0,
            _LEAST_COSINE,
            self.inner,
            in_view,
            matched,
            point,
            edge,
            pair,
            sigma,
        )
        self.weight = point_trust(in_view, matched) / self.settings.pixel_sigma**2
        starts = np.searchsorted(pair[:count], np.arange(len(self.pairs) + 1))
        return Links(point[:count], edge[:count], sigma[:count], starts.astype(np.int64))

    def equations(self, state: BundleState, links: Links) -> Equations:
        """Normal equations of all residuals and priors."""
        lifted, by, _ = self.lift(state)
        size = 2 * N_FRAME + N_CAMERA
        blocks, rhs = np.zeros((len(self.pairs), size, size)), np.zeros((len(self.pairs), size))
        residual_px = np.empty(len(links.point))
        cost = accumulate(
            self.fisheye,
            state.lens,
            state.mount,
            state.tilt,
            state.poses,
            self.pairs,
            links.pair_starts,
            links.point,
            links.edge,
            lifted,
            by,
            self.edge_uv,
            self.edge_normals,
            links.sigma,
            self.weight,
            self.settings.cauchy_px,
            blocks,
            rhs,
            residual_px,
        )
        both, count = 2 * N_FRAME, N_FRAME * self.n
        where = (N_FRAME * self.pairs[:, :, None] + np.arange(N_FRAME)).ravel()
        border = [
            np.bincount(where, blocks[:, :both, both + k].ravel(), minlength=count)
            for k in np.flatnonzero(self.free)
        ]
        prior_cost, prior, downhill = frame_priors(
            state, self.settings, self.joined, self.expected, self.recorded
        )
        off = (state.camera_off(self.prior_camera) / self.camera_sigmas)[self.free]
        camera = blocks[:, both:, both:].sum(axis=0)[np.ix_(self.free, self.free)]
        camera_rhs = rhs[:, both:].sum(axis=0)[self.free] - off / self.camera_sigmas[self.free]
        return Equations(
            cost=cost + prior_cost + 0.5 * float(off @ off),
            frames=(self.pattern.matrix(blocks[:, :both, :both]) + prior).tocsc(),
            border=np.stack(border, axis=1) if border else np.empty((count, 0)),
            camera=camera + np.diag(self.camera_sigmas[self.free] ** -2.0),
            rhs=np.concatenate(
                [np.bincount(where, rhs[:, :both].ravel(), minlength=count) + downhill, camera_rhs]
            ),
            residual_px=residual_px,
        )


def _pairs(
    lags: Sequence[int],
    segment: Int[np.ndarray, "n"],
    loops: Sequence[tuple[int, int]],
    rng: np.random.Generator,
) -> Int[np.ndarray, "p 2"]:
    """Pairs of frames: points of the first are moved into the second."""
    pairs = []
    for lag in lags:
        i = np.arange(len(segment) - lag)
        i = i[segment[i] == segment[i + lag]]
        # Back and forth: points that leave the view one way are seen the other way.
        back = rng.random(len(i)) < 0.5
        pairs.append(np.where(back[:, None], np.stack([i + lag, i], 1), np.stack([i, i + lag], 1)))
    both = [(a, b) for a, b in loops] + [(b, a) for a, b in loops]
    pairs.append(np.array(both, dtype=np.int64).reshape(-1, 2))
    return np.concatenate(pairs).astype(np.int64)


def inner_pixels(camera: Camera, keep: UInt8[np.ndarray, "h w"] | None) -> Bool[np.ndarray, "h w"]:
    """True for pixels around which edges were looked for on all sides.

    Args:
        camera: For the size of its images.
        keep: Pixels in which edges were looked for; None for all.
    """
    seen = np.zeros((camera.height + 2, camera.width + 2), np.uint8)
    seen[1:-1, 1:-1] = 1 if keep is None else keep > 0
    rim_px = cv2.distanceTransform(seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return np.asarray(rim_px > _RIM_PX * camera.width / 160.0)


def point_trust(in_view: Int[np.ndarray, "m"], matched: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Trust in each moved point by how often it met an edge.

    Noise meets an edge by chance, wherever it is moved; its residual then only says that all may stay as it
    is. What is on the road is met again in nearly every picture.
    """
    share = matched / np.maximum(in_view, 1)
    trust = np.clip((share - _CHANCE) / (_SURE - _CHANCE), _LEAST_TRUST, 1.0)
    return np.where(in_view >= 2, trust, np.minimum(trust, 0.3))
