"""Priors and robustness of the bundle adjustment."""

from __future__ import annotations

from pydantic import Field

from lanenet.config import Settings


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
        recorded_speed: Of the way per frame about the recorded speed times its gain, as a share of it: errors
            of a few per cent that last for some frames. Only where a speed was recorded.
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
    recorded_speed: float = Field(default=0.2, gt=0.0)
    turn_change: float = Field(default=0.01, gt=0.0)
