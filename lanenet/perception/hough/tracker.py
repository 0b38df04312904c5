"""Suto's lane line tracker as a detector."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.hough import lines, steering
from lanenet.perception.hough.edges import HoughEdgeSettings, find_contours
from lanenet.perception.hough.lines import HoughLineSettings, Line, Point, Segment
from lanenet.perception.hough.steering import HoughSteeringSettings
from lanenet.perception.image_lane import (
    ImageLane,
    Polyline,
    check_size,
    rows_on_road,
    sample_segment,
    to_bgr,
)


class HoughSettings(Settings):
    """Suto's tracker; the defaults are the paper's where it gives one."""

    edges: HoughEdgeSettings = HoughEdgeSettings()
    lines: HoughLineSettings = HoughLineSettings()
    steering: HoughSteeringSettings = HoughSteeringSettings()


@dataclass(frozen=True)
class HoughState:
    """What the tracker remembers: the averaged lines (eq. 16) and the smoothed angle (eq. 15).

    Attributes:
        left: Averaged left line; None before the first.
        right: Averaged right line.
        steering_deg: Smoothed angle, positive left; None until a pair of lines was seen.
        missed: Frames in a row without any line.
    """

    left: Line | None = None
    right: Line | None = None
    steering_deg: float | None = None
    missed: int = 0


class HoughTracker:
    """Frame in, lane out, by the lines of the Hough transform; frames are scaled to the paper's size.

    A frame of less than half that size gives an empty estimate.

    With a camera the lines chosen in the frame are moved to the road; they are contours, so each lies at an
    edge of its marking. Without one the points are NaN. The confidence is the share of the two lines that
    this frame shows: 1, 0.5 or 0. A frame without lines keeps the steering of the frames before (the paper's
    third case) for ``hold_frames`` frames, with confidence 0. A single line changes a steering that is
    known; before the first pair there is none.

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

    def reset(self) -> None:
        """Forget lines and steering of earlier frames."""
        self.state = HoughState()
        self.last = ImageLane()

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
        self.last = self._image_lane(left, right, frame.shape[1], frame.shape[0])
        points = np.full((2, N_POINTS // 2), np.nan)
        if self.camera is not None:
            for side, line_px in enumerate((self.last.left_px, self.last.right_px)):
                if line_px is not None:
                    points[side] = rows_on_road(line_px, self.camera)
        return LaneEstimate(
            points_cm=points.reshape(N_POINTS),
            steering_rad=float("nan") if steered is None else math.radians(steered),
            confidence=0.5 * (left is not None) + 0.5 * (right is not None),
        )

    def find_lines(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> tuple[Segment | None, Segment | None]:
        """Choose the left and the right line of a frame (sections 4.1 to 4.3); the state stays as it is."""
        settings = self.settings.lines
        edges = self.settings.edges
        if 2 * frame_bgr.shape[1] < edges.width_px or 2 * frame_bgr.shape[0] < edges.height_px:
            # Enlarged so much, single pixels would turn into lines.
            return None, None
        segments = lines.find_segments(find_contours(frame_bgr, edges), settings)
        width, height = self._size
        left, right = lines.split_sides(segments, width, height, settings)
        if left and right:
            earlier = (self.state.left, self.state.right)
            return lines.choose_pair(left, right, earlier, width, height, settings)
        if left:
            return lines.choose_single(left, self.state.left, width, height, settings), None
        if right:
            return None, lines.choose_single(right, self.state.right, width, height, settings)
        return None, None

    def track(self, left: Segment | None, right: Segment | None) -> float | None:
        """Turn a frame's lines into the smoothed angle and update the state (section 4.4).

        Returns:
            The steering angle, [deg], positive left; None where no pair was seen so far.
        """
        settings, state = self.settings.steering, self.state
        if left is None and right is None:
            held = state.missed < settings.hold_frames
            self.state = (
                HoughState(state.left, state.right, state.steering_deg, state.missed + 1)
                if held
                else HoughState()
            )
            return self.state.steering_deg
        current = self._current_deg(left, right)
        angle = state.steering_deg
        if current is not None:
            # The relative changes of eq. 13 and 14 know no bound where a line passes near c1.
            bounded = min(max(current, -settings.max_angle_deg), settings.max_angle_deg)
            angle = steering.smooth_angle_deg(bounded, angle, settings.angle_smoothing)
        w2 = settings.line_smoothing
        self.state = HoughState(
            state.left if left is None else steering.smooth_line(left.line, state.left, w2),
            state.right if right is None else steering.smooth_line(right.line, state.right, w2),
            angle,
        )
        return angle

    def _current_deg(self, left: Segment | None, right: Segment | None) -> float | None:
        """Angle of this frame by eq. 8, or by eq. 12 where it shows one line."""
        settings, state = self.settings.steering, self.state
        width, height = self._size
        c1, c2 = (0.5 * width, height), (0.5 * width, 0.0)
        row = 0.0 if settings.distance_row == "top" else height
        if left is not None and right is not None:
            vp = steering.vanishing_point(left.line, right.line)
            dnx = steering.horizontal_distance(left.line, c1, row)
            dpx = steering.horizontal_distance(right.line, c1, row)
            return steering.combine_angles(
                steering.vanishing_angle_deg(vp, c1, c2),
                steering.distance_angle_deg(dnx, dpx, settings.gain_deg),
                settings,
            )
        if state.steering_deg is None:
            return None
        segment, earlier = (left, state.left) if left is not None else (right, state.right)
        change = 0.0
        if segment is not None and earlier is not None:
            rule = steering.change_by_right_line_deg if left is None else steering.change_by_left_line_deg
            change = rule(
                steering.horizontal_distance(segment.line, c1, row),
                steering.horizontal_distance(earlier, c1, row),
                settings.gain_deg,
            )
        return steering.angle_of_one_line_deg(state.steering_deg, change)

    @property
    def _size(self) -> tuple[float, float]:
        """Width and height of the region of interest, [px]."""
        return float(self.settings.edges.width_px), float(self.settings.edges.roi_height_px)

    def _image_lane(
        self, left: Segment | None, right: Segment | None, frame_width: int, frame_height: int
    ) -> ImageLane:
        """Carry lines of the region of interest back to the frame that they were found in."""
        edges = self.settings.edges
        sx, sy = frame_width / edges.width_px, frame_height / edges.height_px

        def polyline(line: Line) -> Polyline | None:
            # Straight through the whole region, as the paper takes it, or up to where the line leaves it.
            ends: list[Point] = []
            for y in (edges.roi_height_px - 1.0, 0.0):
                x = min(max(lines.x_at(line, y), 0.0), edges.width_px - 1.0)
                y = line.m * x + line.b
                ends.append(((x + 0.5) * sx - 0.5, (y + edges.roi_top_px + 0.5) * sy - 0.5))
            inside = all(-1.0 <= v <= frame_height for _, v in ends)
            return sample_segment(ends[0], ends[1]) if inside and ends[0] != ends[1] else None

        memory = (polyline(line) for line in (self.state.left, self.state.right) if line is not None)
        return ImageLane(
            None if left is None else polyline(left.line),
            None if right is None else polyline(right.line),
            tuple(line for line in memory if line is not None),
        )
