"""Bundle adjustment: all poses, each frame's tilt and the camera together, residuals in pixels.

An edge point of one frame, moved over the road into another frame, must lie on an edge of that frame. The
distance across that edge is the residual; in pixels, because in centimetres the best scene is a small one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.slam.adjustment.problem import BundleProblem
from datagen.slam.adjustment.state import CAMERA_NAMES, BundleSettings, start_state
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import EdgePixels

__all__ = ["CAMERA_NAMES", "BundleResult", "BundleSettings", "adjust"]

#: Share added to the diagonal. A drive bends as a whole by next to nothing in any one frame: with 1e-4 an
#: error of every turn alike is still there after all rounds.
_DAMPING = 1e-8


@dataclass(frozen=True)
class BundleResult:
    """What the adjustment found.

    Attributes:
        poses: Rear-axle poses, frame map, in the camera's unit of length.
        tilt: Pitch and roll of each frame beyond the camera's, [rad].
        camera: The adjusted camera.
        sigma: Standard deviation of each of the camera's numbers (see ``CAMERA_NAMES``; focal relative); 0
            of those that stayed.
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
    keep: UInt8[np.ndarray, "h w"] | None = None,
    recorded: bool = False,
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
        keep: Pixels in which edges were looked for; None for all.
        recorded: Whether the commanded ways come from a recorded speed.

    Returns:
        The adjusted drive.
    """
    problem = BundleProblem(
        edges, camera, settings, rng, free, loops, breaks, expected, believed, keep, recorded
    )
    height = camera.mounting.height_cm
    state = start_state(poses, tilt, camera)
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
