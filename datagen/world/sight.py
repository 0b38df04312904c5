"""Whether a car can be driven by its camera: what of a road is in the picture."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from datagen.world.car import front_wheels_in_bend_rad
from datagen.world.rig import CameraSettings
from datagen.world.track_settings import MarkingSettings, TrackSettings
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM

#: On a straight both lines are in the picture so far ahead of the front axle.
_SEES_AHEAD_CM = max(ROWS_CM)
#: In a bend one line is, up to so far ahead of the front axle: from there it still tells where the rows are.
_BEND_AHEAD_CM = 1.5 * _SEES_AHEAD_CM
#: For so long a stretch.
_BEND_STRETCH_CM = 10.0
_STEP_CM = 0.5


def sees_lane(camera: CameraSettings, track: TrackSettings, wheelbase_cm: float) -> bool:
    """Whether a car in the middle of its lane has enough of it in the picture to be driven by.

    On a straight, both lines where the farthest label row crosses them. In the tightest bend, to either side,
    10 cm of one of the lines between the front axle and 45 cm ahead of it, wherever its dashes are: a line
    that may be dashed must be in the picture for its gap and 10 cm more.

    Args:
        camera: On the car.
        track: The road; no paint is taken to be worn or interrupted.
        wheelbase_cm: Of the car.
    """
    built = camera.build(wheelbase_cm)
    half_cm, radius_cm = 0.5 * track.lane_width_cm, track.tightest_radius_cm
    if radius_cm <= half_cm:
        return False  # there is no such road: the line inside would have no radius left
    straight = np.array([[-half_cm, _SEES_AHEAD_CM], [half_cm, _SEES_AHEAD_CM]])
    if not _in_picture(built, straight).all():
        return False
    lines = [
        (offset_cm, _longest_gap_cm(marking))
        for offset_cm, marking in track.lines.values()
        if abs(offset_cm) <= half_cm
    ]
    return all(
        any(
            _stretch_cm(built, line_in_bend_car(side / radius_cm, offset_cm, wheelbase_cm))
            >= gap_cm + _BEND_STRETCH_CM
            for offset_cm, gap_cm in lines
        )
        for side in (1.0, -1.0)
    )


def _longest_gap_cm(marking: MarkingSettings) -> float:
    """Length without paint that a line has by its kind."""
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
        Points every 0.5 cm along the line from the front axle's row on, up to 45 cm ahead or to where the
        line turns away across the car's way, [cm], frame car.
    """
    turned_rad = front_wheels_in_bend_rad(curvature_per_cm, wheelbase_cm)
    per_cm = curvature_per_cm / (1.0 - offset_cm * curvature_per_cm)  # of the line
    # From where the line runs straight ahead of the front axle's middle, on either side of it.
    reach_cm = 2.0 * (_BEND_AHEAD_CM + abs(offset_cm))
    along_cm = np.arange(-reach_cm, reach_cm, _STEP_CM)
    turn = per_cm * along_cm
    heading = turned_rad + turn
    chord_cm = along_cm * np.sinc(0.5 * turn / np.pi)
    ahead = -offset_cm * math.sin(turned_rad) + chord_cm * np.cos(turned_rad + 0.5 * turn)
    left = offset_cm * math.cos(turned_rad) + chord_cm * np.sin(turned_rad + 0.5 * turn)
    kept = (np.abs(heading) < 0.5 * np.pi) & (ahead >= 0.0) & (ahead <= _BEND_AHEAD_CM)
    return np.stack([-left, ahead], axis=1)[kept]


def _stretch_cm(camera: Camera, line_car_cm: Float[np.ndarray, "n 2"]) -> float:
    """Longest unbroken stretch in the picture of a line of evenly spaced points."""
    hidden = ~_in_picture(camera, line_car_cm)
    breaks = np.flatnonzero(np.concatenate([[True], hidden, [True]]))
    # So many points in a row span one step less.
    return max(0.0, float(np.diff(breaks).max() - 2) * _STEP_CM)


def _in_picture(camera: Camera, points_car_cm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    pixels = camera.project_ground(points_car_cm)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0.0) & (pixels <= np.array([camera.width - 1.0, camera.height - 1.0]))
    return np.asarray(inside.all(axis=1))
