"""A segment of the drive with its lane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.lanes.trace import LEAST_SEEN, MAYBE_LINE, TracedLane
from datagen.slam.segment import SolvedSegment
from lanenet.data.drives import Drive
from lanenet.data.maps.line import LaneLine
from lanenet.errors import TrackingLostError
from lanenet.geometry.lane import SIDES

#: Seen along more of the path than this, it is a line.
_WHOLE_LINE = 0.9


@dataclass(frozen=True)
class MappedSegment:
    """A segment with its lane, in the scale of its camera.

    Attributes:
        rows: Frames of the drive that it covers, as positions among those that count.
        solved: Poses and scans.
        s_frames_cm: Position of each frame along the driven path.
        lane: The traced lane.
        lines: Its two lines, then those of the lanes beside it.
        free_lane_cm: Width of the lane as found without the user's number; None where that fails, or where
            the user's number was not used in the first place.
    """

    rows: Int[np.ndarray, "n"]
    solved: SolvedSegment
    s_frames_cm: Float[np.ndarray, "n"]
    lane: TracedLane
    lines: list[LaneLine]
    free_lane_cm: float | None = None


def check_lane(parts: list[MappedSegment], drive: Drive) -> None:
    """Refuse a map in which one of the lines is hardly ever seen.

    Raises:
        TrackingLostError: Says how much of the way each line was seen.
    """
    seen: dict[str, list[Bool[np.ndarray, "_"]]] = {side: [] for side in SIDES}
    for part in parts:
        for line in part.lines:
            if line.rank == 0:
                seen[line.side].append(line.supported(part.s_frames_cm))
    share = {side: float(np.mean(np.concatenate(found))) if found else 0.0 for side, found in seen.items()}
    if min(share.values()) >= LEAST_SEEN:
        return
    found = ", ".join(f"the {side} one along {100.0 * share[side]:.0f} % of the way" for side in SIDES)
    most = max(share.values())
    what = "no line" if most < MAYBE_LINE else "one line only" if most > _WHOLE_LINE else "one line at most"
    raise TrackingLostError(
        f"{drive.path}: {what} bounds the driven lane: {found}, expected {100.0 * LEAST_SEEN:.0f} % for each"
    )
