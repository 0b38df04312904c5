"""Find the lane lines of a segment: edges along the driven path, traced and fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.lanes.fit import FitSettings, fit_lines
from datagen.lanes.kinks import with_kinks
from datagen.lanes.markings import TraceSettings
from datagen.lanes.path import Path, edges_on_map, shared_path, without_frames
from datagen.lanes.profile import without_crossings
from datagen.lanes.scale import AHEAD_HEIGHTS, STEP_HEIGHTS, edges_of_segment
from datagen.lanes.trace import (
    LEAST_SEEN,
    MAYBE_LINE,
    TracedLane,
    has_dark_markings,
    trace_adjacent,
    trace_known_lane,
    trace_lane,
)
from datagen.lanes.widths import marking_widths
from datagen.slam.segment import SolvedSegment
from lanenet.data.drives import Drive
from lanenet.data.maps.line import LaneLine
from lanenet.errors import NoLaneError
from lanenet.geometry.lane import SIDES

#: Distance ahead of a frame up to which its edges count in any case, in lane widths. Derived: in a wide lane,
#: the further line only comes into view one width ahead, the far line of the adjacent lane half a width
#: later.
_OWN_LANE_REACH, _NEXT_LANE_REACH = 1.2, 1.6
#: Share of the path along which a line is painted: with less, it is marks on the floor that were joined.
#: Chosen: short dashes leave a third, and on a floor without lines it was a quarter.
_PAINTED = 0.3
#: Distance ahead of a frame up to which its edges show kinks, in camera heights. Chosen: further ones
#: scatter.
_KINK_HEIGHTS = 3.0


@dataclass(frozen=True)
class MappedSegment:
    """A segment with its lane, in the scale of its camera.

    Attributes:
        solved: Poses and scans.
        s_frames_cm: Position of each frame along the driven path.
        laps: Lap of each frame, from 0.
        lane: The traced lane.
        lines: Its two lines, then those of adjacent lanes.
        dark: Whether the markings are darker than the floor.
        free_lane_cm: Lane width found without the given one, if it fits better; else None.
        is_one_of_several: Whether the given width is that of several lanes, of which the car keeps to this.
    """

    solved: SolvedSegment
    s_frames_cm: Float[np.ndarray, "n"]
    laps: Int[np.ndarray, "n"]
    lane: TracedLane
    lines: list[LaneLine]
    dark: bool = False
    free_lane_cm: float | None = None
    is_one_of_several: bool = False

    @property
    def rows(self) -> Int[np.ndarray, "n"]:
        """Its frames, as positions in the drive."""
        return self.solved.rows


def find_lane(
    segment: SolvedSegment,
    lane_width_cm: float | None,
    held_out: Bool[np.ndarray, "n"],
    trace: TraceSettings,
    fit: FitSettings,
    dark: bool | None = None,
    least: tuple[float, float] = (0.0, 0.0),
) -> MappedSegment:
    """Find a segment's lane lines, in the scale of its camera.

    Args:
        segment: The segment.
        lane_width_cm: Width of the driven lane in that scale; None if unknown.
        held_out: Frames of the segment that are held out from the lines.
        trace: How lane lines are traced.
        fit: How cubics are fitted to them.
        dark: Whether the markings are darker than the floor; None if unknown.
        least: Narrowest lane that is found, see :func:`datagen.lanes.markings.find_lane_width`.

    Raises:
        NoLaneError: If no two lines run along the drive.
        CalibrationError: If two do, but at another distance than the lane width.
    """
    height = segment.camera.mounting.height_cm
    revisits = [(revisit.earlier, revisit.later) for revisit in segment.revisits_within_parts]
    step_cm, ahead_cm = STEP_HEIGHTS * height, AHEAD_HEIGHTS * height
    camera = segment.camera
    # Of a point as far behind the camera as the rear axle of a car whose camera is above the front axle.
    lead_cm = camera.mounting.lead_cm
    shared = shared_path(segment.poses, segment.part, revisits, step_cm, ahead_cm, height, lead_cm)
    scans, side_cm = without_frames(segment.scans, held_out), trace.side_heights * height
    path, edges = edges_of_segment(segment, scans, shared, _OWN_LANE_REACH * (lane_width_cm or 0.0))
    edges = without_crossings(path, edges, height, side_cm)
    if dark is None:
        dark = has_dark_markings(path, edges, height, trace)
    edges = edges.towards_dark() if dark else edges
    free_cm = None
    if lane_width_cm is None:
        lane = trace_lane(path, edges, height, None, trace, least)
    else:
        lane, free_cm = trace_known_lane(path, edges, height, lane_width_cm, trace)
    several = free_cm == lane.lane_cm
    # Also where the car drives near the line between the lanes.
    _, adjacent = edges_of_segment(segment, scans, path, _NEXT_LANE_REACH * lane.lane_cm)
    adjacent = without_crossings(path, adjacent.towards_dark() if dark else adjacent, height, side_cm)
    lane = trace_adjacent(path, adjacent, lane, height, trace)
    lines = fit_lines(path, edges, lane, height, fit, adjacent)
    near = edges_on_map(scans, segment.poses, camera.wheelbase_cm, _KINK_HEIGHTS * height, lead_cm)
    near = near.towards_dark() if dark else near
    lines = [with_kinks(line, near, height, lane.lane_cm) if line.rank == 0 else line for line in lines]
    lines = [replace(line, marking_at_cm=marking_widths(line, near, height)) for line in _in_order(lines)]
    free_cm = None if several else free_cm
    return MappedSegment(segment, path.s_frames_cm, _laps(segment, path), lane, lines, dark, free_cm, several)


def _in_order(lines: list[LaneLine]) -> list[LaneLine]:
    """Leave out lines of the next lanes that do not lie beyond those before them, and all beyond these."""
    found = {line.index: line for line in lines}
    first, last = 0, 1
    while first - 1 in found and found[first - 1].lies_left_of(found[first]):
        first -= 1
    while last + 1 in found and found[last].lies_left_of(found[last + 1]):
        last += 1
    return [line for line in lines if first <= line.index <= last]


def _laps(segment: SolvedSegment, path: Path) -> Int[np.ndarray, "n"]:
    """Number the laps from 0; where no part of the drive holds a whole one, by the way along the path."""
    if path.period_cm is None or segment.revisits_within_parts:
        return segment.laps
    # The car may roll back by less than a quarter of a lap; what it did in a long gap is unknown.
    back = 0.25 * path.period_cm
    gone = np.mod(np.diff(path.s_frames_cm, prepend=path.s_frames_cm[0]) + back, path.period_cm) - back
    return np.floor(np.maximum(np.cumsum(gone), 0.0) / path.period_cm).astype(np.int64)


def check_lane(segment: MappedSegment, drive: Drive) -> None:
    """Refuse a segment in which one of the lines is hardly seen.

    Raises:
        NoLaneError: Names the share of the path along which each line was seen, or says that they cross.
    """
    left, right = (next(x for x in segment.lines if x.rank == 0 and x.side == side) for side in SIDES)
    if not left.lies_left_of(right):
        raise NoLaneError(f"{drive.path}: the lines of the driven lane cross, expected one beside the other")
    share: dict[str, float] = {
        line.side: float(line.supported(segment.s_frames_cm).mean())
        for line in segment.lines
        if line.rank == 0
    }
    if min(share.values()) >= LEAST_SEEN:
        return
    painted = dict(zip(SIDES, segment.lane.seen, strict=True))
    no_line = max(share.values()) < MAYBE_LINE or max(painted.values()) < _PAINTED
    what, shown, least = ("no line", painted, _PAINTED) if no_line else ("one line only", share, LEAST_SEEN)
    found = ", ".join(f"the {side} one along {100.0 * shown[side]:.0f} % of the path" for side in SIDES)
    raise NoLaneError(
        f"{drive.path}: {what} bounds the driven lane: {found}, expected {100.0 * least:.0f} % for each"
    )
