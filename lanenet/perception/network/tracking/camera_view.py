"""What a camera shows of the ground before the car: whether a line is in the image, and where it is not."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM, parabola_through

#: y of the places at which a line has to be in the image to be in sight, and which share of them. Chosen.
_PLACES_CM, _IN_SIGHT = np.arange(15.0, 41.0, 5.0), 0.6
#: Ground that is looked at, to both sides and ahead, and in which steps: to the sides as far as a line of the
#: car's lane may lie, ahead about as far as the networks' windows. Chosen.
_ASIDE_CM, _AHEAD_CM, _STEP_CM = 120.0, 95.0, 2.5


class CameraView:
    """The part of the ground that a camera shows."""

    def __init__(self, camera: Camera) -> None:
        """Look at the ground before the car."""
        self._camera = camera
        aside = np.arange(-_ASIDE_CM, _ASIDE_CM + _STEP_CM, _STEP_CM)
        ahead = np.arange(0.0, _AHEAD_CM + _STEP_CM, _STEP_CM)
        ground = np.stack(np.meshgrid(aside, ahead, indexing="ij"), axis=-1)
        shown = camera.shows_ground(ground.reshape(-1, 2)).reshape(ground.shape[:2])
        first_cm = np.where(shown.any(axis=1), ahead[shown.argmax(axis=1)], _AHEAD_CM)
        self._hidden_cm = [np.maximum(first_cm - row, 0.0).tolist() for row in ROWS_CM]

    def shows(self, points_cm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return which points of the road, frame car, are in the image."""
        return self._camera.shows_ground(points_cm)

    def shows_line(self, line_cm: Float[np.ndarray, "3"]) -> bool:
        """Return whether most of a line, given by its points at the label rows, is in the image."""
        x = np.polyval(parabola_through(*line_cm.tolist()), _PLACES_CM)
        return bool(self._camera.shows_ground(np.stack([x, _PLACES_CM], axis=1)).mean() >= _IN_SIGHT)

    def hidden_cm(self, row: int, x_cm: float) -> float:
        """Return how far ahead of a place the image begins; 0 where that is behind it.

        Args:
            row: Number of the place's label row.
            x_cm: Its x, frame car. Where nothing is in the image, it counts as beginning 95 cm ahead.
        """
        if not math.isfinite(x_cm):
            return 0.0
        aside = min(max(x_cm, -_ASIDE_CM), _ASIDE_CM) + _ASIDE_CM
        return self._hidden_cm[row][round(aside / _STEP_CM)]
