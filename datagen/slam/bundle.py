"""Bundle adjustment: all poses, each frame's tilt and the camera together, residuals in pixels.

An edge point of one frame, moved over the road into another frame, must lie on an edge of that frame. The
distance across that edge is the residual; in pixels, because in centimetres the best scene is a small one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from datagen.slam.bundle_kernels import N_CAMERA, N_FRAME, accumulate, associate, lift_points
from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.perception.edges import EdgePixels

#: Names of the camera's adjustable numbers, in the order of the kernels.
CAMERA_NAMES = ("focal", "cx", "cy", "k1", "pitch", "roll", "yaw", "lever")
#: Shares of pictures in which a point meets an edge by chance, and in which one of the road does.
_CHANCE, _SURE, _LEAST_TRUST = 0.4, 0.9, 0.02
#: Share added to the diagonal. A drive bends as a whole by next to nothing in any one frame: with 1e-4 an
#: error of every turn alike is still there after all rounds.
_DAMPING = 1e-8
_STEPS = np.array([1e-4, 1e-2, 1e-2, 1e-4, 1e-5, 1e-5, 1e-5, 1e-4])


class BundleSettings(Settings):
    """Priors and robustness; lengths in camera heights, angles in radians.

    Attributes:
        lags: Frames between the frames of a pair.
        points: Edge points per frame that are moved.
        gates_px: Radius of the search for the edge, one per round of association.
        iterations: Steps per round.
        cauchy_px: Residual at which the robust loss sets in.
        pixel_sigma: Standard deviation of a residual, with all that makes neighbours alike.
        focal: Relative standard deviation of the focal length's prior.
        centre_px: Of the principal point, for images of 160 px.
        k1: Of the first coefficient of the lens.
        pitch: Of the mounting's pitch.
        roll: Of the mounting's roll.
        yaw: Of the mounting's yaw.
        lever: Of the camera's place ahead of the rear axle.
        frame_pitch: Of each frame's pitch about the mounting's.
        frame_roll: Of each frame's roll.
        slip: Of the rear axle's sideways motion per frame.
        speed_change: Of the change of the way per frame, from one frame to the next, against the commanded.
        turn_change: Of the change of turn per frame, from one frame to the next.
    """

    lags: tuple[int, ...] = (1, 4, 9, 14)
    points: int = Field(default=60, ge=10)
    gates_px: tuple[float, ...] = (5.0, 4.0, 3.0, 2.5, 2.5)
    iterations: int = Field(default=2, ge=1)
    cauchy_px: float = Field(default=0.7, gt=0.0)
    pixel_sigma: float = Field(default=2.0, gt=0.0)
    focal: float = Field(default=0.3, gt=0.0)
    centre_px: float = Field(default=1.0, gt=0.0)
    k1: float = Field(default=0.03, gt=0.0)
    pitch: float = Field(default=0.2, gt=0.0)
    roll: float = Field(default=0.02, gt=0.0)
    yaw: float = Field(default=0.1, gt=0.0)
    lever: float = Field(default=0.4, gt=0.0)
    frame_pitch: float = Field(default=0.012, gt=0.0)
    frame_roll: float = Field(default=0.006, gt=0.0)
    slip: float = Field(default=0.004, gt=0.0)
    speed_change: float = Field(default=0.003, gt=0.0)
    turn_change: float = Field(default=0.01, gt=0.0)


@dataclass(frozen=True)
class BundleResult:
    """What the adjustment found.

    Attributes:
        poses: Rear-axle poses, frame map, in the camera's unit of length.
        tilt: Pitch and roll of each frame beyond the camera's, [rad].
        camera: The adjusted camera.
        sigma: Standard deviation of each of the camera's numbers (see ``CAMERA_NAMES``; focal relative).
        residual_px: Residuals of the last round.
        misfit: Mean robust loss over all points that were moved; one that met no edge counts as if it had
            met one at the rim of its search. The lower, the better the frames agree.
        pairs: Number of pairs of frames.
    """

    poses: Float[np.ndarray, "n 3"]
    tilt: Float[np.ndarray, "n 2"]
    camera: Camera
    sigma: dict[str, float]
    residual_px: Float[np.ndarray, "r"]
    misfit: float
    pairs: int

    @property
    def robust_sd_px(self) -> float:
        """1.4826 times the median of the absolute residuals."""
        return 1.4826 * float(np.median(np.abs(self.residual_px))) if self.residual_px.size else float("nan")


def adjust(
    edges: Sequence[EdgePixels],
    poses: Float[np.ndarray, "n 3"],
    camera: Camera,
    settings: BundleSettings,
    rng: np.random.Generator,
    free: Sequence[str] = CAMERA_NAMES,
    loops: Sequence[tuple[int, int]] = (),
    tilt: Float[np.ndarray, "n 2"] | None = None,
    breaks: Bool[np.ndarray, "n"] | None = None,
    expected: Float[np.ndarray, "n"] | None = None,
    believed: Camera | None = None,
) -> BundleResult:
    """Adjust poses, tilts and the camera.

    Args:
        edges: Edge pixels per frame, only such that see the road.
        poses: Start, rear axle, [cm], frame map.
        camera: Start; its height sets the scale and stays.
        settings: Priors.
        rng: Draws the points that are moved.
        free: Names of the camera's numbers that may change.
        loops: More pairs of frames that show the same place.
        tilt: Start of the frames' tilts; None for level.
        breaks: Frames that do not follow the one before them.
        expected: Commanded way from the frame before, 1 where it is usual; None for the same all along.
        believed: Camera about which the priors lie; None for the start. Rounds that each begin where the one
            before ended would walk away from it otherwise.

    Returns:
        The adjusted drive.
    """
    problem = _Problem(edges, camera, settings, rng, free, loops, breaks, expected)
    problem.prior = _numbers_of(camera if believed is None else believed)
    height = camera.mounting.height_cm
    state = problem.start(poses / [height, height, 1.0], tilt)
    for gate_px in settings.gates_px:
        links = problem.associate(state, gate_px)
        damping = _DAMPING
        cost, normal, rhs, residual = problem.equations(state, links)
        for _ in range(settings.iterations):
            trial = problem.moved(state, problem.solve(normal, rhs, damping))
            new = problem.equations(trial, links)
            if new[0] < cost:
                done = cost - new[0] < 1e-5 * cost
                state, (cost, normal, rhs, residual) = trial, new
                damping = max(damping * 0.3, 0.01 * _DAMPING)
                if done:
                    break
            else:
                damping *= 100.0
    sigma = problem.camera_sigma(normal)
    lost = problem.moved_points - len(residual)
    at_rim, seen = (np.log1p((v / settings.cauchy_px) ** 2) for v in (gate_px, residual))
    misfit = (lost * at_rim + float(np.nansum(seen))) / max(problem.moved_points, 1)
    return BundleResult(
        poses=state.poses * [height, height, 1.0],
        tilt=state.tilt,
        camera=problem.camera_of(state),
        sigma=dict(zip(CAMERA_NAMES, sigma.tolist(), strict=True)),
        residual_px=residual[np.isfinite(residual)],
        misfit=float(misfit),
        pairs=len(problem.pairs),
    )


@dataclass(frozen=True)
class _State:
    poses: Float[np.ndarray, "n 3"]
    tilt: Float[np.ndarray, "n 2"]
    lens: Float[np.ndarray, "9"]
    mount: Float[np.ndarray, "5"]


@dataclass(frozen=True)
class _Links:
    """Which point meets which edge, sorted by pair."""

    point: Int[np.ndarray, "r"]
    edge: Int[np.ndarray, "r"]
    sigma: Float[np.ndarray, "r"]
    pair_starts: Int[np.ndarray, "p1"]


def _numbers_of(camera: Camera) -> tuple[Float[np.ndarray, "9"], Float[np.ndarray, "5"]]:
    """A camera as the kernels take it: lens, and mounting with lengths in camera heights."""
    m = camera.mounting
    D = np.concatenate([camera.D, np.zeros(5)])[:5]
    lens = np.array([camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *D])
    lever = (m.ahead_of_front_axle_cm + camera.wheelbase_cm) / m.height_cm
    mount = np.array([m.pitch_down_rad, m.roll_rad, m.yaw_rad, lever, -m.right_of_centre_cm / m.height_cm])
    return lens, mount


class _Problem:
    prior: tuple[Float[np.ndarray, "9"], Float[np.ndarray, "5"]]

    def __init__(
        self,
        edges: Sequence[EdgePixels],
        camera: Camera,
        settings: BundleSettings,
        rng: np.random.Generator,
        free: Sequence[str],
        loops: Sequence[tuple[int, int]],
        breaks: Bool[np.ndarray, "n"] | None,
        expected: Float[np.ndarray, "n"] | None = None,
    ) -> None:
        self.settings, self.camera, self.n = settings, camera, len(edges)
        self.fisheye = camera.model == "fisheye"
        self.free = np.array([name in free for name in CAMERA_NAMES])
        # The frames' own tilts need the derivatives by pitch and roll in any case.
        self.active = self.free | np.isin(CAMERA_NAMES, ("pitch", "roll"))
        counts = np.array([len(e.uv_px) for e in edges])
        self.edge_starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.edge_uv = np.concatenate([e.uv_px for e in edges]).astype(np.float64)
        self.edge_normals = np.concatenate([e.normals for e in edges]).astype(np.float64)
        chosen = [
            start + np.sort(rng.choice(count, min(count, settings.points), replace=False))
            for start, count in zip(self.edge_starts[:-1], counts, strict=True)
        ]
        self.point_starts = np.concatenate([[0], np.cumsum([len(c) for c in chosen])]).astype(np.int64)
        index = np.concatenate(chosen)
        self.uv, self.normals = self.edge_uv[index], self.edge_normals[index]
        self.frame = np.repeat(np.arange(self.n), np.diff(self.point_starts))
        segment = np.zeros(self.n, int) if breaks is None else np.cumsum(breaks)
        pairs = []
        for lag in settings.lags:
            i = np.arange(self.n - lag)
            i = i[segment[i] == segment[i + lag]]
            # Back and forth: points that leave the view one way are seen the other way.
            back = rng.random(len(i)) < 0.5
            pairs.append(np.where(back[:, None], np.stack([i + lag, i], 1), np.stack([i, i + lag], 1)))
        both = [(a, b) for a, b in loops] + [(b, a) for a, b in loops]
        pairs.append(np.array(both, dtype=np.int64).reshape(-1, 2))
        self.pairs = np.concatenate(pairs).astype(np.int64)
        self.moved_points = int(np.diff(self.point_starts)[self.pairs[:, 0]].sum())
        self.joined = np.flatnonzero(segment[1:] == segment[:-1])
        self.weight = np.full(len(self.uv), 1.0 / settings.pixel_sigma**2)
        self.expected = np.ones(self.n) if expected is None else expected
        scale = camera.width / 160.0
        s = settings
        self.camera_sigmas = np.array(
            [s.focal, s.centre_px * scale, s.centre_px * scale, s.k1, s.pitch, s.roll, s.yaw, s.lever]
        )

    def start(self, poses: np.ndarray, tilt: np.ndarray | None) -> _State:
        lens, mount = _numbers_of(self.camera)
        return _State(poses, np.zeros((self.n, 2)) if tilt is None else tilt, lens, mount)

    def camera_of(self, state: _State) -> Camera:
        c, lens, mount = self.camera, state.lens, state.mount
        K = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
        ahead = mount[3] * c.mounting.height_cm - c.wheelbase_cm
        mounting = replace(
            c.mounting,
            pitch_down_rad=float(mount[0]),
            roll_rad=float(mount[1]),
            yaw_rad=float(mount[2]),
            ahead_of_front_axle_cm=float(ahead),
        )
        D = np.array(c.D, dtype=np.float64)
        D[0] = lens[4]
        return replace(c, K=K, D=D, mounting=mounting)

    def _lift(self, state: _State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        out, normal = np.empty((len(self.uv), 2)), np.empty((len(self.uv), 2))
        by = np.zeros((len(self.uv), N_CAMERA, 2))
        lift_points(
            self.fisheye,
            state.lens,
            state.mount,
            state.tilt,
            self.frame,
            self.uv,
            self.normals,
            _STEPS,
            self.active,
            out,
            by,
            normal,
        )
        return out, by, normal

    def associate(self, state: _State, gate_px: float) -> _Links:
        lifted, _, normal = self._lift(state)
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
            0.8,
            self.camera.width,
            self.camera.height,
            in_view,
            matched,
            point,
            edge,
            pair,
            sigma,
        )
        self.weight = point_trust(in_view, matched) / self.settings.pixel_sigma**2
        starts = np.searchsorted(pair[:count], np.arange(len(self.pairs) + 1))
        return _Links(point[:count], edge[:count], sigma[:count], starts.astype(np.int64))

    def equations(self, state: _State, links: _Links) -> tuple[float, csc_matrix, np.ndarray, np.ndarray]:
        lifted, by, _ = self._lift(state)
        size = 2 * N_FRAME + N_CAMERA
        blocks, rhs = np.zeros((len(self.pairs), size, size)), np.zeros((len(self.pairs), size))
        residual = np.empty(len(links.point))
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
            _STEPS,
            self.active,
            self.settings.cauchy_px,
            blocks,
            rhs,
            residual,
        )
        unknowns = N_FRAME * self.n + N_CAMERA
        i, j = (N_FRAME * self.pairs[:, k, None] + np.arange(N_FRAME) for k in (0, 1))
        last = np.broadcast_to(N_FRAME * self.n + np.arange(N_CAMERA), (len(self.pairs), N_CAMERA))
        where = np.concatenate([i, j, last], axis=1)
        rows = np.broadcast_to(where[:, :, None], blocks.shape)
        columns = np.broadcast_to(where[:, None, :], blocks.shape)
        normal = coo_matrix(
            (blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(unknowns, unknowns)
        ).tocsc()
        b = np.bincount(where.ravel(), rhs.ravel(), minlength=unknowns)
        prior_cost, jac, e = self._priors(state)
        return cost + prior_cost, (normal + jac.T @ jac).tocsc(), b - jac.T @ e, residual

    def _priors(self, state: _State) -> tuple[float, csc_matrix, np.ndarray]:
        """Weighted residuals and derivatives of what is believed without looking at the pictures."""
        s, n = self.settings, self.n
        rows: list[np.ndarray] = []
        columns: list[np.ndarray] = []
        values: list[np.ndarray] = []
        errors: list[np.ndarray] = []
        count = 0

        def add(error: np.ndarray, sigma: float | np.ndarray, *terms: tuple[np.ndarray, np.ndarray]) -> None:
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
        i, j = self.joined, self.joined + 1
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
        per = np.where(self.expected[j] > 0.0, 1.0 / np.maximum(self.expected[j], 0.1), 0.0)
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
        add(turn[b] - turn[a], s.turn_change, (tj[b], one[b]), (ti[b], -2.0 * one[b]), (ti[a], one[a]))
        # The first pose stays; camera priors, hard where a number is not free.
        add(np.zeros(3), 1e-6, (np.arange(3), np.ones(3)))
        camera_sigma = np.where(self.free, self.camera_sigmas, 1e-9)
        lens, mount = self.prior
        off = np.array(
            [
                np.log(state.lens[0] / lens[0]),
                *(state.lens[2:5] - lens[2:5]),
                *(state.mount[:4] - mount[:4]),
            ]
        )
        add(off, camera_sigma, (N_FRAME * n + np.arange(N_CAMERA), np.ones(N_CAMERA)))
        e = np.concatenate(errors)
        jac = coo_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
            shape=(count, N_FRAME * n + N_CAMERA),
        ).tocsc()
        return 0.5 * float(e @ e), jac, e

    def solve(self, normal: csc_matrix, rhs: np.ndarray, damping: float) -> np.ndarray:
        """Solve with the camera's few dense columns eliminated last."""
        damped = (normal + damping * diags(normal.diagonal())).tocsc()
        k = N_FRAME * self.n
        factor = _factorised(damped[:k, :k])
        border = damped[:k, k:].toarray()
        reduced = factor.solve(np.column_stack([rhs[:k], border]))
        schur = damped[k:, k:].toarray() - border.T @ reduced[:, 1:]
        camera = np.linalg.solve(schur, rhs[k:] - border.T @ reduced[:, 0])
        return np.concatenate([reduced[:, 0] - reduced[:, 1:] @ camera, camera])

    def camera_sigma(self, normal: csc_matrix) -> Float[np.ndarray, "8"]:
        """Standard deviations of the camera's numbers when all else is free."""
        k = N_FRAME * self.n
        border = normal[:k, k:].toarray()
        schur = normal[k:, k:].toarray() - border.T @ _factorised(normal[:k, :k]).solve(border)
        return np.sqrt(np.maximum(np.diag(np.linalg.inv(schur)), 0.0))

    def moved(self, state: _State, step: np.ndarray) -> _State:
        frames = step[: N_FRAME * self.n].reshape(self.n, N_FRAME)
        camera = np.where(self.free, step[N_FRAME * self.n :], 0.0)
        lens, mount = state.lens.copy(), state.mount.copy()
        lens[:2] *= np.exp(camera[0])
        lens[2:5] += camera[1:4]
        mount[:4] += camera[4:8]
        return _State(state.poses + frames[:, :3], state.tilt + frames[:, 3:], lens, mount)


def point_trust(in_view: Int[np.ndarray, "m"], matched: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Trust in each moved point by how often it met an edge.

    Noise meets an edge by chance, wherever it is moved; its residual then only says that all may stay as it
    is. What is on the road is met again in nearly every picture.
    """
    share = matched / np.maximum(in_view, 1)
    trust = np.clip((share - _CHANCE) / (_SURE - _CHANCE), _LEAST_TRUST, 1.0)
    return np.where(in_view >= 2, trust, np.minimum(trust, 0.3))


def _factorised(matrix: csc_matrix) -> SuperLU:
    """Factors of a positive definite matrix: no pivoting, and an order that suits symmetry."""
    return splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
