"""The road of a synthetic drive: one object that is painted and that answers for the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from datagen.world.centre_line import closed_centre_line, open_centre_line
from datagen.world.paint import interrupt, paint_dashes, paint_solid
from lanenet.config import Settings
from lanenet.errors import ConfigError
from lanenet.geometry.frames import car_from_map, map_from_car
from lanenet.geometry.lane import rows_of_polyline

Side = Literal["left", "right"]
Bgr = tuple[float, float, float]

_WHITE: Bgr = (235.0, 235.0, 235.0)
_YELLOW: Bgr = (40.0, 190.0, 230.0)
_BEHIND_CM, _AHEAD_CM = 60.0, 150.0
_CLEARANCE_LANES = 1.5


class MarkingSettings(Settings):
    """How one line of the lane is painted.

    Attributes:
        kind: ``random`` is dashed on every other road, on average.
        colour: ``random`` is yellow on every other road, on average.
        dash_cm: Painted length of a dashed line.
        gap_cm: Length between dashes.
    """

    kind: Literal["solid", "dashed", "random"] = "solid"
    colour: Literal["white", "yellow", "random"] = "white"
    dash_cm: float = Field(default=20.0, gt=0.0)
    gap_cm: float = Field(default=20.0, gt=0.0)


class TrackSettings(Settings):
    """A random road with one driven lane.

    Attributes:
        lane_width_cm: Between the middles of the two lines.
        line_width_cm: Width of the tape.
        min_radius_cm: Of the centre line of the lane.
        closed: A loop instead of a road with two ends.
        length_cm: Along the centre line; None: as long as the drive needs, or 1200 cm for a loop.
        left: Line on the left.
        right: Line on the right.
        interruptions_per_m: Stretches where paint is missing, for each line.
        max_interruption_cm: Longest such stretch.
    """

    lane_width_cm: float = Field(default=40.0, gt=0.0)
    line_width_cm: float = Field(default=2.0, gt=0.0)
    min_radius_cm: float = Field(default=60.0, gt=0.0)
    closed: bool = False
    length_cm: float | None = Field(default=None, gt=100.0)
    left: MarkingSettings = MarkingSettings(kind="random", colour="random")
    right: MarkingSettings = MarkingSettings()
    interruptions_per_m: float = Field(default=0.1, ge=0.0)
    max_interruption_cm: float = Field(default=100.0, ge=10.0)


@dataclass(frozen=True, eq=False)
class Marking:
    """One painted line, parallel to the centre line.

    Attributes:
        offset_cm: Of its middle, left of the centre line positive.
        width_cm: Of the tape.
        colour_bgr: Nominal colour, 0..255.
        painted_cm: Start and end of each painted stretch along the centre line, ascending.
    """

    offset_cm: float
    width_cm: float
    colour_bgr: Bgr
    painted_cm: Float[np.ndarray, "k 2"]


@dataclass(frozen=True, eq=False)
class Track:
    """A road: the centre line of the driven lane and the markings beside it.

    Attributes:
        s_cm: Distance along the centre line, evenly spaced, about 1 cm.
        xy_cm: Centre line, frame map.
        heading_rad: Direction of travel, unwrapped.
        curvature_per_cm: Positive to the left.
        closed: Whether the last sample is followed by the first.
        lane_width_cm: Between the middles of the two lines.
        markings: What is painted.
    """

    s_cm: Float[np.ndarray, "n"]
    xy_cm: Float[np.ndarray, "n 2"]
    heading_rad: Float[np.ndarray, "n"]
    curvature_per_cm: Float[np.ndarray, "n"]
    closed: bool
    lane_width_cm: float
    markings: tuple[Marking, ...]

    @property
    def step_cm(self) -> float:
        """Distance between samples, [cm]."""
        return float(self.s_cm[1] - self.s_cm[0])

    @property
    def length_cm(self) -> float:
        """Length of the centre line, [cm]; of a loop, once around."""
        return float(self.s_cm[-1]) + (self.step_cm if self.closed else 0.0)

    def line_xy(self, side: Side) -> Float[np.ndarray, "n 2"]:
        """Return the middle of the left or right line at each sample, [cm], frame map.

        The line is where the road has it, painted or not.
        """
        offset_cm = 0.5 * self.lane_width_cm if side == "left" else -0.5 * self.lane_width_cm
        normal = np.stack([-np.sin(self.heading_rad), np.cos(self.heading_rad)], axis=1)
        return self.xy_cm + offset_cm * normal

    def point(self, s_cm: float, offset_cm: float = 0.0) -> tuple[Float[np.ndarray, "2"], float]:
        """Return the point at a place along the road and the road's heading there, [cm], [rad], frame map.

        On a loop any distance counts, over as many laps as it takes; beyond the ends of an open road it goes
        on along the circle that the end lies on.
        """
        n, i = len(self.s_cm), round(s_cm / self.step_cm)
        lap, i = divmod(i, n) if self.closed else (0, min(max(i, 0), n - 1))
        along_cm = s_cm - lap * self.length_cm - float(self.s_cm[i])
        turn = float(self.curvature_per_cm[i]) * along_cm
        direction = float(self.heading_rad[i]) + 0.5 * turn
        heading = float(self.heading_rad[i]) + turn
        chord_cm = along_cm * float(np.sinc(0.5 * turn / np.pi))
        xy_cm = self.xy_cm[i] + chord_cm * np.array([np.cos(direction), np.sin(direction)])
        return xy_cm + offset_cm * np.array([-np.sin(heading), np.cos(heading)]), heading

    def nearest(
        self, xy_cm: Float[np.ndarray, "2"], near_s_cm: float | None = None, reach_cm: float = 60.0
    ) -> tuple[float, float]:
        """Find a point's place along the road.

        Args:
            xy_cm: The point, [cm], frame map.
            near_s_cm: Search only within ``reach_cm`` of this place along the road.
            reach_cm: Half the length of that stretch.

        Returns:
            Distance along the centre line and offset from it (left positive), [cm]. Beyond the ends of an
            open road both continue along the circle that the end lies on.
        """
        if near_s_cm is None:
            index = np.arange(len(self.s_cm))
        else:
            index = self._samples(near_s_cm - reach_cm, near_s_cm + reach_cm)
        i = index[np.argmin(np.sum((self.xy_cm[index] - xy_cm) ** 2, axis=1))]
        ahead, left = xy_cm - self.xy_cm[i], 0.0
        c, s = np.cos(self.heading_rad[i]), np.sin(self.heading_rad[i])
        ahead, left = ahead[0] * c + ahead[1] * s, -ahead[0] * s + ahead[1] * c
        k = float(self.curvature_per_cm[i])
        # On the circle through the sample: the same as the foot of the perpendicular, without the corners
        # that the polyline has.
        inward = 1.0 - k * left
        along_cm = np.arctan2(k * ahead, inward) / k if abs(k) > 1e-9 else ahead
        offset_cm = (2.0 * left - k * (ahead**2 + left**2)) / (1.0 + np.hypot(k * ahead, inward))
        return float(self.s_cm[i] + along_cm), float(offset_cm)

    def lines_car(
        self, pose: Float[np.ndarray, "3"], wheelbase_cm: float, near_s_cm: float | None = None
    ) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
        """Return the left and right line around the car, [cm], frame car, in the direction of travel.

        Only the stretch from 60 cm behind the front axle to 150 cm ahead along the road, so that no other
        stretch of the road answers.

        Args:
            pose: Rear-axle centre x, y and heading, frame map.
            wheelbase_cm: Distance between the axles.
            near_s_cm: Where along the road the car is known to be, when it may have left its lane.
        """
        front = map_from_car(np.zeros((1, 2)), pose, wheelbase_cm)[0]
        s_cm, _ = self.nearest(front, near_s_cm)
        index = self._samples(s_cm - _BEHIND_CM, s_cm + _AHEAD_CM)
        left = car_from_map(self.line_xy("left")[index], pose, wheelbase_cm)
        right = car_from_map(self.line_xy("right")[index], pose, wheelbase_cm)
        return left, right

    def truth(
        self, pose: Float[np.ndarray, "3"], wheelbase_cm: float, near_s_cm: float | None = None
    ) -> Float[np.ndarray, "6"]:
        """Return the six points of the label contract, [cm], frame car; NaN where a line misses a row.

        The points follow the road, also where its paint is interrupted.
        """
        left, right = self.lines_car(pose, wheelbase_cm, near_s_cm)
        return np.concatenate([rows_of_polyline(left), rows_of_polyline(right)])

    def mirrored(self) -> Track:
        """Return the track with left and right exchanged (y changes sign in the map)."""
        return replace(
            self,
            xy_cm=self.xy_cm * [1.0, -1.0],
            heading_rad=-self.heading_rad,
            curvature_per_cm=-self.curvature_per_cm,
            markings=tuple(replace(m, offset_cm=-m.offset_cm) for m in self.markings),
        )

    def moved(self, pose: Float[np.ndarray, "3"]) -> Track:
        """Return the track turned by ``pose[2]`` about the origin and then moved by ``pose[:2]``."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        xy_cm = self.xy_cm @ np.array([[c, s], [-s, c]]) + pose[:2]
        return replace(self, xy_cm=xy_cm, heading_rad=self.heading_rad + pose[2])

    def _samples(self, from_cm: float, to_cm: float) -> Int[np.ndarray, "m"]:
        """Indices of a stretch in the direction of travel; cut at the ends of an open road."""
        first, last = int(np.floor(from_cm / self.step_cm)), int(np.ceil(to_cm / self.step_cm))
        n = len(self.s_cm)
        if self.closed:
            return np.arange(first, min(last, first + n - 1) + 1) % n
        # Never empty: beyond an end the last two samples stand for the road.
        first = min(max(first, 0), n - 2)
        return np.arange(first, min(max(last, first + 1), n - 1) + 1)


def random_track(settings: TrackSettings, rng: np.random.Generator) -> Track:
    """Draw a random road.

    Args:
        settings: What is fixed; ``length_cm`` None means 1200 cm here.
        rng: Source of randomness; shape, markings and interruptions draw from children of their own.

    Returns:
        The road, from the origin of the map along +x.

    Raises:
        ConfigError: If the settings leave no road that keeps clear of itself.
    """
    if settings.min_radius_cm <= 0.5 * settings.lane_width_cm + settings.line_width_cm:
        raise ConfigError(
            f"track: min_radius_cm {settings.min_radius_cm:g} must exceed half the lane_width_cm "
            f"{settings.lane_width_cm:g} and the line_width_cm {settings.line_width_cm:g}"
        )
    shape_rng, kind_rng, interruption_rng = rng.spawn(3)
    draw = closed_centre_line if settings.closed else open_centre_line
    separation_cm = _CLEARANCE_LANES * settings.lane_width_cm
    line = draw(settings.length_cm or 1200.0, settings.min_radius_cm, separation_cm, shape_rng)
    length_cm = (len(line.xy_cm) - (0 if settings.closed else 1)) * line.step_cm
    markings = []
    for sign, marking in ((1.0, settings.left), (-1.0, settings.right)):
        chance, colour_chance, phase = kind_rng.random(3)
        dashed = marking.kind == "dashed" or (marking.kind == "random" and chance < 0.5)
        yellow = marking.colour == "yellow" or (marking.colour == "random" and colour_chance < 0.5)
        if dashed:
            painted_cm = paint_dashes(length_cm, settings.closed, marking.dash_cm, marking.gap_cm, phase)
        else:
            painted_cm = paint_solid(length_cm)
        painted_cm = interrupt(
            painted_cm,
            length_cm,
            settings.interruptions_per_m,
            settings.max_interruption_cm,
            interruption_rng,
        )
        offset_cm = sign * 0.5 * settings.lane_width_cm
        markings.append(Marking(offset_cm, settings.line_width_cm, _YELLOW if yellow else _WHITE, painted_cm))
    return Track(
        s_cm=np.arange(len(line.xy_cm)) * line.step_cm,
        xy_cm=line.xy_cm,
        heading_rad=line.heading_rad,
        curvature_per_cm=line.curvature_per_cm,
        closed=settings.closed,
        lane_width_cm=settings.lane_width_cm,
        markings=tuple(markings),
    )
