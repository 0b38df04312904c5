"""Suto's lane line tracker as a detector; its last stage, from lines to a steering angle, is here as well.

Angles are in degrees, positive left; coordinates as in :mod:`lanenet.perception.hough.lines`. Two places of
the paper are ambiguous:

- Eq. 11, 13 and 14 measure the horizontal distance between c1 and a line's point pa, whose y is 0: the *top*
  of the region. That is what the text says twice, and it is the default; ``distance_row: bottom`` measures it
  on c1's own row instead.
- Eq. 12 names its result theta_t, like eq. 15. Since the update by eq. 15 follows "at the end of the last
  stage" in every case, eq. 12 is taken for the current angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS
from lanenet.perception.edges.canny import check_size
from lanenet.perception.estimate import DetectorKind, LaneEstimate
from lanenet.perception.hough import lines
from lanenet.perception.hough.edges import HoughEdgeSettings, find_contours
from lanenet.perception.hough.lines import (
    HoughLineSettings,
    Line,
    Point,
    Segment,
    centre_on_marking,
    choose_lines,
)
from lanenet.perception.image_lane import (
    ImageLane,
    Polyline,
    rows_on_road,
    sample_segment,
    to_bgr,
)

#: A tracker that steers in fewer frames than this share has the wrong settings. Chosen.
_FEW = 0.05


class HoughSteeringSettings(Settings):
    """Weights of the steering angle (section 4.4).

    Attributes:
        vanishing_weight: Weight of the vanishing point's angle, eq. 8.
        distance_weight: Weight of the distances' angle, eq. 8.
        gain_deg: The 60 of eq. 11, 13 and 14.
        angle_smoothing: w1 of eq. 15.
        line_smoothing: w2 of eq. 16.
        distance_row: Row on which the distances of eq. 11, 13 and 14 are measured.
        max_jump_px: A single line whose distance differs by more than this from its side's last one is
            another line and changes nothing (eq. 13, 14). Not in the paper; None is the paper's.
        max_angle_deg: Bound of the current angle, that of eq. 11; eq. 13 and 14 have none of their own.
        hold_frames: A side that so many frames did not show is forgotten; with the last side, so is the
            angle, which is held until then. None holds for ever, as the paper does.
    """

    vanishing_weight: float = Field(default=0.8, ge=0.0)
    distance_weight: float = Field(default=0.2, ge=0.0)
    gain_deg: float = Field(default=60.0, gt=0.0)
    angle_smoothing: float = Field(default=0.1, gt=0.0, le=1.0)
    line_smoothing: float = Field(default=0.05, gt=0.0, le=1.0)
    distance_row: Literal["top", "bottom"] = "top"
    max_jump_px: float | None = Field(default=10.0, ge=0.0)
    max_angle_deg: float = Field(default=60.0, gt=0.0, le=180.0)
    hold_frames: int | None = Field(default=10, ge=0)


class HoughSettings(Settings):
    """Suto's tracker; the defaults are the paper's where it gives one."""

    edges: HoughEdgeSettings = HoughEdgeSettings()
    lines: HoughLineSettings = HoughLineSettings()
    steering: HoughSteeringSettings = HoughSteeringSettings()


@dataclass(frozen=True)
class SideMemory:
    """Memory of one side.

    Attributes:
        line: Averaged line, eq. 16.
        distance_px: dnx or dpx of the last frame that showed the side, d of t-1 in eq. 13 and 14.
        missed: Frames since then.
    """

    line: Line
    distance_px: float
    missed: int = 0


@dataclass(frozen=True)
class HoughState:
    """State that is carried from frame to frame: a memory per side and the smoothed angle (eq. 15).

    Attributes:
        left: The left side; None before the first left line and when it is forgotten.
        right: The right side.
        steering_deg: Smoothed angle, positive left; None until a pair of lines was seen.
    """

    left: SideMemory | None = None
    right: SideMemory | None = None
    steering_deg: float | None = None

    @property
    def lines(self) -> tuple[Line | None, Line | None]:
        """The averaged lines."""
        return (
            None if self.left is None else self.left.line,
            None if self.right is None else self.right.line,
        )


class HoughTracker:
    """Frame in, lane out, by the lines of the Hough transform; frames are scaled to the paper's size.

    A frame of less than half that size gives an empty estimate.

    With a camera the visible sections of the lines are moved to the road; without one the points are NaN. The
    confidence is the share of the two lines that this frame shows: 1, 0.5 or 0. A frame without lines keeps
    the steering of the frames before (the paper's third case) with confidence 0, until both sides are
    forgotten. A single line changes a known steering; before the first pair there is none.

    Attributes:
        last: Lines of the last frame in the image; the remembered ones beside them.
        state: What is carried to the next frame.
    """

    def __init__(self, camera: Camera | None = None, settings: HoughSettings | None = None) -> None:
        """Build the tracker; without a camera it answers with steering and lines of the image only."""
        self.camera = camera
        self.settings = HoughSettings() if settings is None else settings
        self.last = ImageLane()
        self.state = HoughState()
        self._frames = self._frames_steered = 0

    def reset(self) -> None:
        """Forget lines and steering of earlier frames."""
        self.state = HoughState()
        self.last = ImageLane()

    @property
    def hint(self) -> str:
        """What to try where the frames so far, across resets, gave nearly no steering; else empty."""
        if self.settings.edges.channel != "hue" or self._frames_steered >= _FEW * self._frames:
            return ""
        return (
            f"hough steers in {self._frames_steered} of {self._frames} frames; the hue says little "
            "about white lines and gray floors: --config configs/detectors/hough_value.yaml looks at the "
            "brightness"
        )

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w *c"]) -> LaneEstimate:
        """Find the lane in one frame.

        Raises:
            DriveFormatError: If the array is not an image of one or three uint8 channels.
            CalibrationError: If the frame's size is not the camera's.
        """
        frame = to_bgr(frame_bgr)
        check_size(frame, self.camera)
        left, right = self.find_lines(frame)
        steered = self.track(left, right)
        self._frames += 1
        self._frames_steered += steered is not None
        self.last = self._image_lane(left, right, frame.shape)
        points = np.full((2, N_POINTS // 2), np.nan)
        if self.camera is not None:
            for side, seen in enumerate((left, right)):
                if seen is not None:
                    points[side] = rows_on_road(self._to_frame(seen, frame.shape), self.camera)
        return LaneEstimate(
            points_cm=points.reshape(N_POINTS),
            steering_rad=float("nan") if steered is None else math.radians(steered),
            confidence=0.5 * (left is not None) + 0.5 * (right is not None),
            lines_px=self.last.numbers_px(frame.shape[1], frame.shape[0]),
        )

    def find_lines(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> tuple[Segment | None, Segment | None]:
        """Choose the left and the right line of a frame (sections 4.1 to 4.3); the state stays as it is."""
        settings = self.settings.lines
        edges = self.settings.edges
        if 2 * frame_bgr.shape[1] < edges.width_px or 2 * frame_bgr.shape[0] < edges.height_px:
            # Enlarged by more than 2, single pixels would become lines.
            return None, None
        contours = find_contours(frame_bgr, edges)
        segments = lines.find_lane_segments(contours, settings)
        width, height = self._size
        left, right = lines.split_sides(segments, width, height, settings)
        chosen = choose_lines(left, right, self.state.lines, width, height, settings)
        if not settings.middle:
            return chosen
        left_line, right_line = (
            None if line is None else centre_on_marking(line, contours, edges.threshold, settings)
            for line in chosen
        )
        return left_line, right_line

    def track(self, left: Segment | None, right: Segment | None) -> float | None:
        """Turn a frame's lines into the smoothed angle and update the state (section 4.4).

        Returns:
            The steering angle, [deg], positive left; None where no pair was seen so far.
        """
        settings, state = self.settings.steering, self.state
        angle = state.steering_deg
        current = self._current_deg(left, right)
        if current is not None:
            # The relative changes of eq. 13 and 14 have no bound where a line passes near c1.
            bounded = min(max(current, -settings.max_angle_deg), settings.max_angle_deg)
            angle = smooth_angle_deg(bounded, angle, settings.angle_smoothing)
        sides = self._remember(left, state.left), self._remember(right, state.right)
        self.state = HoughState(*sides, angle) if any(sides) else HoughState()
        return self.state.steering_deg

    def _remember(self, seen: Segment | None, earlier: SideMemory | None) -> SideMemory | None:
        """Update the memory of one side (eq. 16), or let it age."""
        settings = self.settings.steering
        if seen is not None:
            average = None if earlier is None else earlier.line
            line = smooth_line(seen.line, average, settings.line_smoothing)
            return SideMemory(line, self._distance_px(seen))
        if earlier is None or (settings.hold_frames is not None and earlier.missed >= settings.hold_frames):
            return None
        return replace(earlier, missed=earlier.missed + 1)

    def _current_deg(self, left: Segment | None, right: Segment | None) -> float | None:
        """Angle of this frame by eq. 8, or by eq. 12 where it shows one line; None where neither is known."""
        settings, state = self.settings.steering, self.state
        if left is not None and right is not None:
            width, height = self._size
            c1, c2 = (0.5 * width, height), (0.5 * width, 0.0)
            vp = lines.vanishing_point(left.line, right.line)
            distances = self._distance_px(left), self._distance_px(right)
            return combine_angles(
                vanishing_angle_deg(vp, c1, c2),
                distance_angle_deg(*distances, settings.gain_deg),
                settings,
            )
        if state.steering_deg is None or (left is None and right is None):
            return None
        change = 0.0
        segment, earlier = (left, state.left) if left is not None else (right, state.right)
        if segment is not None and earlier is not None:
            distance, before = self._distance_px(segment), earlier.distance_px
            if settings.max_jump_px is None or abs(distance - before) <= settings.max_jump_px:
                change = change_by_line_deg(distance, before, settings.gain_deg)
        # Eq. 12.
        return state.steering_deg + (change if left is not None else -change)

    def _distance_px(self, segment: Segment) -> float:
        """Return dnx or dpx (below eq. 10): the distance along x between c1 and the line, on one row."""
        width, height = self._size
        row = 0.0 if self.settings.steering.distance_row == "top" else height
        return abs(lines.x_at(segment.line, row) - 0.5 * width)

    @property
    def _size(self) -> tuple[float, float]:
        """Width and height of the region of interest, [px]."""
        return float(self.settings.edges.width_px), float(self.settings.edges.roi_height_px)

    def _image_lane(self, left: Segment | None, right: Segment | None, shape: tuple[int, ...]) -> ImageLane:
        """Carry lines of the region of interest back to the frame of this shape."""
        edges = self.settings.edges

        def polyline(line: Line) -> Polyline | None:
            # Straight through the whole region, as the paper takes it, or up to where the line leaves it.
            ends = []
            for y in (edges.roi_height_px - 1.0, 0.0):
                x = min(max(lines.x_at(line, y), 0.0), edges.width_px - 1.0)
                ends.append((x, line.m * x + line.b))
            whole = Segment(*ends[0], *ends[1])
            inside = all(-1.0 <= y <= edges.roi_height_px for _, y in ends)
            return self._to_frame(whole, shape) if inside and ends[0] != ends[1] else None

        memory = (polyline(line) for line in self.state.lines if line is not None)
        return ImageLane(
            None if left is None else polyline(left.line),
            None if right is None else polyline(right.line),
            tuple(line for line in memory if line is not None),
        )

    def _to_frame(self, segment: Segment, shape: tuple[int, ...]) -> Polyline:
        """Carry a segment of the region of interest back to the frame of this shape, near to far."""
        edges = self.settings.edges
        sx, sy = shape[1] / edges.width_px, shape[0] / edges.height_px
        ends = [
            ((x + 0.5) * sx - 0.5, (y + edges.roi_top_px + 0.5) * sy - 0.5)
            for x, y in ((segment.x1, segment.y1), (segment.x2, segment.y2))
        ]
        return sample_segment(ends[0], ends[1])


def combine_angles(vanishing_deg: float, distance_deg: float, settings: HoughSteeringSettings) -> float:
    """Return theta_curr = 0.8 theta_vp + 0.2 theta_d.

    Source:
        Suto 2021, eq. 8.
    """
    return settings.vanishing_weight * vanishing_deg + settings.distance_weight * distance_deg


def vanishing_angle_deg(vp: Point, c1: Point, c2: Point) -> float:
    """Return the angle at c1 between the centre line and the vanishing point, positive left.

    a = vp - c1 and b = c2 - c1 are vectors; the printed formula lost the comma between their components. A
    vanishing point at c1 itself has no direction and gives 0.

    Source:
        Suto 2021, eq. 10.
    """
    a = (vp[0] - c1[0], vp[1] - c1[1])
    b = (c2[0] - c1[0], c2[1] - c1[1])
    norm = math.hypot(*a) * math.hypot(*b)
    if norm == 0.0:
        return 0.0
    # Rounding may carry the cosine beyond 1.
    angle = math.degrees(math.acos(max(-1.0, min(1.0, (a[0] * b[0] + a[1] * b[1]) / norm))))
    return -angle if vp[0] > c2[0] else angle


def distance_angle_deg(dnx: float, dpx: float, gain_deg: float) -> float:
    """Return the angle that centres the car between the lines: 60 (dnx - dpx) / (dpx + dnx), positive left.

    The two cases of the paper are the same formula. Two lines through c1 itself give 0.

    Args:
        dnx: Horizontal distance of the left (negative) line, [px], not negative.
        dpx: Horizontal distance of the right (positive) line.
        gain_deg: 60 in the paper.

    Source:
        Suto 2021, eq. 11.
    """
    total = dpx + dnx
    return gain_deg * (dnx - dpx) / total if total > 0.0 else 0.0


def change_by_line_deg(distance: float, previous: float, gain_deg: float) -> float:
    """Return theta_delta of a left line: towards it (left, positive) as its distance grows.

    That of a right line has the opposite sign. An earlier distance of 0 gives 0.

    Source:
        Suto 2021, eq. 13 and 14.
    """
    # The paper's two cases are one formula.
    return gain_deg * (distance - previous) / previous if previous > 0.0 else 0.0


def smooth_angle_deg(current_deg: float, previous_deg: float | None, w1: float) -> float:
    """Return theta_t = w1 theta_curr + (1 - w1) theta_{t-1}; the current one where there is none before.

    Source:
        Suto 2021, eq. 15.
    """
    return current_deg if previous_deg is None else w1 * current_deg + (1.0 - w1) * previous_deg


def smooth_line(current: Line, previous: Line | None, w2: float) -> Line:
    """Return m_t and b_t by the same average with w2; the current line where there is none before.

    Source:
        Suto 2021, eq. 16.
    """
    if previous is None:
        return current
    return Line(w2 * current.m + (1.0 - w2) * previous.m, w2 * current.b + (1.0 - w2) * previous.b)


KIND = DetectorKind(
    "hough",
    lambda inputs: HoughTracker(inputs.camera, inputs.settings(HoughSettings)),
    settings=HoughSettings,
    needs_camera=False,
    # On most floors the paper's hue is noise, while the brightness shows the lines.
    variants={"hough-value": {"edges": {"channel": "value", "threshold": 75}}},
)
