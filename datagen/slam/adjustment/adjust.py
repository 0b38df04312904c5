"""Bundle adjustment of all poses, each frame's tilt and the camera, with residuals in pixels.

An edge point of one frame is moved over the road into another frame, where it must lie on an edge. Its
distance across that edge is the residual. It is taken in pixels: in cm the cost falls as the scene shrinks.

The unknowns are five numbers per frame (x, y, heading, pitch, roll) and the camera's free numbers. With
residuals e, Jacobian J and weights W, a step solves H dx = -g, where H = J^T W J and g = J^T W e. H has a
sparse block of the frames, bordered by a few dense columns of the camera.

Source:
    Triggs, McLauchlan, Hartley and Fitzgibbon 2000, "Bundle adjustment: a modern synthesis":
    Levenberg-Marquardt steps, a robust loss, and the camera eliminated last (Schur complement). Poses and
    camera are fitted to road edges instead of to points in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from datagen.slam.adjustment.kernels import (
    N_CAMERA,
    N_FRAME,
    Links,
    Pixels,
    accumulate,
    associate,
    lift_points,
    link_scores,
)
from datagen.slam.adjustment.state import (
    CAMERA_NAMES,
    BundleEstimate,
    BundleSettings,
    BundleState,
    Observations,
)
from datagen.slam.commands import MOST_BRIDGED
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import wrap_angle
from lanenet.processes import in_threads

__all__ = ["CAMERA_NAMES", "BundleEstimate", "BundleResult", "BundleSettings", "Observations", "adjust"]

#: Share of the diagonal that is added to it. A bend of the whole drive hardly changes any one frame's
#: residuals: with 1e-4, an error that all turns have in common was still there after all rounds.
_DAMPING = 1e-8
#: Least diagonal that damping counts with, so that a number that nothing observes stays where it is: no
#: equation has it where the car was commanded to stand and no edge is seen. Ceres has the same default
#: (min_lm_diagonal).
_LEAST_DIAGONAL = 1e-6
#: The same where no step is taken. Chosen: far above rounding, far below what any frame is known by.
_AFLOAT = 1e-9
#: Relative fall of the cost at which a round ends early. Chosen: it only saves
#: steps that change little.
_CONVERGED = 1e-5
#: Shares of its frames in which a point meets an edge by chance, and in which it is taken for a mark on the
#: road; weight of a point below the first. Chosen between noise, which meets an edge now and then, and marks,
#: which meet one in nearly every image (tests/unit/slam/test_bundle.py); not zero, so that the system stays
#: determined.
_CHANCE, _SURE, _LEAST_TRUST = 0.4, 0.9, 0.02
#: Trust in a point that is in view of fewer than two frames, whose share says little. Chosen between the two.
_TRUST_ONCE = 0.3
#: Margin at the rim of the pixels in which edges are looked for, [px] for images 160 px wide: edges are found
#: with a kernel that reaches one pixel further.
_RIM_PX = 1.0
#: Image width for which settings in pixels are given: that of a Donkeycar tub.
_REFERENCE_WIDTH = 160.0
#: Commanded steps that are shorter than this share of the typical one count as this long: a car that hardly
#: moves says little about its gain.
_LEAST_STEP = 0.1
#: Parts into which the pairs of frames are cut for threads. Chosen: enough for the cores of a laptop.
_PARTS = 8
#: Numbers of a band of the equations up to which it is solved as one: 400 MB.
_MOST_BAND = 50_000_000
#: Sigmas of the change of step, in camera heights, and of turn, where frames come at uneven times. Chosen: as
#: much as a usual step, and a usual turn in a bend.
_UNEVEN_STEP, _UNEVEN_TURN_RAD = 0.2, 0.05
#: Sigma of the first pose, which only fixes the map: far below anything that is measured.
_FIXED_SIGMA = 1e-6

#: Rows of an image 160 px wide, and ways that an edge may face, that share an error of the edge detector.
#: Chosen: the width of a line in the image, and its blur, change little within ten rows.
_BAND_PX, _WAYS = 10.0, 8
#: Standard deviation of that error, for images 160 px wide: edges of eight simulated drives with all random
#: effects, their narrow lines set right (``datagen.slam.stripes``), lie 0.05 to 0.17 px beside the true
#: borders (RMS over the groups). Chosen: nearly the most, for looks that were not among them.
_EDGE_ERROR_PX = 0.15
#: Time in which a camera reads an image, as a share of that between two frames; the root of its mean square.
#: Chosen: rolling shutters take 0 to 30 ms, and frames come 20 times a second.
_READOUT = 0.35
#: Side of the squares of road whose residuals may have an error in common, in camera heights. Chosen: what
#: one frame sees best.
_STRETCH_HEIGHTS = 3.0

_Lifted = tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 8 2"], Float[np.ndarray, "m 2"]]


@dataclass(frozen=True)
class BundleResult(BundleEstimate):
    """What the adjustment found.

    Attributes:
        sigma: Standard deviation of each camera parameter (see ``CAMERA_NAMES``; focal relative); 0
            for those that were held.
        residual_px: Residuals of the last round.
        pairs: Pairs of frames that were compared, the frame whose points were moved first.
        in_view: Number of points of each pair that the other image shows.
        loss: Sum of their robust losses; a point without an edge counts as if it had met one at the rim of
            its search.
        prior: Negative log likelihood of the camera among those that the priors expect.
    """

    sigma: dict[str, float]
    residual_px: Float[np.ndarray, "r"]
    pairs: Int[np.ndarray, "p 2"]
    in_view: Int[np.ndarray, "p"]
    loss: Float[np.ndarray, "p"]
    prior: float = 0.0

    @property
    def misfit(self) -> float:
        """Mean robust loss per point in view: the lower, the better the frames agree.

        Pairs that face each other are left out: what one sees close by the other sees from afar, so that most
        of its points meet nothing.
        """
        same_way = np.abs(wrap_angle(np.diff(self.poses[:, 2][self.pairs], axis=1)[:, 0])) < 0.5 * np.pi
        return float(self.loss[same_way].sum() / max(int(self.in_view[same_way].sum()), 1))

    @property
    def robust_sd_px(self) -> float:
        """1.4826 times the median of the absolute residuals."""
        return 1.4826 * float(np.median(np.abs(self.residual_px))) if self.residual_px.size else float("nan")


def adjust(
    observed: Observations,
    start: BundleEstimate,
    settings: BundleSettings,
    rng: np.random.Generator,
    free: Sequence[str] = CAMERA_NAMES,
    loops: Sequence[tuple[int, int]] = (),
    prior_camera: Camera | None = None,
    with_sigma: bool = True,
) -> BundleResult:
    """Adjust poses, tilts and the camera.

    Args:
        observed: What the frames show, and what was commanded.
        start: Estimate to start from, such as an earlier result; the height of its camera sets the scale and
            stays.
        settings: Priors and robustness.
        rng: Draws the edge points that are compared.
        free: Names of the camera parameters that may change.
        loops: More pairs of frames that show the same place.
        prior_camera: Centre of the camera's priors; None for the camera of the start. Where each round starts
            from the result of the last one, the camera would otherwise drift away from what is known of it.
        with_sigma: Find the camera's sigmas, in a tenth of the time; otherwise they are 0.

    Returns:
        The adjusted drive.
    """
    problem = BundleProblem(observed, start.camera, settings, rng, free, loops, prior_camera)
    state = BundleState.at(start)
    for round_number, gate_px in enumerate(settings.gates_px, start=1):
        links = problem.associate(state, gate_px)
        damping = _DAMPING
        now = problem.equations(state, links)
        for left in reversed(range(settings.iterations)):
            trial = state.moved(now.step(damping), problem.free)
            if not left and round_number < len(settings.gates_px):
                # The next round meets other edges, and has other equations.
                state = trial if problem.cost(trial, links) < now.cost else state
                break
            new = problem.equations(trial, links)
            if new.cost < now.cost:
                converged = now.cost - new.cost < _CONVERGED * now.cost
                state, now = trial, new
                damping = max(damping * 0.3, 0.01 * _DAMPING)
                if converged:
                    break
            else:
                damping *= 100.0
    sigma = np.zeros(len(CAMERA_NAMES))
    if with_sigma:
        sigma[problem.free] = problem.camera_sigma(state, links, now)
    residual_px, count = now.residual_px, len(problem.pairs)
    at_rim, matched = (np.log1p((v / settings.cauchy_px) ** 2) for v in (gate_px, residual_px))
    unmatched = problem.in_view - np.bincount(links.pair, minlength=count)
    loss = unmatched * at_rim + np.bincount(links.pair, np.nan_to_num(matched), minlength=count)
    height = start.camera.mounting.height_cm
    return BundleResult(
        poses=state.poses * [height, height, 1.0],
        tilt=state.tilt,
        camera=state.camera_like(start.camera),
        sigma=dict(zip(CAMERA_NAMES, sigma.tolist(), strict=True)),
        residual_px=residual_px[np.isfinite(residual_px)],
        pairs=problem.pairs,
        in_view=problem.in_view,
        loss=loss,
        prior=problem.camera_prior(state),
    )


@dataclass(frozen=True)
class Equations:
    """Normal equations at a state.

    Attributes:
        cost: Robust cost there, priors included.
        frames: H between the frames' numbers.
        border: H between the frames' numbers and the camera's free ones.
        camera: H between the camera's free numbers.
        descent: -g, frames first.
        residual_px: Residual of each link; NaN where it has none.
    """

    cost: float
    frames: csc_matrix
    border: Float[np.ndarray, "u f"]
    camera: Float[np.ndarray, "f f"]
    descent: Float[np.ndarray, "v"]
    residual_px: Float[np.ndarray, "r"]

    def step(self, damping: float) -> Float[np.ndarray, "v"]:
        """Solve for a Levenberg-Marquardt step; the camera is eliminated last, by its Schur complement.

        Args:
            damping: Share of the diagonal that is added to it.
        """
        count = len(self.border)
        reduced = self.factorised(damping).solve(np.column_stack([self.descent[:count], self.border]))
        if not self.border.shape[1]:
            return np.asarray(reduced[:, 0])
        camera = self.camera + damping * np.diag(np.diag(self.camera))
        schur = camera - self.border.T @ reduced[:, 1:]
        found = np.linalg.solve(schur, self.descent[count:] - self.border.T @ reduced[:, 0])
        return np.concatenate([reduced[:, 0] - reduced[:, 1:] @ found, found])

    def factorised(self, damping: float) -> _Factorised:
        """Factorise H of the frames with a share of its diagonal added."""
        diagonal = np.maximum(self.frames.diagonal(), _LEAST_DIAGONAL)
        return _Factorised((self.frames + damping * diags(diagonal)).tocsc())

    def without_frames(self) -> tuple[Float[np.ndarray, "f f"], Float[np.ndarray, "u f"]]:
        """Return H of the camera with the frames eliminated, and how the frames follow the camera."""
        # A part of the drive that nothing joins to the others may lie anywhere.
        follow = -self.factorised(_AFLOAT).solve(self.border)
        return self.camera + self.border.T @ follow, follow


class _Factorised:
    """A symmetric positive definite matrix, ready for solving.

    Neighbouring frames and neighbouring laps make it a band, once the unknowns are in a suitable order. The
    band takes a fifth of the time of a sparse factorisation, but more memory.

    Source:
        Cuthill and McKee 1969, "Reducing the bandwidth of sparse symmetric matrices".
    """

    def __init__(self, matrix: csc_matrix) -> None:
        size = matrix.shape[0]
        self._order = reverse_cuthill_mckee(matrix, symmetric_mode=True)
        place = np.empty(size, np.int64)
        place[self._order] = np.arange(size)
        column = np.repeat(place, np.diff(matrix.indptr))
        below = place[matrix.indices] - column
        width = int(below.max(initial=0)) + 1
        self._band: Float[np.ndarray, "b v"] | None = None
        if width * size <= _MOST_BAND:
            lower = below >= 0
            band = np.zeros(width * size)
            band[column[lower] * width + below[lower]] = matrix.data[lower]
            # Singular but for rounding, where a part of the drive hangs together with no other.
            with suppress(LinAlgError):
                self._band = cholesky_banded(
                    band.reshape(size, width).T, overwrite_ab=True, lower=True, check_finite=False
                )
        if self._band is None:
            # No pivoting, and an order that suits symmetry.
            options = {"SymmetricMode": True}
            self._sparse = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)

    def solve(self, right: Float[np.ndarray, "v k"]) -> Float[np.ndarray, "v k"]:
        """Solve for some right-hand sides."""
        if self._band is None:
            return np.asarray(self._sparse.solve(right))
        found = np.empty_like(right)
        found[self._order] = cho_solve_banded((self._band, True), right[self._order], check_finite=False)
        return found


class BundleProblem:
    """Points, edges and pairs of frames, which stay; see :func:`adjust`.

    Attributes:
        pairs: Pairs of frames; points of the first are moved into the second.
        points: Pixels that are compared.
        edges: All edges, those of each frame sorted by row, as the kernels search them.
        free: Which of the camera parameters may change.
    """

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
        self.settings, self.observed, self.frames = settings, observed, len(observed.edges)
        self.scale = camera.width / _REFERENCE_WIDTH
        self.prior_camera = camera if prior_camera is None else prior_camera
        self.free = np.array([name in free for name in CAMERA_NAMES])
        found, self.edges = observed.pixels
        starts = found.starts
        chosen = [
            start + np.sort(rng.choice(count, min(count, settings.points), replace=False))
            for start, count in zip(starts[:-1], np.diff(starts), strict=True)
        ]
        point_starts = np.concatenate([[0], np.cumsum([len(c) for c in chosen])]).astype(np.int64)
        index = np.concatenate(chosen)
        self.points = Pixels(point_starts, found.uv[index], found.normals[index])
        periods = np.ones(self.frames) if observed.periods is None else observed.periods
        self.pairs = _pairs(settings.lags, np.cumsum(periods > MOST_BRIDGED), loops, rng)
        #: Unknowns of the two frames of each pair.
        self.unknowns = (N_FRAME * self.pairs[:, :, None] + np.arange(N_FRAME)).reshape(-1, 2 * N_FRAME)
        self.inner = inner_pixels(camera, observed.keep)
        #: Points of each pair that the other image shows, at the last association.
        self.in_view = np.zeros(len(self.pairs), np.int64)
        #: Comparisons of the pairs before each.
        self.compared_by = np.concatenate([[0], np.cumsum(np.diff(point_starts)[self.pairs[:, 0]])])
        self.weight = np.full(len(index), 1.0 / settings.pixel_sigma**2)
        self._lifted: tuple[BundleState, _Lifted] | None = None
        s, centre = settings, settings.centre_px * self.scale
        self.camera_sigmas = np.array([s.focal, centre, centre, s.k1, s.pitch, s.roll, s.yaw, s.lever])

    def lift(self, state: BundleState) -> _Lifted:
        """Lift the compared points to the road.

        Returns:
            The points (ahead of the rear axle, left); their Jacobian by the camera parameters; and points
            half a pixel further along the gradient.
        """
        if self._lifted is not None and self._lifted[0] is state:
            # Association and residuals start from the same state.
            return self._lifted[1]
        count = len(self.points.uv)
        lifted = np.empty((count, 2)), np.empty((count, N_CAMERA, 2)), np.empty((count, 2))
        parts = _parts(self.frames)
        list(in_threads(lambda part: lift_points(state, self.points, part, *lifted), parts))
        self._lifted = state, lifted
        return lifted

    def associate(self, state: BundleState, gate_px: float) -> Links:
        """Find the nearest edge of every compared point, and weigh the points by how often they have one."""
        lifted, _, half_px = self.lift(state)
        gate_px *= self.scale
        self.in_view[...] = 0

        def links_of(part: tuple[int, int]) -> tuple[Links, Int[np.ndarray, "2 m"]]:
            most = int(self.compared_by[part[1]] - self.compared_by[part[0]])
            links = Links(*(np.empty(most, dtype) for dtype in (np.int64, np.int64, np.int64, np.float64)))
            seen = np.zeros((2, len(self.points.uv)), np.int64)
            count = associate(
                state, self.pairs, part, self.points, lifted, half_px, self.edges,
                gate_px, self.inner, seen, self.in_view, links,
            )  # fmt: skip
            return Links(*(column[:count] for column in links)), seen

        found = list(in_threads(links_of, _parts(len(self.pairs))))
        in_view, matched = sum((seen for _, seen in found[1:]), found[0][1])
        self.weight = point_trust(in_view, matched) / self.settings.pixel_sigma**2
        return Links(*(np.concatenate(columns) for columns in zip(*(one for one, _ in found), strict=True)))

    def equations(self, state: BundleState, links: Links) -> Equations:
        """Build the normal equations of all residuals and priors."""
        free, both, count = self.free, 2 * N_FRAME, N_FRAME * self.frames
        size, pairs = both + int(free.sum()), len(self.pairs)
        blocks, descents = np.zeros((pairs, size, size)), np.zeros((pairs, size))
        cost, residual_px = self._add_up(state, links, blocks, descents)
        prior_cost, prior, prior_descent = frame_priors(state, self.settings, self.observed)
        at = self.unknowns.ravel()
        border = [np.bincount(at, blocks[:, :both, k].ravel(), minlength=count) for k in range(both, size)]
        off = (state.camera_minus(self.prior_camera) / self.camera_sigmas)[free]
        camera = blocks[:, both:, both:].sum(axis=0)
        camera_descent = descents[:, both:].sum(axis=0) - off / self.camera_sigmas[free]
        frames_descent = np.bincount(at, descents[:, :both].ravel(), minlength=count) + prior_descent
        return Equations(
            cost=cost + prior_cost + 0.5 * float(off @ off),
            frames=(sum_blocks(self.unknowns, blocks[:, :both, :both], count) + prior).tocsc(),
            border=np.stack(border, axis=1) if border else np.empty((count, 0)),
            camera=camera + np.diag(self.camera_sigmas[free] ** -2.0),
            descent=np.concatenate([frames_descent, camera_descent]),
            residual_px=residual_px,
        )

    def camera_prior(self, state: BundleState) -> float:
        """Return the cost of the prior on the camera, also of its numbers that are held."""
        off = state.camera_minus(self.prior_camera) / self.camera_sigmas
        return 0.5 * float(off @ off)

    def cost(self, state: BundleState, links: Links) -> float:
        """Return the cost of all residuals and priors, in a third of the time of the equations."""
        size = 2 * N_FRAME + int(self.free.sum())
        cost, _ = self._add_up(state, links, np.empty((0, size, size)), np.empty((0, size)))
        prior_cost, _, _ = frame_priors(state, self.settings, self.observed)
        off = (state.camera_minus(self.prior_camera) / self.camera_sigmas)[self.free]
        return cost + prior_cost + 0.5 * float(off @ off)

    def _add_up(
        self,
        state: BundleState,
        links: Links,
        blocks: Float[np.ndarray, "p u u"],
        descents: Float[np.ndarray, "p u"],
    ) -> tuple[float, Float[np.ndarray, "r"]]:
        """Fill the blocks of all pairs, see :func:`accumulate`; return cost and residuals of the links."""
        lifted, lifted_by, _ = self.lift(state)
        residual_px = np.empty(len(links.point))
        starts, free = self._starts(links), np.flatnonzero(self.free)

        def cost_of(part: tuple[int, int]) -> float:
            return accumulate(
                state, self.pairs, part, self.edges, lifted, lifted_by, links, starts,
                self.weight, self.settings.cauchy_px, free, blocks, descents, residual_px,
            )  # fmt: skip

        return sum(in_threads(cost_of, _parts(len(self.pairs)))), residual_px

    def camera_sigma(self, state: BundleState, links: Links, now: Equations) -> Float[np.ndarray, "f"]:
        """Return the sigmas of the camera's free numbers, with all other unknowns free too.

        Residuals are not independent. The same tape errs alike in each frame that shows it: scores are added
        up over stretches of road before they are squared. And an edge is found a little off wherever the same
        part of the image shows a line that faces the same way, in all frames alike: the camera takes on most
        of such an error, so that no residual shows it. What is known of the edge detector takes its place. A
        rolling shutter is such an error too: low rows, read last, show the road as from further ahead, which
        looks like another pitch.

        Args:
            state: The solution.
            links: Of its last round.
            now: The equations there.

        Source:
            Variance H^-1 M H^-1 with scores in groups: Liang and Zeger 1986, "Longitudinal data analysis
            using generalized linear models", Biometrika 73. Errors that are not estimated: the "consider"
            analysis of Schmidt 1966, "Application of state-space methods to navigation problems".
        """
        free = self.free
        if not free.any():
            return np.zeros(0)
        information, follow = now.without_frames()
        through = np.zeros((len(follow), N_CAMERA))
        through[:, free] = follow
        lifted, lifted_by, _ = self.lift(state)
        starts = self._starts(links)
        by_link = np.zeros((len(links.point), N_CAMERA))

        def fill(part: tuple[int, int]) -> None:
            link_scores(
                state, self.pairs, part, self.edges, lifted, lifted_by, links, starts,
                self.weight, self.settings.cauchy_px, through, by_link,
            )  # fmt: skip

        list(in_threads(fill, _parts(len(self.pairs))))
        columns = by_link[:, free].T

        def scores(errors_px: Float[np.ndarray, "r"], groups: Int[np.ndarray, "r"], count: int) -> np.ndarray:
            return np.stack([np.bincount(groups, errors_px * one, count) for one in columns], axis=1)

        cells = np.floor(state.poses[:, :2] / _STRETCH_HEIGHTS)
        squares, square_of = np.unique(cells, axis=0, return_inverse=True)
        stretches = square_of.ravel()[self.pairs[links.pair, 0]]
        by_road = scores(np.nan_to_num(now.residual_px), stretches, len(squares))
        count = _WAYS * (int(self.inner.shape[0] / (_BAND_PX * self.scale)) + 1)
        stretch = np.sqrt(np.maximum(2.0 * links.sigma**2 - 1.0, 0.0))  # of an error of the point
        by_image = scores(np.ones_like(stretch), self._image_groups(self.edges, links.edge), count)
        by_image -= scores(stretch, self._image_groups(self.points, links.point), count)
        by_image *= _EDGE_ERROR_PX * self.scale
        all_alike = np.zeros(len(stretch), np.int64)
        at_edges, at_points = self._readout_px(state, self.edges, self.points)
        by_readout = scores(at_edges[links.edge], all_alike, 1)
        by_readout -= scores(stretch * at_points[links.point], all_alike, 1)
        errors = np.concatenate([by_road, by_image, by_readout])
        spread = errors.T @ errors + np.diag(self.camera_sigmas[free] ** -2.0)
        inverse = np.linalg.inv(information)
        return np.sqrt(np.maximum(np.diag(inverse @ spread @ inverse), 0.0))

    def _starts(self, links: Links) -> Int[np.ndarray, "p1"]:
        """First link of each pair, and one behind the last."""
        return np.searchsorted(links.pair, np.arange(len(self.pairs) + 1))

    def _readout_px(self, state: BundleState, *kinds: Pixels) -> list[Float[np.ndarray, "m"]]:
        """Return how far off each of some pixels may be along its gradient, since low rows are read later."""
        camera = state.camera_like(self.prior_camera)
        height, width = self.inner.shape
        v, u = np.mgrid[:height, :width].astype(np.float64)
        whole = np.stack([u.ravel(), v.ravel()], axis=1)
        step_heights = float(np.median(np.hypot(*np.diff(state.poses[:, :2], axis=0).T)))
        ahead_cm = _READOUT * step_heights * camera.mounting.height_cm * whole[:, 1] / height
        road = camera.intersect_ground(whole)
        road[:, 1] += ahead_cm
        moved = np.nan_to_num(camera.project_ground(road) - whole)
        found = []
        for pixels in kinds:
            nearest = np.rint(pixels.uv).astype(np.intp)
            at = np.clip(nearest[:, 1], 0, height - 1) * width + np.clip(nearest[:, 0], 0, width - 1)
            found.append(np.sum(moved[at] * pixels.normals, axis=1))
        return found

    def _image_groups(self, pixels: Pixels, chosen: Int[np.ndarray, "r"]) -> Int[np.ndarray, "r"]:
        """Group edges that lie in one band of the image and face the same way."""
        uv, normals = pixels.uv[chosen], pixels.normals[chosen]
        band = (uv[:, 1] / (_BAND_PX * self.scale)).astype(np.int64)
        way = np.arctan2(normals[:, 1], normals[:, 0]) / (2.0 * np.pi / _WAYS)
        return band * _WAYS + np.rint(way).astype(np.int64) % _WAYS


def _parts(count: int) -> list[tuple[int, int]]:
    """Cut a range into parts for threads: always the same ones, since a sum depends on its order."""
    ends = np.linspace(0, count, _PARTS + 1).astype(int).tolist()
    return list(pairwise(ends))


def sum_blocks(unknowns: Int[np.ndarray, "p k"], blocks: Float[np.ndarray, "p k k"], size: int) -> csc_matrix:
    """Add up small dense blocks in a sparse matrix, each at the rows and columns of its unknowns."""
    rows = np.broadcast_to(unknowns[:, :, None], blocks.shape)
    columns = np.broadcast_to(unknowns[:, None, :], blocks.shape)
    return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsc()


def frame_priors(
    state: BundleState, settings: BundleSettings, observed: Observations
) -> tuple[float, csc_matrix, Float[np.ndarray, "u"]]:
    """What is assumed of the frames: they are nearly level, and the car rolls on arcs that change slowly.

    Args:
        state: Where to linearise.
        settings: Sigmas.
        observed: What was commanded.

    Returns:
        Cost, H and -g of the priors by the frames' numbers.
    """
    s, n = settings, len(state.poses)
    periods = np.ones(n) if observed.periods is None else observed.periods
    uneven = np.zeros(n, dtype=bool) if observed.uneven is None else observed.uneven
    # Nothing is assumed across a long gap.
    j = np.flatnonzero(periods[1:] <= MOST_BRIDGED) + 1
    i = j - 1
    own = N_FRAME * np.arange(n)[:, None]
    step_at = np.concatenate(
        [N_FRAME * i[:, None] + np.arange(3), N_FRAME * j[:, None] + np.arange(3)], axis=1
    )
    # On an arc the rear axle moves along the heading at half of the turn. The motion along and across it,
    # with Jacobians by both poses:
    c, si = np.cos(state.poses[i, 2]), np.sin(state.poses[i, 2])
    dx, dy = (state.poses[j] - state.poses[i])[:, :2].T
    ahead, left = c * dx + si * dy, c * dy - si * dx
    turn = state.poses[j, 2] - state.poses[i, 2]
    half, middle = 0.5 * turn, state.poses[i, 2] + 0.5 * turn
    along = np.cos(half) * ahead + np.sin(half) * left
    across = np.cos(half) * left - np.sin(half) * ahead
    cm, sm = np.cos(middle), np.sin(middle)
    along_by = np.stack([-cm, -sm, 0.5 * across, cm, sm, 0.5 * across], axis=1)
    across_by = np.stack([sm, -cm, -0.5 * along, -sm, cm, -0.5 * along], axis=1)
    turn_by = np.broadcast_to([0.0, 0.0, -1.0, 0.0, 0.0, 1.0], along_by.shape)
    # Neighbouring steps: a is followed by b.
    a = np.flatnonzero(j[:-1] == i[1:])
    b = a + 1
    both_at = np.concatenate([step_at[b], step_at[a]], axis=1)
    # Steps per commanded step; nothing is assumed of steps for which the car was commanded to stand.
    commanded = (np.ones(n) if observed.relative_steps is None else observed.relative_steps)[j]
    per = np.where(commanded > 0.0, 1.0 / np.maximum(commanded, _LEAST_STEP), 0.0)
    per_a, per_b = per[a] * (per[b] > 0.0), per[b] * (per[a] > 0.0)
    speed_by = np.concatenate([per_b[:, None] * along_by[b], -per_a[:, None] * along_by[a]], axis=1)
    # Over a gap the turn spreads over its time, and all is less sure.
    time = periods[j]
    longer = np.maximum(time[a], time[b])
    rate = (1.0 / time)[:, None]
    either = uneven[j[a]] | uneven[j[b]]
    speed_sigma = np.where(either, _UNEVEN_STEP, s.speed_change * longer)
    turn_sigma = np.where(either, _UNEVEN_TURN_RAD, s.turn_change * np.sqrt(longer))
    # Each prior: residual, sigma, and the unknowns that it depends on with the Jacobian by them.
    priors = [
        (state.tilt[:, 0], s.frame_pitch, own + 3, np.ones((n, 1))),
        (state.tilt[:, 1], s.frame_roll, own + 4, np.ones((n, 1))),
        (across, s.slip * time**1.5, step_at, across_by),
        (per_b * along[b] - per_a * along[a], speed_sigma, both_at, speed_by),
        (
            turn[b] / time[b] - turn[a] / time[a],
            turn_sigma,
            both_at,
            np.concatenate([rate[b] * turn_by[b], -rate[a] * turn_by[a]], axis=1),
        ),
        (np.zeros(3), _FIXED_SIGMA, np.arange(3)[:, None], np.ones((3, 1))),
    ]
    known = np.flatnonzero(commanded >= _LEAST_STEP) if observed.speed_recorded else np.zeros(0, np.int64)
    if known.size:
        # The gain of the speed is that of the median step: what all steps share is left to the images.
        gain = max(float(np.median(per[known] * along[known])), 1e-6)
        share = per[known] / gain
        priors.append(
            (share * along[known] - 1.0, s.recorded_speed, step_at[known], share[:, None] * along_by[known])
        )
    e = np.concatenate([residual / sigma for residual, sigma, _, _ in priors])
    counts = np.concatenate([np.full(len(columns), columns.shape[1]) for _, _, columns, _ in priors])
    values = np.concatenate([(by.T / sigma).T.ravel() for _, sigma, _, by in priors])
    columns = np.concatenate([at.ravel() for _, _, at, _ in priors])
    jacobian = coo_matrix(
        (values, (np.repeat(np.arange(len(e)), counts), columns)), shape=(len(e), N_FRAME * n)
    ).tocsc()
    return 0.5 * float(e @ e), (jacobian.T @ jacobian).tocsc(), -(jacobian.T @ e)


def _pairs(
    lags: Sequence[int],
    segment: Int[np.ndarray, "n"],
    loops: Sequence[tuple[int, int]],
    rng: np.random.Generator,
) -> Int[np.ndarray, "p 2"]:
    """Pairs of frames of one segment, a lag apart, and those of loops in both directions."""
    pairs = []
    for lag in lags:
        i = np.arange(len(segment) - lag)
        i = i[segment[i] == segment[i + lag]]
        # Forwards or backwards: points that leave the view in one direction stay in view in the other.
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
    return np.asarray(rim_px > _RIM_PX * camera.width / _REFERENCE_WIDTH)


def point_trust(in_view: Int[np.ndarray, "m"], matched: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Return the trust in each compared point, from the share of frames in which it met an edge.

    Noise meets an edge by chance, wherever it is moved, and its residual only says that all may stay as it
    is. A mark on the road is met again in nearly every image.

    Args:
        in_view: In how many frames each point fell into the inner pixels.
        matched: In how many of them it met an edge.
    """
    share = matched / np.maximum(in_view, 1)
    trust = np.clip((share - _CHANCE) / (_SURE - _CHANCE), _LEAST_TRUST, 1.0)
    return np.where(in_view >= 2, trust, np.minimum(trust, _TRUST_ONCE))
