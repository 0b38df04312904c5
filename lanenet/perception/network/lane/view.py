"""Where along a line the camera would show its borders."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8

from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import PARABOLA_FROM_POINTS
from lanenet.perception.network.refinement import BIN_CM

#: y of the middles of the bins of 3 cm in which :mod:`lanenet.perception.network.refinement` counts borders.
_BINS_CM = np.arange(-2.5, 42.0, BIN_CM)
#: Ground to either side that is looked at, and in which steps. Chosen: as far as a line of the car's lane or
#: the next one may lie.
_ASIDE_CM, _STEP_CM = 120.0, 2.0


class LinesInView:
    """The part of the ground on which a camera shows lines; without a camera, all of it."""

    def __init__(self, camera: Camera | None, keep: UInt8[np.ndarray, "h w"] | None = None) -> None:
        """Look at the ground before the car.

        Args:
            camera: The camera.
            keep: 0 at pixels in which no edges are looked for, as the car itself; None looks at all.
        """
        aside = np.arange(-_ASIDE_CM, _ASIDE_CM + _STEP_CM, _STEP_CM)
        ground = np.stack(np.meshgrid(aside, _BINS_CM, indexing="ij"), axis=-1)
        shown: Bool[np.ndarray, "a b"] = np.ones(ground.shape[:2], dtype=bool)
        if camera is not None:
            points = ground.reshape(-1, 2)
            in_image = camera.shows_ground(points)
            if keep is not None:
                column, row = np.rint(camera.project_ground(points[in_image])).astype(np.int64).T
                in_image[in_image] = keep[row, column] > 0
            shown = in_image.reshape(shown.shape)
        # Nothing is looked at beyond the first and the last column.
        shown[[0, -1]] = False
        self._shown, self._bins = shown, np.arange(len(_BINS_CM))
        self._x_of_points = PARABOLA_FROM_POINTS.T @ np.vander(_BINS_CM, 3).T

    def bins(self, points_cm: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """Return how many bins of 3 cm of lines, given by x at the label rows, lie in the image."""
        x = points_cm @ self._x_of_points
        column = np.minimum(
            np.maximum((x + (_ASIDE_CM + 0.5 * _STEP_CM)) / _STEP_CM, 0.0), len(self._shown) - 1
        )
        return self._shown[column.astype(np.int64), self._bins].sum(axis=-1).astype(np.float64)
