"""Pilots steer in closed loop: a detector with the car's controller, the true points, the scripted driver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from datagen.world.car.driver import Driver
from datagen.world.road.track import Track
from lanenet.config import Settings
from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.smoothing import SmoothingSettings
from lanenet.control.steering import SteeringSettings, steering_target_rad
from lanenet.perception.estimate import Detector, LaneEstimate


class PilotSettings(Settings):
    """From a lane estimate to a command.

    Attributes:
        law: ``pure-pursuit`` and ``proportional`` steer by the points (see :mod:`lanenet.control.steering`),
            ``own`` follows the detector's own steering target.
        look_ahead_cm: Distance of the aim point ahead of the front axle.
        smoothing: Of a detector's points over the frames, as on the car; the own target is not smoothed.
        keep_s: How long the last steering is kept when the lane is lost.
        then: Afterwards, until the lane is found again: wheels straight, or stop.
    """

    law: Literal["pure-pursuit", "proportional", "own"] = "proportional"
    look_ahead_cm: float = Field(default=15.0, gt=0.0)
    smoothing: SmoothingSettings = SmoothingSettings()
    keep_s: float = Field(default=0.5, ge=0.0)
    then: Literal["straight", "stop"] = "straight"


@dataclass(frozen=True, eq=False)
class Sight:
    """What a pilot gets in one frame.

    Attributes:
        image_bgr: What the camera sees; None for a pilot that needs no image.
        pose: True rear-axle centre x, y and heading, frame map.
        s_cm: True place of the front axle along the road.
        t_s: Time of the frame.
        speed_cm_s: Commanded speed since the frame before; 0 for the first one.
        steering_rad: Commanded steering since then, positive left.
    """

    image_bgr: UInt8[np.ndarray, "h w 3"] | None
    pose: Float[np.ndarray, "3"]
    s_cm: float
    t_s: float = 0.0
    speed_cm_s: float = 0.0
    steering_rad: float = 0.0


@runtime_checkable
class Pilot(Protocol):
    """Steers, and may keep state from frame to frame.

    Attributes:
        needs_image: Whether frames have to be drawn for it.
    """

    needs_image: bool

    def steer(self, sight: Sight) -> float:
        """Return the wanted steering, [rad], positive left; NaN without an answer."""
        ...

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        ...


class DetectorPilot:
    """Steers by what a detector sees, with the controller of the car."""

    needs_image = True

    def __init__(self, detector: Detector, control: ControlSettings) -> None:
        """Take a detector and how its lane becomes steering."""
        self._detector, self._controller = detector, LaneController(control)

    def steer(self, sight: Sight) -> float:
        """See :class:`Pilot`; uses the image only; the speed that the controller wants is ignored.

        Raises:
            ValueError: If there is no image.
        """
        if sight.image_bgr is None:
            raise ValueError("a detector needs an image")
        estimate = self._detector.detect(sight.image_bgr)
        return self._controller.target(estimate, sight.t_s, sight.speed_cm_s, sight.steering_rad).steering_rad

    def reset(self) -> None:
        """Reset the detector and forget earlier frames."""
        self._detector.reset()
        self._controller.reset()


class TruePointsPilot:
    """Steers by the true points: errors that remain are those of the steering law."""

    needs_image = False

    def __init__(self, track: Track, steering: SteeringSettings) -> None:
        """Take the road and the law to steer by."""
        self._track, self._steering = track, steering

    def steer(self, sight: Sight) -> float:
        """See :class:`Pilot`."""
        points_cm = self._track.truth(sight.pose, self._steering.wheelbase_cm, sight.s_cm)
        return steering_target_rad(LaneEstimate(points_cm=points_cm), self._steering)

    def reset(self) -> None:
        """Do nothing: there is no state."""


class DriverPilot:
    """The scripted driver, who gets the true pose."""

    needs_image = False

    def __init__(self, driver: Driver) -> None:
        """Take a driver at the start."""
        self._driver = driver

    def steer(self, sight: Sight) -> float:
        """See :class:`Pilot`."""
        return self._driver.command(sight.pose, 0.0)[1]

    def reset(self) -> None:
        """Do nothing: what the driver has learned of the car stays valid."""


class LostLane:
    """The command when the pilot has no answer: the last steering for a while, then a rule."""

    def __init__(self, settings: PilotSettings, rate_hz: float) -> None:
        """Start without any steering to keep."""
        self._settings, self._keep_frames = settings, round(settings.keep_s * rate_hz)
        self._kept_rad, self._missed = 0.0, 0

    def command(self, wanted_rad: float, speed_cm_s: float) -> tuple[float, float]:
        """Return commanded speed and steering.

        Args:
            wanted_rad: The pilot's steering, NaN without an answer.
            speed_cm_s: Speed while the lane is known.
        """
        if math.isfinite(wanted_rad):
            self._kept_rad, self._missed = wanted_rad, 0
            return speed_cm_s, wanted_rad
        self._missed += 1
        if self._missed <= self._keep_frames:
            return speed_cm_s, self._kept_rad
        return (0.0 if self._settings.then == "stop" else speed_cm_s), 0.0

    def reset(self) -> None:
        """Forget the last steering."""
        self._kept_rad, self._missed = 0.0, 0


def control_settings(
    pilot: PilotSettings, wheelbase_cm: float, max_steering_rad: float, lane_width_cm: float
) -> ControlSettings:
    """Return the settings of :mod:`lanenet.control` for a car and a lane."""
    steering = SteeringSettings(
        law="pure-pursuit" if pilot.law == "pure-pursuit" else "proportional",
        look_ahead_cm=pilot.look_ahead_cm,
        wheelbase_cm=wheelbase_cm,
        max_steering_rad=max_steering_rad,
        lane_width_cm=lane_width_cm,
    )
    return ControlSettings(steering=steering, smoothing=pilot.smoothing, own_target=pilot.law == "own")
