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
from lanenet.geometry.lane import SIDES

#: Step of the path along which lines are looked for, its extension beyond the last frame, and the distance up
#: to which the edges of a frame count, in camera heights. The study of three recorded drives found lines
#: beyond 3.5 heights wrong; the extension covers what the last frame sees. Chosen: a step of 1.8 cm at 15 cm,
#: a dash is longer.
STEP_HEIGHTS, AHEAD_HEIGHTS, _REACH_HEIGHTS = 0.12, 5.0, 3.5
#: Length of lane that counts as one measurement of its width, in camera heights. Chosen: what one frame
#: shows.
_ALIKE_HEIGHTS = 3.0
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


def spacing_cm(lines: list[LaneLine], s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "k"]:
    """Distances between the two lines of the driven lane at positions where both are seen."""
    left, right = (next(x for x in lines if x.side == side and x.rank == 0) for side in SIDES)
    apart = np.linalg.norm(left.points(s_cm) - right.points(s_cm), axis=1)
    return apart[np.isfinite(apart)]


def fitted_width_cm(lines: list[LaneLine], lane: TracedLane, s_cm: Float[np.ndarray, "m"]) -> float:
    """Width of a lane from its fitted lines; without them from tracing, accurate to a cell (2 %)."""
    apart = spacing_cm(lines, s_cm)
    return float(np.median(apart)) if apart.size else lane.lane_cm


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
    return path, edges_along_path(path, scans, solved.poses, solved.camera.wheelbase_cm, reach_cm)


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
        TrackingLostError: If no two lines run along the drive.
    """
    height = solved.camera.mounting.height_cm
    path, edges = edges_of_segment(solved, solved.scans)
    edges = edges.towards_dark() if has_dark_markings(path, edges, height, trace) else edges
    lane = trace_lane(path, edges, height, None, trace)
    lines = fit_lines(path, edges, lane, height, fit)
    width_cm = fitted_width_cm(lines, lane, path.s_frames_cm)
    both = spacing_cm(lines, path.s_cm)
    spread = 1.4826 * float(np.median(np.abs(both - width_cm))) if both.size else 0.1 * width_cm
    count = max(1.0, both.size * STEP_HEIGHTS / _ALIKE_HEIGHTS)
    by_camera = width_sigma(solved.camera, sigma, width_cm)
    return LaneScale(width_cm, float(np.hypot(spread / width_cm / np.sqrt(count), by_camera)))


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
