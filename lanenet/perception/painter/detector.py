"""Pentek's lane painter as a detector."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import counted
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, ROWS_CM, proportional_angle_rad
from lanenet.perception.edges.canny import check_size
from lanenet.perception.estimate import DetectorKind, LaneEstimate
from lanenet.perception.image_lane import ImageLane, rows_of_points, to_bgr
from lanenet.perception.painter.curves import (
    CurveSettings,
    Plane,
    RoadPlane,
    SquarePlane,
    finite_rows,
)
from lanenet.perception.painter.lane import PaintedLane, find_aim_cm, measure_lane
from lanenet.perception.painter.lines import (
    EvidenceSettings,
    PainterEdgeSettings,
    PainterLineSettings,
    SolidLine,
    agree_px,
    are_close,
    blend,
    find_edge_field,
    find_painter_edges,
    find_painter_segments,
    find_side_lines,
    find_trapezoid,
    find_two_lines,
)
from lanenet.perception.painter.markings import (
    Marking,
    Pair,
    can_bound_the_lane,
    choose_lane,
    follow_lines,
    straight_px,
    weigh,
)
from lanenet.perception.painter.scene import ROAD, VanishingPoint, continue_line, find_road_trapezoid

#: Smaller frames have too few rows to tell a line from chance; chosen: less than half of the smallest frames
#: in use (160 x 120 px).
_MIN_SIDE_PX = 48
#: Default look-ahead in camera heights; see :class:`PainterSettings`. Beyond 3.5 heights a line seen by one
#: frame was unreliable on three real drives.
_LOOK_AHEAD_HEIGHTS = 3.5


class PainterSettings(Settings):
    """Pentek's painter; the defaults are the paper's where it gives one.

    Attributes:
        scene: Without a camera: ``road`` takes the region of interest from the vanishing point and, where a
            settings file does not say otherwise, :data:`lanenet.perception.painter.scene.ROAD`; ``floor``
            takes the proportions of a road image and the defaults below; ``auto`` takes ``road`` once the
            straight lines of a drive's frames meet in a point.
        mode: ``photo`` takes each frame by itself, ``video`` averages the lines over frames.
        video_weight: ``video``: weight of the current frame in the average.
        hold_frames: ``video``: a line is drawn and expected for so many frames after it was last found.
        curves: Follow curves by sliding windows; False leaves the paper's straight lines.
        look_ahead_cm: With a camera: distance of the aim point. None takes 3.5 camera heights: closer to the
            car, the centre of the lane shows where the car is, not where the lane leads.
        edges: From frame to edges.
        lines: From edges to straight lines.
        curve: From straight lines to curves.
        evidence: What a line has to show before it is answered.
    """

    scene: Literal["auto", "road", "floor"] = "auto"
    mode: Literal["photo", "video"] = "video"
    video_weight: float = Field(default=0.5, gt=0.0, le=1.0)
    hold_frames: int = Field(default=5, ge=0)
    curves: bool = True
    look_ahead_cm: float | None = Field(default=None, gt=0.0)
    edges: PainterEdgeSettings = PainterEdgeSettings()
    lines: PainterLineSettings = PainterLineSettings()
    curve: CurveSettings = CurveSettings()
    evidence: EvidenceSettings = EvidenceSettings()


class LanePainter:
    """Frame in, lane out, by joined Hough lines and curves through the edges beside them.

    Without a camera the scene decides on the settings; see :class:`PainterSettings`.

    With a camera the lines are moved to the road and answered as far as they are seen, and the steering aims
    at the lane's centre some camera heights ahead. Without one the points are NaN, and the steering is the
    angle in the image from straight up to the lane's centre halfway up the region, seen from the middle of
    its bottom. The confidence is the share of the two lines that this frame shows; a remembered line is drawn
    but not answered.

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
        self._vanishing = VanishingPoint()
        self._trapezoid_px: Float[np.ndarray, "4 2"] | None = None
        #: The settings of the last frame: those for roads where it shows one.
        self._chosen = self.settings
        self._for_roads = _with_road_settings(self.settings)
        self._frames = self._frames_of_roads = self._small_frames = 0

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self.last, self.lane = ImageLane(), PaintedLane()
        self._earlier, self._missed = [None, None], [0, 0]
        self._vanishing, self._trapezoid_px = VanishingPoint(), None

    @property
    def hint(self) -> str:
        """Which settings the frames so far were given, across resets, or that they were too small for any."""
        if self._small_frames:
            return (
                f"the painter finds nothing in frames of fewer than {_MIN_SIDE_PX} px, as in "
                f"{counted(self._small_frames, 'frame')} here"
            )
        if self.camera is not None or self._frames == 0:
            return ""
        roads = self._frames_of_roads
        scene = "floor" if 2 * roads > self._frames else "road"
        return (
            f"without a camera file, the painter took {roads} of {counted(self._frames, 'frame')} for a road "
            "that runs to a horizon, where straight lines meet, and the others for a floor, where a line "
            f"needs more evidence; 'scene: {scene}' in a settings file (--config) decides for all"
        )

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
            self._small_frames += 1
            return LaneEstimate(lines_px=self.last.numbers_px(width, height))
        trapezoid = self._find_region(frame)
        found = self._smooth(self._find(frame, trapezoid), trapezoid)
        rows = np.full((2, len(ROWS_CM)), np.nan)
        if self.camera is not None:
            for side, marking in enumerate(found):
                if marking is not None:
                    rows[side] = rows_of_points(self._seen(marking))
        self.lane = PaintedLane() if self.camera is None else measure_lane(found, rows)
        self.last = self._image_lane(found, trapezoid, height)
        return LaneEstimate(
            points_cm=rows.reshape(N_POINTS),
            steering_rad=self._steering_rad(found, trapezoid),
            confidence=0.5 * sum(marking is not None for marking in found),
            radius_cm=self.lane.radius_cm,
            offset_cm=self.lane.offset_cm,
            lines_px=self.last.numbers_px(width, height),
        )

    def _find_region(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "4 2"]:
        """Choose settings and region of this frame; lines of earlier frames move to the region's rows."""
        height, width = frame_bgr.shape[:2]
        settings = self.settings
        is_road = settings.scene == "road"
        trapezoid = find_trapezoid(width, height, self.camera, settings.edges)
        if self.camera is None and settings.scene != "floor" and settings.edges.trapezoid is None:
            self._vanishing.see(frame_bgr, settings.edges)
            if self._vanishing.point_px is not None:
                is_road = True
                trapezoid = find_road_trapezoid(self._vanishing.point_px, height)
        self._chosen = self._for_roads if is_road and self.camera is None else settings
        self._frames += 1
        self._frames_of_roads += is_road
        before = self._trapezoid_px
        if before is not None:
            self._earlier = [None if x is None else x.between(before, trapezoid) for x in self._earlier]
        self._trapezoid_px = trapezoid
        return trapezoid

    def _find(self, frame_bgr: UInt8[np.ndarray, "h w 3"], trapezoid_px: Float[np.ndarray, "4 2"]) -> Pair:
        """The lines that this frame shows."""
        chosen = self._chosen
        edges = find_painter_edges(frame_bgr, trapezoid_px, chosen.edges)
        segments = find_painter_segments(edges, float(trapezoid_px[2, 1] - trapezoid_px[0, 1]), chosen.lines)
        earlier = (self._earlier[0], self._earlier[1])
        plane: Plane = self._road if self._road is not None else SquarePlane(trapezoid_px)
        points = plane.edge_points(edges)
        height_cm = None if self.camera is None else self.camera.mounting.height_cm
        half_width = chosen.curve.half_width_share
        if height_cm is not None:
            half_width = chosen.curve.half_width_heights * height_cm
        curve = chosen.curve if chosen.curves else None
        region = (plane, trapezoid_px, points, half_width, curve)
        if not chosen.evidence.required:
            pair = find_two_lines(segments, trapezoid_px, earlier, chosen.lines)
            followed = follow_lines([line for line in pair if line is not None], *region)
            left, right = (None if line is None else followed[line][1] or followed[line][0] for line in pair)
            return left, right
        field = find_edge_field(frame_bgr, edges, trapezoid_px, chosen.edges)
        tolerance = agree_px(trapezoid_px, chosen.lines)
        both_sides = find_side_lines(
            segments, trapezoid_px, earlier, chosen.lines, chosen.evidence.candidates
        )
        followed = follow_lines([*both_sides[0], *both_sides[1]], *region)
        sides = [
            [weigh(*followed[x], field, are_close(x, before, tolerance), chosen.evidence) for x in lines]
            for lines, before in zip(both_sides, earlier, strict=True)
        ]
        if height_cm is not None:
            width = frame_bgr.shape[1]
            sides = [can_bound_the_lane(side, plane, width, height_cm, chosen.evidence) for side in sides]
        return choose_lane(sides[0], sides[1], trapezoid_px, height_cm, chosen.lines, chosen.evidence)

    def _smooth(self, found: Pair, trapezoid_px: Float[np.ndarray, "4 2"]) -> Pair:
        """Average straight lines over frames, and keep what is expected in the next one."""
        smooth: list[Marking | None] = []
        for k, marking in enumerate(found):
            if marking is None:
                self._missed[k] += 1
                if self._missed[k] > self.settings.hold_frames:
                    self._earlier[k] = None
                smooth.append(None)
                continue
            before = self._earlier[k]
            # A different line than before; their mean would lie on neither.
            if not are_close(marking.line, before, 2.0 * agree_px(trapezoid_px, self._chosen.lines)):
                before = None
            line = blend(marking.line, before, self.settings.video_weight)
            self._earlier[k], self._missed[k] = line, 0
            if marking.curve is None:
                line_px = straight_px(line, trapezoid_px)
                points = marking.points
                if self._road is not None:
                    points = finite_rows(self._road.from_image(line_px))
                    points = points[np.argsort(points[:, 1], kind="stable")]
                marking = replace(marking, line=line, line_px=line_px, points=points)
            smooth.append(marking)
        return smooth[0], smooth[1]

    def _seen(self, marking: Marking) -> Float[np.ndarray, "n 2"]:
        """The points of a line in the image, up to where an edge lies along it: further on it may bend."""
        far_px = marking.evidence.far_px
        if self._road is None or self._shape is None or not math.isfinite(far_px):
            return marking.points
        u, v = marking.line_px.T
        seen = (v >= far_px - 1.0) & (u >= 0.0) & (u <= self._shape[1] - 1.0)
        ahead = finite_rows(self._road.from_image(marking.line_px[seen]))[:, 1]
        if len(ahead) == 0:
            return ahead.reshape(0, 2)
        y = marking.points[:, 1]
        return marking.points[(y >= ahead.min()) & (y <= ahead.max())]

    def _image_lane(self, found: Pair, trapezoid_px: Float[np.ndarray, "4 2"], height: int) -> ImageLane:
        left, right = (None if marking is None else marking.line_px for marking in found)
        point_px = self._vanishing.point_px
        if point_px is not None:
            left, right = (
                None if line is None else continue_line(line, point_px, height) for line in (left, right)
            )
        memory = tuple(
            straight_px(line, trapezoid_px)
            for line, marking in zip(self._earlier, found, strict=True)
            if line is not None and marking is None
        )
        return ImageLane(left, right, memory, filled=True, text=self.lane.text)

    def _steering_rad(self, found: Pair, trapezoid_px: Float[np.ndarray, "4 2"]) -> float:
        left, right = found
        if left is None or right is None:
            return float("nan")
        if self.camera is not None:
            look_ahead_cm = self.settings.look_ahead_cm
            if look_ahead_cm is None:
                look_ahead_cm = _LOOK_AHEAD_HEIGHTS * self.camera.mounting.height_cm
            aim = find_aim_cm(found, look_ahead_cm)
            return float("nan") if aim is None else proportional_angle_rad(*aim)
        bottom = float(trapezoid_px[2, 1])
        row = 0.5 * (float(trapezoid_px[0, 1]) + bottom)
        lines = (left.line_px, right.line_px)
        middle = 0.5 * sum(float(np.interp(-row, -line[:, 1], line[:, 0])) for line in lines)
        start = 0.5 * float(trapezoid_px[2, 0] + trapezoid_px[3, 0])
        return math.atan2(start - middle, bottom - row)


def _with_road_settings(settings: PainterSettings) -> PainterSettings:
    """The settings for roads, where those that were given do not say otherwise."""
    given = settings.model_dump(exclude_unset=True)
    for name, values in ROAD.items():
        given[name] = {**values, **given.get(name, {})}
    return PainterSettings.model_validate(given)


KIND = DetectorKind(
    "painter",
    lambda inputs: LanePainter(inputs.camera, inputs.settings(PainterSettings)),
    settings=PainterSettings,
    needs_camera=False,
)
