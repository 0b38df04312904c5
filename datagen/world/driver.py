"""A scripted driver: follows the lane and wanders a little, so that labels vary."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.world.track import Track
from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.frames import car_from_map, map_from_car
from lanenet.geometry.steering import pure_pursuit_angle_rad

_WAVES = 4


class DriverSettings(Settings):
    """How the car is driven.

    Attributes:
        speed_cm_s: Commanded speed.
        aim_ahead_cm: Distance ahead of the front axle, along the road, of the point that is steered for.
        wander_cm: Largest offset from the middle of the lane that the driver aims for.
        shortest_wander_cm: Shortest wave of the wandering.
        longest_wander_cm: Longest wave.
    """

    speed_cm_s: float = Field(default=60.0, gt=0.0)
    aim_ahead_cm: float = Field(default=20.0, gt=0.0)
    wander_cm: float = Field(default=6.0, ge=0.0)
    shortest_wander_cm: float = Field(default=150.0, gt=0.0)
    longest_wander_cm: float = Field(default=400.0, gt=0.0)


class Driver:
    """Pure pursuit along the lane, with perfect sight and a smooth random offset."""

    def __init__(
        self,
        settings: DriverSettings,
        track: Track,
        start_s_cm: float,
        max_steering_rad: float,
        rng: np.random.Generator,
    ) -> None:
        """Set out near a place along the road.

        Raises:
            ConfigError: If the shortest wave is longer than the longest.
        """
        if settings.shortest_wander_cm > settings.longest_wander_cm:
            raise ConfigError(
                f"driver: shortest_wander_cm {settings.shortest_wander_cm:g} exceeds longest_wander_cm "
                f"{settings.longest_wander_cm:g}"
            )
        self.settings, self.track = settings, track
        self.s_cm = start_s_cm
        self.max_steering_rad = max_steering_rad
        lengths_cm = rng.uniform(settings.shortest_wander_cm, settings.longest_wander_cm, _WAVES)
        self._waves = 2.0 * np.pi / lengths_cm
        self._phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        share = rng.uniform(0.5, 1.0, _WAVES)
        self._amplitudes_cm = settings.wander_cm * share / share.sum()

    def offset_cm(self, s_cm: float) -> float:
        """Offset that the driver aims for at a place along the road, left positive, [cm]."""
        return float(np.sum(self._amplitudes_cm * np.sin(self._waves * s_cm + self._phases)))

    def start_pose(self) -> Float[np.ndarray, "3"]:
        """Pose on the wandering line at the current place (rear axle, frame map)."""
        xy_cm, heading = self.track.point(self.s_cm, self.offset_cm(self.s_cm))
        slope = self.offset_cm(self.s_cm + 0.5) - self.offset_cm(self.s_cm - 0.5)
        return np.array([xy_cm[0], xy_cm[1], heading + np.arctan(slope)])

    def steer(self, pose: Float[np.ndarray, "3"], wheelbase_cm: float) -> float:
        """Return the steering command at a pose, [rad], positive left; keeps count of the way driven."""
        front = map_from_car(np.zeros((1, 2)), pose, wheelbase_cm)[0]
        s_cm, _ = self.track.nearest(front, near_s_cm=self.s_cm)
        if self.track.closed:
            lap_cm = self.track.length_cm
            s_cm += lap_cm * round((self.s_cm - s_cm) / lap_cm)
        self.s_cm = s_cm
        aim_s_cm = s_cm + self.settings.aim_ahead_cm
        aim_cm, _ = self.track.point(aim_s_cm, self.offset_cm(aim_s_cm))
        right_cm, ahead_cm = car_from_map(aim_cm[None], pose, wheelbase_cm)[0]
        steering = pure_pursuit_angle_rad(float(right_cm), float(ahead_cm), wheelbase_cm)
        return float(np.clip(steering, -self.max_steering_rad, self.max_steering_rad))
