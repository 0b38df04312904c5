"""The residuals of the bundle adjustment: which points are moved into which frames, and what they miss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from datagen.slam.bundle_kernels import N_FRAME, accumulate, associate, lift_points
from datagen.slam.bundle_priors import frame_priors
from datagen.slam.bundle_settings import BundleSettings
from datagen.slam.bundle_solve import Equations, FramePattern
from datagen.slam.bundle_state import CAMERA_NAMES, BundleState
from datagen.slam.lens_kernels import N_CAMERA
from lanenet.geometry.camera import Camera
from lanenet.perception.edges import EdgePixels

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


class BundleProblem:
    """Points, edges and pairs of frames, which stay; see :func:`datagen.slam.bundle.adjust`."""

    def __init__(
        self,
        edges: Sequence[EdgePixels],
        camera: Camera,
        settings: BundleSettings,
        rng: np.random.Generator,
        free: Sequence[str] = CAMERA_NAMES,
        loops: Sequence[tuple[int, int]] = (),
        breaks: Bool[np.ndarray, "n"] | None = None,
        expected: Float[np.ndarray, "n"] | None = None,
        believed: Camera | None = None,
        keep: UInt8[np.ndarray, "h w"] | None = None,
        recorded: bool = False,
    ) -> None:
        self.settings, self.camera, self.n = settings, camera, len(edges)
        self.believed = camera if believed is None else believed
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
        self.inner = inner_pixels(camera, keep)
        self.moved_points = int(np.diff(self.point_starts)[self.pairs[:, 0]].sum())
        self.joined = np.flatnonzero(segment[1:] == segment[:-1])
        self.weight = np.full(len(self.uv), 1.0 / settings.pixel_sigma**2)
        self.recorded = recorded
        self.expected = np.ones(self.n) if expected is None else expected
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
        off = (state.camera_off(self.believed) / self.camera_sigmas)[self.free]
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
