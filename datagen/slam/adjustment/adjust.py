"""Bundle adjustment: all poses, each frame's tilt and the camera together, residuals in pixels.

An edge point of one frame, moved over the road into another frame, must lie on an edge of that frame. The
distance across that edge is the residual; in pixels, because in centimetres the best scene is a small one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.slam.adjustment.problem import BundleProblem, Observations
from datagen.slam.adjustment.state import CAMERA_NAMES, BundleEstimate, BundleSettings, start_state
from lanenet.geometry.camera import Camera

__all__ = ["CAMERA_NAMES", "BundleEstimate", "BundleResult", "BundleSettings", "Observations", "adjust"]

#: Share added to the diagonal. A drive bends as a whole by next to nothing in any one frame: with 1e-4 an
#: error of every turn alike is still there after all rounds.
_DAMPING = 1e-8


@dataclass(frozen=True)
class BundleResult(BundleEstimate):
    """What the adjustment found.

    Attributes:
        sigma: Standard deviation of each of the camera's numbers (see ``CAMERA_NAMES``; focal relative); 0
            of those that stayed.
        residual_px: Residuals of the last round.
        misfit: Mean robust loss over all points that were moved; one that met no edge counts as if it had
            met one at the rim of its search. The lower, the better the frames agree.
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
    camera = start.camera
    problem = BundleProblem(observed, camera, settings, rng, free, loops, prior_camera)
    height = camera.mounting.height_cm
    state = start_state(start)
    for gate_px in settings.gates_px:
        links = problem.associate(state, gate_px)
        damping = _DAMPING
        now = problem.equations(state, links)
        for _ in range(settings.iterations):
            trial = state.moved(now.step(damping), problem.free)
            new = problem.equations(trial, links)
            if new.cost < now.cost:
                done = now.cost - new.cost < 1e-5 * now.cost
                state, now = trial, new
                damping = max(damping * 0.3, 0.01 * _DAMPING)
                if done:
                    break
            else:
                damping *= 100.0
    sigma = np.zeros(len(CAMERA_NAMES))
    sigma[problem.free] = now.camera_sigma()
    residual_px = now.residual_px
    lost = problem.moved_points - len(residual_px)
    at_rim, seen = (np.log1p((v / settings.cauchy_px) ** 2) for v in (gate_px, residual_px))
    misfit = (lost * at_rim + float(np.nansum(seen))) / max(problem.moved_points, 1)
    return BundleResult(
        poses=state.poses * [height, height, 1.0],
        tilt=state.tilt,
        camera=state.camera_like(camera),
        sigma=dict(zip(CAMERA_NAMES, sigma.tolist(), strict=True)),
        residual_px=residual_px[np.isfinite(residual_px)],
        misfit=float(misfit),
        pairs=len(problem.pairs),
    )
