"""Who steers a simulated car: the scripted driver, or a pilot in closed loop.

The driver knows the true pose and leads the front axle along a path of its own in the lane. A pilot is a
detector with the car's controller, the true points, or that driver.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field, model_validator

from datagen.world.car.car import CarSettings, advance, front_wheels_in_bend_rad
from datagen.world.road.track import Track
from lanenet.config import Settings
from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.smoothing import SmoothingSettings
from lanenet.control.steering import SteeringSettings, steering_target_rad
from lanenet.geometry.frames import map_from_car
from lanenet.perception.estimate import Detector, LaneEstimate

#: Sines in offset and speed; chosen: no period is noticed.
_WAVES = 4
#: Number of excursions that are drawn; a longer drive repeats them.
_EXCURSIONS = 64
#: Share of their spacing that excursions take; the rest is driven near the middle; chosen.
_EXCURSION_SHARE = 0.7
_SPEED_WAVE_CM = (100.0, 500.0)
#: Per frame (Kozlowski et al. 2024: 6 cm/s, an image per cm).
_CRAWL_CM = 1.0
_SPEED_CM_S = {"wander": 60.0, "recover": 60.0, "fast": 100.0}
#: Aim distances that it takes to learn the trim of the steering, its limit, and the largest offset from the
#: path at which it is learned; chosen: slower than the driver's own corrections.
_TRIM_AFTER = 5.0
_MOST_TRIM_RAD = 0.15
_TRIM_WITHIN_CM = 5.0
#: Largest offset at which a kink is cut, in lane widths; chosen: half of the car stays in its lane.
_MOST_CUT_LANES = 0.35


class DriverSettings(Settings):
    """How the car is driven.

    Attributes:
        style: ``wander`` keeps near the middle of the lane, ``recover`` also goes off to one side and comes
            back, again and again; ``crawl`` is 1 cm per frame as in Kozlowski et al. 2024, ``fast`` 1 m/s.
        direction: ``backward`` drives the same road the other way.
        speed_cm_s: Commanded speed; None: the style's, 60 cm/s but for ``crawl`` and ``fast``.
        speed_variation: Largest relative change of speed, which varies slowly.
        pauses_per_m: Stops, per metre of road.
        pause_s: How long the car is commanded to stand.
        aim_ahead_cm: Distance from the front axle to the aim point.
        wander_cm: Largest offset of the path from the middle of the lane.
        shortest_wander_cm: Shortest wave of the wandering.
        longest_wander_cm: Longest wave.
        recover_cm: Largest excursion to one side with the style ``recover``; the smallest is half of it.
        recover_every_cm: From one excursion to the next.
        change_lanes_every_cm: On a road with two lanes, distance from one change to the next; every second
            section is driven in the oncoming lane. None: the car keeps its lane.
        first_change_cm: Where along the road the first change begins; None: at ``change_lanes_every_cm``.
        lane_change_cm: Length of a change.
    """

    style: Literal["wander", "recover", "crawl", "fast"] = "wander"
    direction: Literal["forward", "backward"] = "forward"
    speed_cm_s: float | None = Field(default=None, gt=0.0)
    speed_variation: float = Field(default=0.0, ge=0.0, lt=1.0)
    pauses_per_m: float = Field(default=0.0, ge=0.0)
    pause_s: float = Field(default=1.5, gt=0.0)
    aim_ahead_cm: float = Field(default=20.0, gt=0.0)
    wander_cm: float = Field(default=6.0, ge=0.0)
    shortest_wander_cm: float = Field(default=150.0, gt=0.0)
    longest_wander_cm: float = Field(default=400.0, gt=0.0)
    recover_cm: float = Field(default=12.0, ge=0.0)
    recover_every_cm: float = Field(default=200.0, gt=0.0)
    change_lanes_every_cm: float | None = Field(default=None, gt=0.0)
    first_change_cm: float | None = Field(default=None, ge=0.0)
    lane_change_cm: float = Field(default=150.0, gt=0.0)

    @model_validator(mode="after")
    def _lengths_in_order(self) -> DriverSettings:
        every_cm = self.change_lanes_every_cm
        if self.first_change_cm is not None and every_cm is None:
            raise ValueError(
                f"first_change_cm {self.first_change_cm:g} needs change_lanes_every_cm, found none"
            )
        for shorter, longer in (
            ("shortest_wander_cm", "longest_wander_cm"),
            ("lane_change_cm", "change_lanes_every_cm"),
        ):
            least, most = getattr(self, shorter), getattr(self, longer)
            if most is not None and least > most:
                raise ValueError(f"{shorter} {least:g} exceeds {longer} {most:g}")
        return self

    def chosen_speed_cm_s(self, rate_hz: float) -> float:
        """Commanded speed at a frame rate, without its variation."""
        if self.speed_cm_s is not None:
            return self.speed_cm_s
        return _CRAWL_CM * rate_hz if self.style == "crawl" else _SPEED_CM_S[self.style]


def shortest_excursion_spacing_cm(height_cm: float, radius_cm: float) -> float:
    """Return the smallest ``recover_every_cm`` at which no excursion bends more sharply than a circle.

    Args:
        height_cm: Of the excursion: height sin^2(pi u / L) over its length L, sharpest at both ends and the
            top.
        radius_cm: Of the circle.
    """
    return math.sqrt(2.0 * math.pi**2 * height_cm * radius_cm) / _EXCURSION_SHARE


def shortest_lane_change_cm(width_cm: float, radius_cm: float) -> float:
    """Return the smallest ``lane_change_cm`` at which no change bends more sharply than a circle.

    Args:
        width_cm: From one lane's middle to the other's.
        radius_cm: Of the circle.
    """
    return math.sqrt(6.0 * width_cm * radius_cm)


class Script:
    """Offset and speed along the road, drawn once."""

    def __init__(
        self,
        settings: DriverSettings,
        rate_hz: float,
        rng: np.random.Generator,
        other_lane_cm: float | None = None,
    ) -> None:
        """Draw what the settings leave open.

        Args:
            settings: The driver.
            rate_hz: Frames per second.
            rng: Source of randomness.
            other_lane_cm: Offset of the other lane's middle, left positive; None on a road with one lane.
        """
        self.settings = settings
        self.other_lane_cm = 0.0 if other_lane_cm is None else other_lane_cm
        self._speed_cm_s = settings.chosen_speed_cm_s(rate_hz)
        lengths_cm = rng.uniform(settings.shortest_wander_cm, settings.longest_wander_cm, _WAVES)
        self._waves = 2.0 * np.pi / lengths_cm
        self._phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        share = rng.uniform(0.5, 1.0, _WAVES)
        self._amplitudes_cm = settings.wander_cm * share / share.sum()
        # The order is part of the format: a new part takes a new child at the end.
        excursion_rng, speed_rng, self._pause_rng = rng.spawn(3)
        side = np.where(excursion_rng.random(_EXCURSIONS) < 0.5, 1.0, -1.0)
        self._excursions_cm = settings.recover_cm * side * excursion_rng.uniform(0.5, 1.0, _EXCURSIONS)
        self._speed_waves = 2.0 * np.pi / speed_rng.uniform(*_SPEED_WAVE_CM, _WAVES)
        self._speed_phases = speed_rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        self._pause_until_s = -math.inf
        self._pause_at_cm: float | None = None

    def offset_cm(self, s_cm: float) -> float:
        """Offset of the path at a place along the road, left positive, [cm]."""
        offset_cm = float(np.sum(self._amplitudes_cm * np.sin(self._waves * s_cm + self._phases)))
        if self.settings.style == "recover":
            number, share = divmod(s_cm / self.settings.recover_every_cm, 1.0)
            if share < _EXCURSION_SHARE:
                height_cm = float(self._excursions_cm[int(number) % _EXCURSIONS])
                offset_cm += height_cm * math.sin(math.pi * share / _EXCURSION_SHARE) ** 2
        return offset_cm + self._lane_cm(s_cm)

    def _lane_cm(self, s_cm: float) -> float:
        """Offset of the lane's middle, and during a change of the path from one lane to the other."""
        every_cm, first_cm = self.settings.change_lanes_every_cm, self.settings.first_change_cm
        if every_cm is None:
            return 0.0
        first_cm = every_cm if first_cm is None else first_cm
        if s_cm < first_cm:
            return 0.0
        # Counted from one spacing before the first change.
        number, since_cm = divmod(s_cm - (first_cm - every_cm), every_cm)
        share = min(since_cm / self.settings.lane_change_cm, 1.0)
        gone = share * share * (3.0 - 2.0 * share)
        return self.other_lane_cm * (gone if number % 2.0 else 1.0 - gone)

    def slope(self, s_cm: float) -> float:
        """Change of the offset per distance along the road."""
        return self.offset_cm(s_cm + 0.5) - self.offset_cm(s_cm - 0.5)

    def speed_cm_s(self, s_cm: float, t_s: float) -> float:
        """Commanded speed at a place and time, to be called in the order of time, because of the pauses.

        Args:
            s_cm: Distance along the road.
            t_s: Time since the start.
        """
        driver = self.settings
        if driver.pauses_per_m > 0.0:
            if self._pause_at_cm is None:
                self._pause_at_cm = s_cm + self._to_next_pause_cm()
            if s_cm >= self._pause_at_cm and t_s >= self._pause_until_s:
                self._pause_until_s = t_s + driver.pause_s
                self._pause_at_cm += self._to_next_pause_cm()
            if t_s < self._pause_until_s:
                return 0.0
        varied = float(np.mean(np.sin(self._speed_waves * s_cm + self._speed_phases)))
        return self._speed_cm_s * (1.0 + driver.speed_variation * varied)

    def _to_next_pause_cm(self) -> float:
        return float(self._pause_rng.exponential(100.0 / self.settings.pauses_per_m))


class Driver:
    """Turns the front wheels into the direction of the path and a little towards it.

    The front axle goes where its wheels point, so that bends are not cut. Because of the delay, the driver
    steers for the place where the car will be when the command takes effect. The trim of the steering is
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
        self._least_radius_cm = car.wheelbase_cm / math.tan(car.max_steering_rad)
        self._kinks = np.flatnonzero(track.kinks_rad)

    def start_pose(self) -> Float[np.ndarray, "3"]:
        """Pose with the front axle on the line at the current place (rear axle, frame map)."""
        return self.pose_at(self.s_cm, self.script.offset_cm(self.s_cm), self.script.slope(self.s_cm))

    def pose_at(self, s_cm: float, offset_cm: float = 0.0, slope: float = 0.0) -> Float[np.ndarray, "3"]:
        """Pose of a car that follows a line beside the centre line with its front axle.

        Args:
            s_cm: Place of the front axle along the road.
            offset_cm: Its offset from the centre line, left positive.
            slope: Change of that offset per distance.
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
        """Return the steering command at a pose, [rad], positive left; updates the place along the road."""
        before_cm = self.s_cm
        self.s_cm, _ = self._place(pose)
        ahead = advance(
            pose, self._speed_cm_s * self._lead_s, self._steered_rad + self._trim_rad, self._wheelbase_cm
        )
        s_cm, offset_cm = self._place(ahead)
        cut_cm, cut_slope = self._cut(s_cm)
        off_cm = offset_cm - self.script.offset_cm(s_cm) - cut_cm
        if abs(off_cm) < _TRIM_WITHIN_CM:
            # The trim is what the wheels do by themselves: to the left if the car drifts to the left.
            share = off_cm / self._aim_ahead_cm * (self.s_cm - before_cm) / (_TRIM_AFTER * self._aim_ahead_cm)
            self._trim_rad = min(max(self._trim_rad + share, -_MOST_TRIM_RAD), _MOST_TRIM_RAD)
        direction = self.track.point(s_cm)[1] + math.atan(self.script.slope(s_cm) + cut_slope)
        wanted = direction - math.atan(off_cm / self._aim_ahead_cm) - float(ahead[2])
        steering = math.remainder(wanted, 2.0 * math.pi) - self._trim_rad
        self._steered_rad = min(max(steering, -self._max_steering_rad), self._max_steering_rad)
        return self._steered_rad

    def _cut(self, s_cm: float) -> tuple[float, float]:
        """Offset by which the path cuts a nearby kink, left positive, [cm], and its slope; 0 elsewhere.

        The path is a parabola there, about as tight as the car turns.
        """
        if not len(self._kinks):
            return 0.0, 0.0
        past_cm = s_cm - (self._kinks + 0.5) * self.track.step_cm
        if self.track.closed:
            lap_cm = self.track.length_cm
            past_cm = np.mod(past_cm + 0.5 * lap_cm, lap_cm) - 0.5 * lap_cm
        nearest = int(np.argmin(np.abs(past_cm)))
        past, turn_rad = float(past_cm[nearest]), float(self.track.kinks_rad[self._kinks[nearest]])
        bend = math.tan(0.5 * abs(turn_rad))
        radius_cm = min(self._least_radius_cm, 2.0 * _MOST_CUT_LANES * self.track.lane_width_cm / bend**2)
        left_cm = radius_cm * bend - abs(past)
        if left_cm <= 0.0:
            return 0.0, 0.0
        cut_cm = math.copysign(0.5 * left_cm**2 / radius_cm, turn_rad)
        return cut_cm, -math.copysign(left_cm / radius_cm, turn_rad * past)

    def lane_cm(self, pose: Float[np.ndarray, "3"]) -> float:
        """Return the offset of the lane in which the middle of the front axle is, left positive.

        That is the driver's own lane, 0, unless the driver changes lanes.
        """
        other_cm = self.script.other_lane_cm
        if self.script.settings.change_lanes_every_cm is None:
            return 0.0
        return other_cm if self._place(pose)[1] / other_cm > 0.5 else 0.0

    def _place(self, pose: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Distance along the road, over all laps, and offset of the front axle at a pose."""
        front = map_from_car(np.zeros((1, 2)), pose, self._wheelbase_cm)[0]
        return place_on_track(self.track, front, self.s_cm)


def place_on_track(track: Track, xy_cm: Float[np.ndarray, "2"], near_s_cm: float) -> tuple[float, float]:
    """Find a point's place along the road, counting on over the laps.

    Args:
        track: The road.
        xy_cm: The point, [cm], frame map.
        near_s_cm: Distance along the road that the point is near, over any number of laps.

    Returns:
        Distance along the road, and offset from its centre line (left positive), [cm].
    """
    s_cm, offset_cm = track.nearest(xy_cm, near_s_cm=near_s_cm)
    if track.closed:
        s_cm += track.length_cm * round((near_s_cm - s_cm) / track.length_cm)
    return s_cm, offset_cm


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
        self._controller.tell(self._detector, sight.t_s, sight.speed_cm_s, sight.steering_rad)
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
