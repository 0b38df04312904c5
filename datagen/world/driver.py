"""A scripted driver with perfect sight: leads the front axle along a line of its choice in the lane."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from datagen.world.car import CarSettings, advance, front_wheels_in_bend_rad
from datagen.world.script import DriverSettings, Script
from datagen.world.track import Track
from lanenet.geometry.frames import map_from_car

__all__ = ["Driver", "DriverSettings", "Script"]

_TRIM_AFTER = 5.0  # aim distances that it takes to learn what the steering is off by
_MOST_TRIM_RAD = 0.15
_TRIM_WITHIN_CM = 5.0


class Driver:
    """Turns the front wheels to the line's direction and a little towards the line.

    The front axle goes where its wheels point, so that this follows bends without cutting them. The wheels
    answer late: the driver steers for the place where the car will be by then. What the steering is off by is
    learned from the offset that remains.

    Source:
        Front-axle law: Hoffmann et al. 2007, "Autonomous automobile trajectory tracking for off-road
        driving", American Control Conference (there with the speed over the gain for the aim distance).
        Prediction and trim: own choice.
    """

    def __init__(
        self,
        settings: DriverSettings,
        track: Track,
        start_s_cm: float,
        car: CarSettings,
        rate_hz: float,
        rng: np.random.Generator,
    ) -> None:
        """Set out with the rear axle near a place along the road."""
        self.track, self.script = track, Script(settings, rate_hz, rng, track.oncoming_cm)
        self._aim_ahead_cm = settings.aim_ahead_cm
        self._wheelbase_cm, self._max_steering_rad = car.wheelbase_cm, car.max_steering_rad
        # A command holds until the next one: on average it is half a frame old.
        self._lead_s = car.delay_s + 0.5 / rate_hz
        self.s_cm = start_s_cm + (0.0 if track.closed else car.wheelbase_cm)
        self._steered_rad, self._speed_cm_s, self._trim_rad = 0.0, 0.0, 0.0

    def start_pose(self) -> Float[np.ndarray, "3"]:
        """Pose with the front axle on the line at the current place (rear axle, frame map)."""
        return self.pose_at(self.s_cm, self.script.offset_cm(self.s_cm), self.script.slope(self.s_cm))

    def pose_at(self, s_cm: float, offset_cm: float = 0.0, slope: float = 0.0) -> Float[np.ndarray, "3"]:
        """Pose of a car that follows a line beside the centre line with its front axle.

        Args:
            s_cm: Place of the front axle along the road.
            offset_cm: Its offset from the centre line, left positive.
            slope: Change of that offset per way.
        """
        front_cm, road_rad = self.track.point(s_cm, offset_cm)
        curvature = self.track.point(s_cm + 1.0)[1] - road_rad
        heading = road_rad + math.atan(slope) - front_wheels_in_bend_rad(curvature, self._wheelbase_cm)
        rear_cm = front_cm - self._wheelbase_cm * np.array([math.cos(heading), math.sin(heading)])
        return np.array([rear_cm[0], rear_cm[1], heading])

    def command(self, pose: Float[np.ndarray, "3"], t_s: float) -> tuple[float, float]:
        """Return the commanded speed, [cm/s], and steering, [rad], positive left, at a pose and time."""
        steering_rad = self.steer(pose)
        self._speed_cm_s = self.script.speed_cm_s(self.s_cm, t_s)
        return self._speed_cm_s, steering_rad

    def steer(self, pose: Float[np.ndarray, "3"]) -> float:
        """Return the steering command at a pose, [rad], positive left; keeps count of the way driven."""
        before_cm = self.s_cm
        self.s_cm, _ = self._place(pose)
        ahead = advance(
            pose, self._speed_cm_s * self._lead_s, self._steered_rad + self._trim_rad, self._wheelbase_cm
        )
        s_cm, offset_cm = self._place(ahead)
        off_cm = offset_cm - self.script.offset_cm(s_cm)
        if abs(off_cm) < _TRIM_WITHIN_CM:
            # The learned share is what the wheels do by themselves: to the left where the car drifts left.
            share = off_cm / self._aim_ahead_cm * (self.s_cm - before_cm) / (_TRIM_AFTER * self._aim_ahead_cm)
            self._trim_rad = min(max(self._trim_rad + share, -_MOST_TRIM_RAD), _MOST_TRIM_RAD)
        direction = self.track.point(s_cm)[1] + math.atan(self.script.slope(s_cm))
        wanted = direction - math.atan(off_cm / self._aim_ahead_cm) - float(ahead[2])
        steering = math.remainder(wanted, 2.0 * math.pi) - self._trim_rad
        self._steered_rad = min(max(steering, -self._max_steering_rad), self._max_steering_rad)
        return self._steered_rad

    def lane_cm(self, pose: Float[np.ndarray, "3"]) -> float:
        """Return the offset of the lane in which the middle of the front axle is, left positive.

        That is the driver's own lane, 0, unless the driver changes lanes.
        """
        other_cm = self.script.other_lane_cm
        if self.script.settings.change_lanes_every_cm is None:
            return 0.0
        return other_cm if self._place(pose)[1] / other_cm > 0.5 else 0.0

    def _place(self, pose: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Way along the road, over all laps, and offset of the front axle at a pose."""
        front = map_from_car(np.zeros((1, 2)), pose, self._wheelbase_cm)[0]
        return place_on_track(self.track, front, self.s_cm)


def place_on_track(track: Track, xy_cm: Float[np.ndarray, "2"], near_s_cm: float) -> tuple[float, float]:
    """Find a point's place along the road, counting on over the laps.

    Args:
        track: The road.
        xy_cm: The point, [cm], frame map.
        near_s_cm: Way along the road that the point is near, any number of laps.

    Returns:
        Way along the road, and offset from its centre line (left positive), [cm].
    """
    s_cm, offset_cm = track.nearest(xy_cm, near_s_cm=near_s_cm)
    if track.closed:
        s_cm += track.length_cm * round((near_s_cm - s_cm) / track.length_cm)
    return s_cm, offset_cm
