"""The camera of a simulated car (default: Kozlowski et al. 2024), and whether it sees enough of a road."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from datagen.world.car.car import front_wheels_in_bend_rad
from datagen.world.road.track_settings import MarkingSettings, TrackSettings
from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.lane import ROWS_CM

#: On a straight, both lines must be in the image this far ahead of the front axle.
_SEES_AHEAD_CM = max(ROWS_CM)
#: In a bend, a section of one line must be, up to this far ahead: it still shows where the rows are.
_BEND_AHEAD_CM = 1.5 * _SEES_AHEAD_CM
#: Length of that section; chosen: about half a dash.
_BEND_SECTION_CM = 10.0
_STEP_CM = 0.5


class CameraSettings(Settings):
    """Lens and mounting.

    Attributes:
        model: Lens model.
        width: Image width, [px].
        height: Image height, [px].
        field_of_view_rad: Horizontal, across the whole width, as of a lens before the middle of the image;
            170 degrees by default.
        distortion: Coefficients k1..k4 (fisheye) or k1, k2, p1, p2 (pinhole).
        height_cm: Of the optical centre above the road.
        pitch_down_rad: Downward tilt; 25 degrees by default.
        roll_rad: Rotation about the optical axis.
        yaw_rad: Rotation about the vertical, positive looks left.
        ahead_of_front_axle_cm: Optical centre ahead of the front axle.
        right_of_centre_cm: Optical centre to the right of the car's middle.
        off_middle_px: Principal point right of and below the middle of the image, as after rectifying with
            another camera's file.
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
    off_middle_px: tuple[float, float] = (0.0, 0.0)

    def build(self, wheelbase_cm: float) -> Camera:
        """Return the camera on a car of this wheelbase.

        Raises:
            ConfigError: If the lens model cannot span the field of view.
        """
        mounting = Mounting(**{field.name: getattr(self, field.name) for field in fields(Mounting)})
        centre = np.array([0.5 * (self.width - 1), 0.5 * (self.height - 1)]) + self.off_middle_px
        K = np.array([[1.0, 0.0, centre[0]], [0.0, 1.0, centre[1]], [0.0, 0.0, 1.0]])
        D = np.array(self.distortion)
        unit = Camera(self.model, self.width, self.height, K, D, mounting, wheelbase_cm)
        half_rad = 0.5 * self.field_of_view_rad
        if half_rad > unit.max_angle_rad:
            raise ConfigError(
                f"camera: field_of_view_rad {self.field_of_view_rad:.3f} is more than the {self.model} lens "
                f"spans with this distortion ({2.0 * unit.max_angle_rad:.3f})"
            )
        # The radius of the edge of the field of view at a focal length of one pixel.
        edge = unit.project_rays(np.array([[np.sin(half_rad), 0.0, np.cos(half_rad)]]))[0, 0] - centre[0]
        focal_px = 0.5 * self.width / edge
        return replace(unit, K=K * [[focal_px, 1.0, 1.0], [1.0, focal_px, 1.0], [1.0, 1.0, 1.0]])


def sees_lane(camera: CameraSettings, track: TrackSettings, wheelbase_cm: float) -> bool:
    """Return whether the camera sees enough of the lane from the middle of it.

    That is, on a straight, both lines at the farthest label row. In the tightest bend, to either side: 10 cm
    of one of the lines between the front axle and 45 cm ahead, wherever its dashes are. Of a line that may be
    dashed, a section of 10 cm more than the gap must be in the image.

    Args:
        camera: On the car.
        track: The road; worn or interrupted paint counts as whole.
        wheelbase_cm: Of the car.
    """
    built = camera.build(wheelbase_cm)
    half_cm, radius_cm = 0.5 * track.lane_width_cm, track.tightest_radius_cm
    if radius_cm <= half_cm:
        return False  # there is no such road: the inner line would have no radius left
    straight = np.array([[-half_cm, _SEES_AHEAD_CM], [half_cm, _SEES_AHEAD_CM]])
    if not _in_image(built, straight).all():
        return False
    lines = [
        (offset_cm, _longest_gap_cm(marking))
        for offset_cm, marking in track.lines.values()
        if abs(offset_cm) <= half_cm
    ]
    return all(
        any(
            _section_cm(built, line_in_bend_car(side / radius_cm, offset_cm, wheelbase_cm))
            >= gap_cm + _BEND_SECTION_CM
            for offset_cm, gap_cm in lines
        )
        for side in (1.0, -1.0)
    )


def _longest_gap_cm(marking: MarkingSettings) -> float:
    """Longest section without paint of a line of this kind."""
    if marking.kind == "none":
        return math.inf
    return marking.gap_cm if marking.kind in ("dashed", "random") else 0.0


def line_in_bend_car(
    curvature_per_cm: float, offset_cm: float, wheelbase_cm: float
) -> Float[np.ndarray, "n 2"]:
    """Return a line beside a bend, seen from a car whose front axle follows the bend.

    Args:
        curvature_per_cm: Of the bend, positive left.
        offset_cm: Of the line from the bend, left positive.
        wheelbase_cm: Of the car.

    Returns:
        Points every 0.5 cm along the line from the front axle on, up to 45 cm ahead or to where the line
        runs at right angles to the car, [cm], frame car.
    """
    turned_rad = front_wheels_in_bend_rad(curvature_per_cm, wheelbase_cm)
    per_cm = curvature_per_cm / (1.0 - offset_cm * curvature_per_cm)  # of the line
    # Counted from beside the middle of the front axle.
    reach_cm = 2.0 * (_BEND_AHEAD_CM + abs(offset_cm))
    along_cm = np.arange(-reach_cm, reach_cm, _STEP_CM)
    turn = per_cm * along_cm
    heading = turned_rad + turn
    chord_cm = along_cm * np.sinc(0.5 * turn / np.pi)
    ahead = -offset_cm * math.sin(turned_rad) + chord_cm * np.cos(turned_rad + 0.5 * turn)
    left = offset_cm * math.cos(turned_rad) + chord_cm * np.sin(turned_rad + 0.5 * turn)
    kept = (np.abs(heading) < 0.5 * np.pi) & (ahead >= 0.0) & (ahead <= _BEND_AHEAD_CM)
    return np.stack([-left, ahead], axis=1)[kept]


def _section_cm(camera: Camera, line_car_cm: Float[np.ndarray, "n 2"]) -> float:
    """Longest section without a break in the image, of a line of evenly spaced points."""
    hidden = ~_in_image(camera, line_car_cm)
    breaks = np.flatnonzero(np.concatenate([[True], hidden, [True]]))
    # A run of points spans one step less than their number.
    return max(0.0, float(np.diff(breaks).max() - 2) * _STEP_CM)


def _in_image(camera: Camera, points_car_cm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    pixels = camera.project_ground(points_car_cm)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0.0) & (pixels <= np.array([camera.width - 1.0, camera.height - 1.0]))
    return np.asarray(inside.all(axis=1))
