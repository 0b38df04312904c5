"""The lane width in the scale of a camera, with its uncertainty.

The scale itself is set in :mod:`datagen.assemble` and :mod:`datagen.calibrate_drive`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.lanes.fit import FitSettings, fit_lines
from datagen.lanes.markings import TraceSettings
from datagen.lanes.path import Path, PathEdges, edges_along_path, path_of_poses
from datagen.lanes.trace import TracedLane, has_dark_markings, trace_lane
from datagen.slam.camera.coarse import nudged
from datagen.slam.odometry.scans import Scans
from datagen.slam.segment import SolvedSegment
from lanenet.data.maps.line import LaneLine
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.lane import ROWS_CM, SIDES

#: Step of the path along which lines are looked for, its extension beyond the last frame, and the distance up
#: to which the edges of a frame count, in camera heights. The study of three recorded drives found lines
#: beyond 3.5 heights wrong; the extension covers what the last frame sees. Chosen: a step of 1.8 cm at 15 cm,
#: a dash is longer.
STEP_HEIGHTS, AHEAD_HEIGHTS, _REACH_HEIGHTS = 0.12, 5.0, 3.5
#: Length of lane that counts as one measurement of its width, in camera heights. Chosen: what one frame
#: shows.
_ALIKE_HEIGHTS = 3.0
#: Turns over one lane width up to which a lane is straight, and from which on it bends, [rad], and difference
#: between the widths of both beyond which a lane has two. Chosen: radii of ten and of three lane widths; tape
#: laid by hand varies at random, on three recorded drives by 2 % between bends and straights.
_STRAIGHT_RAD, _BEND_RAD, _WIDENS = 0.1, 0.3, 0.05
#: Step at which widths are compared, in lane widths. Chosen: finer than anything that changes them.
_COMPARED_LANES = 0.05
#: Ratio of the widest to the narrowest tenth of a lane without a straight from which on its width is open.
#: Chosen: tape laid by hand on a recorded drive varies by 1.14.
_VARIES = 1.2
#: Distances ahead of the lens at which errors of the camera act on the lane's width, in camera heights: from
#: the bumper to the reach of edges.
_ROWS_HEIGHTS = np.linspace(1.0, 3.5, 11)


@dataclass(frozen=True)
class LaneScale:
    """The driven lane's width in the scale of a camera.

    Attributes:
        width_cm: Distance between the middles of its two lines.
        sigma: Relative standard deviation, including that of the camera's parameters.
    """

    width_cm: float
    sigma: float


@dataclass(frozen=True)
class LaneWidth:
    """The driven lane's width as its two lines show it.

    Attributes:
        width_cm: Distance between their middles: that of the straights, where people measure it, if it is
            another one in bends; else the median.
        bend_cm: Width in bends, if it is another one there; else None.
        open_cm: Narrowest and widest tenth of a lane of many widths that has no straight; else None.
    """

    width_cm: float
    bend_cm: float | None = None
    open_cm: tuple[float, float] | None = None

    def scaled(self, factor: float) -> LaneWidth:
        """Return it with every length multiplied by a factor."""
        bend_cm = None if self.bend_cm is None else factor * self.bend_cm
        open_cm = None if self.open_cm is None else (factor * self.open_cm[0], factor * self.open_cm[1])
        return LaneWidth(factor * self.width_cm, bend_cm, open_cm)


def _two_lines(lines: list[LaneLine]) -> list[LaneLine]:
    """The left and the right line of the driven lane."""
    return [next(x for x in lines if x.side == side and x.rank == 0) for side in SIDES]


def spacing_cm(lines: list[LaneLine], s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Distances between the two lines of the driven lane at positions; NaN where one of them is not seen."""
    left, right = _two_lines(lines)
    return np.asarray(np.linalg.norm(left.points(s_cm) - right.points(s_cm), axis=1))


def fitted_width(lines: list[LaneLine], lane: TracedLane, s_cm: Float[np.ndarray, "m"]) -> LaneWidth:
    """Width of a lane from its fitted lines; without them from tracing, accurate to a cell (2 %).

    Args:
        lines: The fitted lines.
        lane: The traced lane.
        s_cm: Positions of the frames.
    """
    apart = spacing_cm(lines, s_cm)
    if not np.isfinite(apart).any():
        return LaneWidth(lane.lane_cm)
    width_cm = float(np.nanmedian(apart))
    period_cm = lines[0].period_cm
    step_cm = _COMPARED_LANES * width_cm
    at_cm = np.arange(s_cm.min(), s_cm.max() if period_cm is None else s_cm.min() + period_cm, step_cm)
    apart = spacing_cm(lines, at_cm)
    turn = np.abs(
        wrap_angle(_heading(lines, at_cm + 0.5 * width_cm) - _heading(lines, at_cm - 0.5 * width_cm))
    )
    known = np.isfinite(apart)
    straight, bend = apart[known & (turn <= _STRAIGHT_RAD)], apart[known & (turn >= _BEND_RAD)]
    least = round(1.0 / _COMPARED_LANES)
    if not known.any():
        return LaneWidth(width_cm)
    if len(straight) < least:
        low, high = (float(q) for q in np.percentile(apart[known], [10.0, 90.0]))
        return LaneWidth(width_cm, open_cm=(low, high) if high > _VARIES * low else None)
    if len(bend) < least or abs(float(np.median(bend) / np.median(straight)) - 1.0) <= _WIDENS:
        return LaneWidth(width_cm)
    return LaneWidth(_densest_cm(straight), float(np.median(bend)))


def _heading(lines: list[LaneLine], s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Heading of the driven lane."""
    left, right = _two_lines(lines)
    along = left.everywhere(s_cm, 1) + right.everywhere(s_cm, 1)
    return np.asarray(np.arctan2(along[:, 1], along[:, 0]))


def _densest_cm(widths_cm: Float[np.ndarray, "m"]) -> float:
    """Mean of the half of the widths that lie closest together: lanes begin to widen before a bend."""
    ordered = np.sort(widths_cm)
    half = (len(ordered) + 1) // 2
    first = int(np.argmin(ordered[half - 1 :] - ordered[: len(ordered) - half + 1]))
    return float(ordered[first : first + half].mean())


def edges_of_segment(
    solved: SolvedSegment, scans: Scans, path: Path | None = None, least_reach_cm: float = 0.0
) -> tuple[Path, PathEdges]:
    """Express the edges of a segment in coordinates along the driven path, in the scale of its camera.

    Args:
        solved: The segment.
        scans: Its edge points, or those of some of its frames.
        path: The path; None takes that of the poses.
        least_reach_cm: Edges up to this distance from a frame count in any case.
    """
    height = solved.camera.mounting.height_cm
    if path is None:
        path = path_of_poses(solved.poses, STEP_HEIGHTS * height, AHEAD_HEIGHTS * height)
    reach_cm = max(_REACH_HEIGHTS * height, least_reach_cm)
    camera = solved.camera
    lead_cm = camera.mounting.lead_cm
    return path, edges_along_path(path, scans, solved.poses, camera.wheelbase_cm, reach_cm, lead_cm)


def measure_lane(
    solved: SolvedSegment, sigma: dict[str, float], trace: TraceSettings, fit: FitSettings
) -> LaneScale:
    """Find the driven lane of a segment and measure its width.

    Args:
        solved: The segment, with its camera.
        sigma: Sigmas of the camera's parameters, see
            :class:`datagen.slam.adjustment.adjust.BundleResult`.
        trace: How lane lines are traced.
        fit: How cubics are fitted to them.

    Raises:
        NoLaneError: If no two lines run along the drive.
    """
    height = solved.camera.mounting.height_cm
    path, edges = edges_of_segment(solved, solved.scans)
    edges = edges.towards_dark() if has_dark_markings(path, edges, height, trace) else edges
    lane = trace_lane(path, edges, height, None, trace)
    lines = fit_lines(path, edges, lane, height, fit)
    width = fitted_width(lines, lane, path.s_frames_cm)
    width_cm = width.width_cm
    both = spacing_cm(lines, path.s_cm)
    both = both[np.isfinite(both)]
    spread = 1.4826 * float(np.median(np.abs(both - width_cm))) if both.size else 0.1 * width_cm
    count = max(1.0, both.size * STEP_HEIGHTS / _ALIKE_HEIGHTS)
    by_camera = width_sigma(solved.camera, sigma, width_cm)
    by_place = 0.0 if width.open_cm is None else 0.5 * (width.open_cm[1] - width.open_cm[0]) / width_cm
    by_chance = spread / width_cm / np.sqrt(count)
    return LaneScale(width_cm, float(np.linalg.norm([by_chance, by_camera, by_place])))


def width_sigma(camera: Camera, sigma: dict[str, float], lane_cm: float) -> float:
    """Relative sigma of a lane's width that follows from the sigmas of the camera's parameters.

    A straight lane is projected by the camera, and measured by a camera with one parameter changed.
    Parameters are taken as independent. Errors of focal length and pitch cancel in part, so this is an upper
    bound.

    Args:
        camera: The camera.
        sigma: Sigmas of its parameters.
        lane_cm: Width of the lane.

    Source:
        Own derivation, checked against the widths found in simulated drives.
    """
    m = camera.mounting
    y_cm = m.ahead_of_front_axle_cm + _ROWS_HEIGHTS * m.height_cm
    sides = [np.stack([np.full(y_cm.shape, 0.5 * sign * lane_cm), y_cm], axis=1) for sign in (-1.0, 1.0)]
    pixels = camera.project_ground(np.concatenate(sides))
    changes = []
    for name, spread in sigma.items():
        left, right = np.split(nudged(camera, name, spread).intersect_ground(pixels), 2)
        widths = np.linalg.norm(right - left, axis=1) / lane_cm
        changes.append(float(np.nanmean(widths)) - 1.0 if np.isfinite(widths).any() else 1.0)
    return float(np.linalg.norm(changes))


def ahead_sigma(camera: Camera, sigma: dict[str, float]) -> float:
    """Sigma of distances ahead of the car at the far label row that the sigmas of the camera leave, [cm].

    It is that of the focal length and of the camera's place ahead of the rear axle. The sigma of the pitch is
    left out: its error comes with one of the focal length that takes it back, and with another scale.

    Args:
        camera: The camera, in centimetres.
        sigma: Sigmas of its parameters, none for a given camera.

    Source:
        Own derivation. In 60 simulated drives labels with errors of 3 cm and more were mostly those of lines
        that cross the far row steeply, by these two numbers.
    """
    m = camera.mounting
    by_focal = sigma.get("focal", 0.0) * (ROWS_CM[-1] - m.ahead_of_front_axle_cm)
    return float(np.hypot(sigma.get("lever", 0.0) * m.height_cm, by_focal))
