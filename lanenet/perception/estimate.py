"""What a detector is, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.lane import N_POINTS, SIDES, parabolas_from_points


def _no_points() -> Float[np.ndarray, "6"]:
    return np.full(N_POINTS, np.nan)


def _no_presence() -> Float[np.ndarray, "2"]:
    return np.full(len(SIDES), np.nan)


@dataclass(frozen=True)
class LaneEstimate:
    """The lane as one frame shows it.

    Attributes:
        points_cm: Six points in the order of the label contract, frame car; NaN where unknown.
        sigma_cm: Standard deviation of each point; NaN where the detector does not know it.
        steering_rad: Steering target, positive left; NaN when there is none.
        confidence: 0 (nothing seen) to 1.
        radius_cm: Radius of curvature of the lane's centre line; infinite where straight, NaN where the
            detector does not know it.
        offset_cm: How far the car is to the right of the lane's centre line; NaN where the detector does not
            know it.
        presence: Probability that the left and the right line can be seen; NaN where the detector does not
            know it.
    """

    points_cm: Float[np.ndarray, "6"] = field(default_factory=_no_points)
    sigma_cm: Float[np.ndarray, "6"] = field(default_factory=_no_points)
    steering_rad: float = float("nan")
    confidence: float = 0.0
    radius_cm: float = float("nan")
    offset_cm: float = float("nan")
    presence: Float[np.ndarray, "2"] = field(default_factory=_no_presence)

    @property
    def mask(self) -> np.ndarray:
        """True where a point is known."""
        return np.isfinite(self.points_cm)

    @property
    def parabolas(self) -> Float[np.ndarray, "2 3"]:
        """(a, b, c) of the left and right line; NaN for a line that lacks a point."""
        return parabolas_from_points(self.points_cm)


@runtime_checkable
class Detector(Protocol):
    """A lane detector: frame in, estimate out; it may keep state from frame to frame."""

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame."""
        ...

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        ...
