"""Pentek's lane painter as a detector."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, ROWS_CM
from lanenet.geometry.steering import proportional_angle_rad
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.image_lane import (
    ImageLane,
    Polyline,
    check_size,
    rows_of_points,
    sample_segment,
    to_bgr,
)
from lanenet.perception.painter.curves import (
    Curve,
    CurveSettings,
    curvature_radius,
    fit_curve,
    mean_curve,
    slide_windows,
)
from lanenet.perception.painter.edges import PainterEdgeSettings, find_painter_edges, find_trapezoid
from lanenet.perception.painter.lines import (
    PainterLineSettings,
    SolidLine,
    blend,
    find_painter_segments,
    find_two_lines,
)
from lanenet.perception.painter.plane import Plane, RoadPlane, SquarePlane

#: Smaller frames hold no line that could be told from chance.
_MIN_SIDE_PX = 48


class PainterSettings(Settings):
    """Pentek's painter; the defaults are the paper's where it gives one.

    Attributes:
        mode: ``photo`` takes each frame by itself, ``video`` averages the lines over frames.
        video_weight: ``video``: weight of the current frame in the average.
        hold_frames: ``video``: a line is drawn and expected for so many frames after it was last found.
        curves: Follow curves by sliding windows; False leaves the paper's straight lines.
        edges: From frame to edges.
        lines: From edges to straight lines.
        curve: From straight lines to curves.
    """

    mode: Literal["photo", "video"] = "video"
    video_weight: float = Field(default=0.5, gt=0.0, le=1.0)
    hold_frames: int = Field(default=5, ge=0)
    curves: bool = True
    edges: PainterEdgeSettings = PainterEdgeSettings()
    lines: PainterLineSettings = PainterLineSettings()
    curve: CurveSettings = CurveSettings()


@dataclass(frozen=True)
class PaintedLane:
    """What the road of a calibrated camera tells about the last frame.

    Attributes:
        radius_cm: Radius of curvature of the lane's middle at its near end; infinite where straight, NaN
            where unknown.
        offset_cm: The car's place right of the lane's middle, at the near end; NaN where unknown.
    """

    radius_cm: float = float("nan")
    offset_cm: float = float("nan")

    @property
    def radius_m(self) -> float:
        """The radius in metres, for people."""
        return 0.01 * self.radius_cm

    @property
    def offset_m(self) -> float:
        """The offset in metres, for people."""
        return 0.01 * self.offset_cm


class LanePainter:
    """Frame in, lane out, by joined Hough lines and curves through the edges beside them.

    With a camera the lines are moved to the road, and the steering aims at the lane's middle 15 cm ahead.
    Without one the points are NaN, and the steering is the angle in the image between straight up and the
    lane's middle, halfway up the region, seen from the middle of its bottom. The confidence is the share of
    the two lines that this frame shows; a line that is only remembered is drawn, but not answered.

    Attributes:
        last: Lines of the last frame in the image, for drawing.
        lane: Radius and offset of the last frame; unknown without a camera.
    """

    def __init__(self, camera: Camera | None = None, settings: PainterSettings | None = None) -> None:
        """Build the painter.

        Raises:
            CalibrationError: If the camera sees no road.
        """
        self.camera = camera
        self.settings = PainterSettings() if settings is None else settings
        self.last = ImageLane()
        self.lane = PaintedLane()
        self._road = None if camera is None else RoadPlane(camera)
        self._earlier: list[SolidLine | None] = [None, None]
        self._missed = [0, 0]
        self._shape: tuple[int, int] | None = None

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self.last, self.lane = ImageLane(), PaintedLane()
        self._earlier, self._missed = [None, None], [0, 0]

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w *c"]) -> LaneEstimate:
        """Find the lane in one frame.

        Raises:
            DriveFormatError: If the array is not an image of one or three uint8 channels.
            CalibrationError: If the frame's size is not the camera's.
        """
        frame = to_bgr(frame_bgr)
        check_size(frame, self.camera)
        height, width = frame.shape[:2]
        if self.settings.mode == "photo" or self._shape != (height, width):
            self.reset()
        self._shape = (height, width)
        if min(height, width) < _MIN_SIDE_PX:
            return LaneEstimate()
        trapezoid = find_trapezoid(width, height, self.camera, self.settings.edges)
        edges = find_painter_edges(frame, trapezoid, self.settings.edges)
        region_height = float(trapezoid[2, 1] - trapezoid[0, 1])
        segments = find_painter_segments(edges, region_height, self.settings.lines)
        earlier = (self._earlier[0], self._earlier[1])
        found = find_two_lines(segments, trapezoid, earlier, self.settings.lines)
        self._remember(found)
        plane: Plane = self._road if self._road is not None else SquarePlane(trapezoid)
        points = plane.edge_points(edges)
        curves = [self._curve(k, line is not None, trapezoid, plane, points) for k, line in enumerate(found)]
        lines = [self._line_px(k, curves[k], trapezoid, plane) for k in (0, 1)]
        self.lane = self._measure(curves) if self.camera is not None else PaintedLane()
        self.last = ImageLane(lines[0], lines[1], filled=True, text=_caption(self.lane))
        rows = self._rows(found, curves, trapezoid)
        return LaneEstimate(
            points_cm=rows.reshape(N_POINTS),
            steering_rad=self._steering_rad(found, rows, lines, trapezoid),
            confidence=0.5 * sum(line is not None for line in found),
        )

    def _remember(self, found: tuple[SolidLine | None, SolidLine | None]) -> None:
        for k, line in enumerate(found):
            if line is not None:
                self._earlier[k] = blend(line, self._earlier[k], self.settings.video_weight)
                self._missed[k] = 0
            else:
                self._missed[k] += 1
                if self._missed[k] > self.settings.hold_frames:
                    self._earlier[k] = None

    def _straight_px(self, side: int, trapezoid_px: Float[np.ndarray, "4 2"]) -> Polyline | None:
        line = self._earlier[side]
        if line is None:
            return None
        near = (line.bottom_px, float(trapezoid_px[2, 1]))
        return sample_segment(near, (line.top_px, float(trapezoid_px[0, 1])))

    def _curve(
        self,
        side: int,
        found: bool,
        trapezoid_px: Float[np.ndarray, "4 2"],
        plane: Plane,
        points: Float[np.ndarray, "n 2"],
    ) -> Curve | None:
        straight = self._straight_px(side, trapezoid_px)
        if not (self.settings.curves and found) or straight is None:
            return None
        guess = plane.from_image(straight)
        if len(guess) < 2 or not np.all(np.diff(guess[:, 1]) > 0.0):
            return None
        settings = self.settings.curve
        half_width = settings.half_width_share
        if self.camera is not None:
            half_width = settings.half_width_heights * self.camera.mounting.height_cm
        chosen = slide_windows(points, guess, half_width, settings)
        seen = points[:, 1].max() if len(points) else guess[-1, 1]
        length = float(min(guess[-1, 1], seen) - guess[0, 1])
        return fit_curve(chosen, length, settings) if length > 0.0 else None

    def _line_px(
        self, side: int, curve: Curve | None, trapezoid_px: Float[np.ndarray, "4 2"], plane: Plane
    ) -> Polyline | None:
        straight = self._straight_px(side, trapezoid_px)
        if curve is None or straight is None:
            return straight
        line = plane.to_image(curve.sample(float(plane.from_image(straight)[0, 1])))
        return line if len(line) >= 2 else None

    def _measure(self, curves: list[Curve | None]) -> PaintedLane:
        left, right = curves
        if left is None or right is None:
            return PaintedLane()
        middle = mean_curve(left, right)
        y = middle.near
        return PaintedLane(curvature_radius(middle, y), -((middle.a * y + middle.b) * y + middle.c))

    def _rows(
        self,
        found: tuple[SolidLine | None, SolidLine | None],
        curves: list[Curve | None],
        trapezoid_px: Float[np.ndarray, "4 2"],
    ) -> Float[np.ndarray, "2 3"]:
        rows = np.full((2, len(ROWS_CM)), np.nan)
        for side, curve in enumerate(curves):
            straight = self._straight_px(side, trapezoid_px)
            if self._road is None or found[side] is None or straight is None:
                continue
            rows[side] = rows_of_points(
                curve.sample() if curve is not None else self._road.from_image(straight)
            )
        return rows

    def _steering_rad(
        self,
        found: tuple[SolidLine | None, SolidLine | None],
        rows_cm: Float[np.ndarray, "2 3"],
        lines_px: list[Polyline | None],
        trapezoid_px: Float[np.ndarray, "4 2"],
    ) -> float:
        left, right = lines_px
        if found[0] is None or found[1] is None or left is None or right is None:
            return float("nan")
        if self.camera is not None:
            aim = float(rows_cm[:, 1].mean())
            return proportional_angle_rad(aim, ROWS_CM[1]) if math.isfinite(aim) else float("nan")
        bottom = float(trapezoid_px[2, 1])
        row = 0.5 * (float(trapezoid_px[0, 1]) + bottom)
        middle = 0.5 * sum(float(np.interp(-row, -line[:, 1], line[:, 0])) for line in (left, right))
        start = 0.5 * float(trapezoid_px[2, 0] + trapezoid_px[3, 0])
        return math.atan2(start - middle, bottom - row)


def _caption(lane: PaintedLane) -> str:
    if not math.isfinite(lane.offset_cm):
        return ""
    radius = f"R {lane.radius_m:.1f} m" if lane.radius_m < 100.0 else "straight"
    return f"{radius}  {abs(lane.offset_m):.2f} m {'right' if lane.offset_cm > 0.0 else 'left'} of the middle"
