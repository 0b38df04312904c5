"""Bundle adjustment of all poses, each frame's tilt and the camera, with residuals in pixels.

An edge point of one frame is moved over the road into another frame, where it must lie on an edge. Its
distance across that edge is the residual. It is taken in pixels: in cm the cost falls as the scene shrinks.

Source:
    Triggs, McLauchlan, Hartley and Fitzgibbon 2000, "Bundle adjustment: a modern synthesis":
    Levenberg-Marquardt steps, a robust loss, and the camera eliminated last (Schur complement). Poses and
    camera are fitted to road edges instead of to points in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.slam.adjustment.problem import BundleProblem
from datagen.slam.adjustment.state import (
    CAMERA_NAMES,
    BundleEstimate,
    BundleSettings,
    BundleState,
    Observations,
)
from lanenet.geometry.camera import Camera

__all__ = ["CAMERA_NAMES", "BundleEstimate", "BundleResult", "BundleSettings", "Observations", "adjust"]

#: Share of the diagonal that is added to it. A bend of the whole drive hardly changes any one frame's
#: residuals: with 1e-4, an error that all turns have in common was still there after all rounds.
_DAMPING = 1e-8
#: Relative fall of the cost at which a round ends early. Chosen: it only saves
#: steps that change little.
_CONVERGED = 1e-5


@dataclass(frozen=True)
class BundleResult(BundleEstimate):
    """What the adjustment found.

    Attributes:
        sigma: Standard deviation of each of the camera's numbers (see ``CAMERA_NAMES``; focal relative); 0
            for those that were held.
        residual_px: Residuals of the last round.
        misfit: Mean robust loss over all compared points; one without an edge counts as if it had met one at
            the rim of its search. The lower, the better the frames agree.
        pairs: Number of pairs of frames.
    """

    sigma: dict[str, float]
    residual_px: Float[np.ndarray, "r"]
    misfit: float
    pairs: int

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
) -> BundleResult:
    """Adjust poses, tilts and the camera.

    Args:
        observed: What the frames show, and what was commanded.
        start: Estimate to start from, such as an earlier result; the height of its camera sets the scale and
            stays.
        settings: Priors and robustness.
        rng: Draws the edge points that are compared.
        free: Names of the camera's numbers that may change.
        loops: More pairs of frames that show the same place.
        prior_camera: Centre of the camera's priors; None for the camera of the start. Where each round starts
            from the result of the last one, the camera would otherwise drift away from what is known of it.

    Returns:
        The adjusted drive.
    """
    problem = BundleProblem(observed, start.camera, settings, rng, free, loops, prior_camera)
    state = BundleState.at(start)
    for gate_px in settings.gates_px:
        links = problem.associate(state, gate_px)
        damping = _DAMPING
        now = problem.equations(state, links)
        for _ in range(settings.iterations):
            trial = state.moved(now.step(damping), problem.free)
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
    sigma[problem.free] = now.camera_sigma()
    residual_px = now.residual_px
    unmatched = problem.compared - len(residual_px)
    at_rim, matched = (np.log1p((v / settings.cauchy_px) ** 2) for v in (gate_px, residual_px))
    misfit = (unmatched * at_rim + float(np.nansum(matched))) / max(problem.compared, 1)
    height = start.camera.mounting.height_cm
    return BundleResult(
        poses=state.poses * [height, height, 1.0],
        tilt=state.tilt,
        camera=state.camera_like(start.camera),
        sigma=dict(zip(CAMERA_NAMES, sigma.tolist(), strict=True)),
        residual_px=residual_px[np.isfinite(residual_px)],
        misfit=float(misfit),
        pairs=len(problem.pairs),
    )
