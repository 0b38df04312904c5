"""Stretches of a drive -> segments with a lane; a stretch that cannot be mapped does not spoil the others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from datagen.lanes.fit import fit_lines
from datagen.lanes.mapped import MappedSegment, check_lane
from datagen.lanes.path import lap_path, without_frames
from datagen.lanes.profile import without_crossings
from datagen.lanes.scale import STEP_HEIGHTS, edges_beside
from datagen.lanes.trace import trace_adjacent, trace_known_lane, trace_lane
from datagen.settings import MapSettings
from datagen.slam.join import Stretch, frames_text, join_stretches
from datagen.slam.odometry.scans import Progress
from datagen.slam.segment import SolvedSegment, solve_segment
from lanenet.data.drives import Drive
from lanenet.errors import CalibrationError, TrackingLostError
from lanenet.geometry.camera import Camera


def map_stretches(
    drive: Drive,
    segments: list[slice],
    camera: Camera,
    solved: dict[int, SolvedSegment],
    lane_width_cm: float | None,
    held_out: Bool[np.ndarray, "n"],
    settings: MapSettings,
    rng: np.random.Generator,
    notes: list[str],
    progress: Progress | None,
) -> list[MappedSegment]:
    """Solve all stretches of a drive, join those that show the same places, and find their lanes.

    Args:
        drive: The drive.
        segments: Its stretches, as positions in it.
        camera: Camera of all of them.
        solved: Stretches that are solved already, by their place in ``segments``.
        lane_width_cm: Width of the driven lane in the scale of the camera; None where that is not known.
        held_out: Frames whose edge points have no say in the lines.
        settings: Settings of all stages.
        rng: Source of randomness.
        notes: Gets which stretches were joined, and which were left out and why.
        progress: Called with (done, total).

    Returns:
        At least one segment, in the order of their first frames.

    Raises:
        TrackingLostError: If no stretch can be mapped; says why the longest one cannot.
        CalibrationError: The same, where the longest one shows a lane of another width.
    """
    refused: list[tuple[np.ndarray, TrackingLostError | CalibrationError]] = []
    stretches = []
    for i, segment in enumerate(segments):
        rows = np.arange(segment.start, segment.stop)
        try:
            found = solved.get(i) or solve_segment(drive.subset(segment), camera, settings, rng, progress)
        except (TrackingLostError, CalibrationError) as error:
            refused.append((rows, error))
        else:
            stretches.append(Stretch(rows, found))
    parts = []
    for stretch in join_stretches(stretches, drive, settings, rng, notes):
        try:
            part = _find_lane(stretch, lane_width_cm, settings, held_out[stretch.rows])
            check_lane([part], drive)
        except (TrackingLostError, CalibrationError) as error:
            refused.append((stretch.rows, error))
        else:
            parts.append(part)
    if not parts:
        raise max(refused, key=lambda one: len(one[0]))[1]
    for rows, reason in refused:
        why = str(reason).removeprefix(f"{drive.path}: ")
        notes.append(f"{frames_text(drive, rows)} left out: {why}")
    return parts


def _find_lane(
    stretch: Stretch,
    lane_width_cm: float | None,
    settings: MapSettings,
    held_out: Bool[np.ndarray, "n"],
) -> MappedSegment:
    """Find a solved segment's lane lines, in the scale of its camera, without the frames held out."""
    solved = stretch.solved
    height = solved.camera.mounting.height_cm
    revisits = [(revisit.earlier, revisit.later) for revisit in solved.uninterrupted_revisits()]
    lap = lap_path(solved.poses, revisits, STEP_HEIGHTS * height, height)
    # In a wide lane the further line only comes into view a lane's width ahead.
    least_reach_cm = 1.2 * (lane_width_cm or 0.0)
    scans, side_cm = without_frames(solved.scans, held_out), settings.trace.side_heights * height
    path, edges = edges_beside(solved, scans, lap, least_reach_cm)
    edges = without_crossings(path, edges, height, side_cm)
    free_cm = None
    if lane_width_cm is None:
        lane = trace_lane(path, edges, height, None, settings.trace)
    else:
        lane, free_cm = trace_known_lane(path, edges, height, lane_width_cm, settings.trace)
    # The far line of the next lane does so further ahead, also where the car drives near the line between.
    _, beside = edges_beside(solved, scans, path, 1.6 * lane.lane_cm)
    beside = without_crossings(path, beside, height, side_cm)
    lane = trace_adjacent(path, beside, lane, height, settings.trace)
    lines = fit_lines(path, edges, lane, height, settings.fit, beside)
    return MappedSegment(stretch.rows, solved, path.s_frames_cm, lane, lines, free_cm)
