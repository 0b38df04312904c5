"""The camera of a simulated car as a few numbers; by default the one of Kozlowski et al. 2024."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera, Mounting


class CameraSettings(Settings):
    """Lens and mounting.

    Attributes:
        model: Lens model.
        width: Image width, [px].
        height: Image height, [px].
        field_of_view_rad: Horizontal, across the whole width; 170 degrees by default.
        distortion: Coefficients k1..k4 (fisheye) or k1, k2, p1, p2 (pinhole).
        height_cm: Of the optical centre above the road.
        pitch_down_rad: Downward tilt; 25 degrees by default.
        roll_rad: Rotation about the optical axis.
        yaw_rad: Rotation about the vertical, positive looks left.
        ahead_of_front_axle_cm: Optical centre ahead of the front axle.
        right_of_centre_cm: Optical centre to the right of the car's middle.
    """

    model: Literal["fisheye", "pinhole"] = "fisheye"
    width: int = Field(default=320, ge=16)
    height: int = Field(default=240, ge=16)
    field_of_view_rad: float = Field(default=math.radians(170.0), gt=0.0, lt=2.0 * math.pi)
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    height_cm: float = Field(default=20.0, gt=0.0)
    pitch_down_rad: float = Field(default=math.radians(25.0), gt=-1.5, lt=1.5)
    roll_rad: float = 0.0
    yaw_rad: float = 0.0
    ahead_of_front_axle_cm: float = -2.0
    right_of_centre_cm: float = 0.0

    def build(self, wheelbase_cm: float) -> Camera:
        """Return the camera on a car of this wheelbase.

        Raises:
            ConfigError: If the lens model cannot span the field of view.
        """
        mounting = Mounting(
            height_cm=self.height_cm,
            pitch_down_rad=self.pitch_down_rad,
            roll_rad=self.roll_rad,
            yaw_rad=self.yaw_rad,
            ahead_of_front_axle_cm=self.ahead_of_front_axle_cm,
            right_of_centre_cm=self.right_of_centre_cm,
        )
        centre = np.array([0.5 * (self.width - 1), 0.5 * (self.height - 1)])
        K = np.array([[1.0, 0.0, centre[0]], [0.0, 1.0, centre[1]], [0.0, 0.0, 1.0]])
        D = np.array(self.distortion)
        unit = Camera(self.model, self.width, self.height, K, D, mounting, wheelbase_cm)
        half_rad = 0.5 * self.field_of_view_rad
        if half_rad > unit.max_angle_rad:
            raise ConfigError(
                f"camera: field_of_view_rad {self.field_of_view_rad:.3f} is more than the {self.model} lens "
                f"spans with this distortion ({2.0 * unit.max_angle_rad:.3f})"
            )
        # With a focal length of one pixel, the edge of the field lies at the radius that the lens gives it.
        edge = unit.project_rays(np.array([[np.sin(half_rad), 0.0, np.cos(half_rad)]]))[0, 0] - centre[0]
        focal_px = 0.5 * self.width / edge
        K = np.array([[focal_px, 0.0, centre[0]], [0.0, focal_px, centre[1]], [0.0, 0.0, 1.0]])
        return Camera(self.model, self.width, self.height, K, D, mounting, wheelbase_cm)
