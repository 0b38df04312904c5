"""What a recording is told: what stays the same on a drive, and what was seen in each frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, ROWS_CM, SIDES, parabolas_from_points
from lanenet.perception.draw import FAR_CM
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.image_lane import ImageLane

Polyline = Float[np.ndarray, "_ 2"]
#: Whose lane it is: a detector's, or what it is compared with.
LaneName = Literal["detected", "reference"]
LANE_NAMES: tuple[LaneName, ...] = ("detected", "reference")
#: Rows of a parabola's polyline, [cm]: every third one is a label row.
_DRAWN_ROWS_CM: Float[np.ndarray, "rows"] = np.arange(0.0, FAR_CM + 1.0, 5.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same.

    Attributes:
        name: Of the recording, for people.
        camera: Camera of the frames; None without one: then there is nothing on the road.
        perception: How edge points are found in the frames.
        lines_map_cm: Lane lines of the map by name, frame map; NaN rows break a line.
        edges_map_cm: Edge points of the map.
        path_map: Rear-axle poses of the whole drive, frame map, heading in radians.
    """

    name: str
    camera: Camera | None = None
    perception: PerceptionSettings = field(default_factory=PerceptionSettings)
    lines_map_cm: Mapping[str, Polyline] = field(default_factory=dict)
    edges_map_cm: Polyline = field(default_factory=lambda: np.empty((0, 2)))
    path_map: Float[np.ndarray, "_ 3"] = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane as one frame shows it; what is unknown is NaN or None.

    Attributes:
        points_cm: The six points of the label contract, frame car.
        lines_cm: Left and right line, frame car; None takes the parabolas through the points.
        lines_px: Left and right line, frame image, of a detector that works in the image; None takes the
            lines on the road.
    """

    points_cm: Float[np.ndarray, "6"] = field(default_factory=lambda: np.full(N_POINTS, np.nan))
    lines_cm: tuple[Polyline, Polyline] | None = None
    lines_px: tuple[Polyline | None, Polyline | None] | None = None

    @property
    def on_road_cm(self) -> tuple[Polyline, Polyline]:
        """Left and right line, frame car; a line that lacks a point has only its known points."""
        if self.lines_cm is not None:
            return self.lines_cm
        left, right = (self._line(side) for side in range(len(SIDES)))
        return left, right

    def _line(self, side: int) -> Polyline:
        parabola = parabolas_from_points(self.points_cm)[side]
        if np.isfinite(parabola).all():
            return np.stack([np.polyval(parabola, _DRAWN_ROWS_CM), _DRAWN_ROWS_CM], axis=1)
        return self.known_cm(side)

    def known_cm(self, side: int) -> Polyline:
        """The known points of the left (0) or the right (1) line, frame car."""
        points = np.stack([self.points_cm.reshape(len(SIDES), -1)[side], ROWS_CM], axis=1)
        return points[np.isfinite(points[:, 0])]


@dataclass(frozen=True, eq=False)
class Seen:
    """What was seen in one frame.

    Attributes:
        frame: Its number.
        t_s: Its time; NaN for a photo.
        image_bgr: None if it could not be read.
        lanes: Lanes by whose they are.
        values: Numbers for plots, by names that end in their units where they have one; NaN is left out.
        pose: Rear axle and heading, [cm], [cm], [rad], frame map; None if unknown.
        camera: The camera with this frame's tilt; None takes the scene's.
        reason: Why a point, or the whole frame, is not answered; empty where all are.
    """

    frame: int
    t_s: float
    image_bgr: UInt8[np.ndarray, "h w *c"] | None
    lanes: Mapping[LaneName, Lane] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    pose: Float[np.ndarray, "3"] | None = None
    camera: Camera | None = None
    reason: str = ""


def lane_of(estimate: LaneEstimate, image_lane: ImageLane | None = None) -> Lane:
    """Return a detector's answer as a lane; the lines of the image, if it has some, are drawn there."""
    lines_px = None if image_lane is None else (image_lane.left_px, image_lane.right_px)
    return Lane(estimate.points_cm, lines_px=lines_px)


def values_of(estimate: LaneEstimate) -> dict[str, float]:
    """Return the numbers of a detector's answer, positive steering to the left."""
    return {
        "steering_rad": estimate.steering_rad,
        "confidence": estimate.confidence,
        "own_lane": estimate.own_lane,
    }


def error_cm(detected: Float[np.ndarray, "6"], reference: Float[np.ndarray, "6"]) -> float:
    """Return the mean distance of six points from their reference; NaN where no point has one."""
    off = np.abs(detected - reference)
    return float(off[np.isfinite(off)].mean()) if np.isfinite(off).any() else math.nan
