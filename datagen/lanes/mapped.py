"""A segment with its lane lines, and the check that both lines are seen."""

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

#: Share of the path above which a line is certain. Chosen: interruptions and worn places take a tenth at
#: most.
_WHOLE_LINE = 0.9


@dataclass(frozen=True)
class MappedSegment:
    """A segment with its lane, in the scale of its camera.

    Attributes:
        solved: Poses and scans.
        s_frames_cm: Position of each frame along the driven path.
        lane: The traced lane.
        lines: Its two lines, then those of adjacent lanes.
        free_lane_cm: Lane width found without the given one, if it fits better; else None.
    """

    solved: SolvedSegment
    s_frames_cm: Float[np.ndarray, "n"]
    lane: TracedLane
    lines: list[LaneLine]
    free_lane_cm: float | None = None

    @property
    def rows(self) -> Int[np.ndarray, "n"]:
        """Its frames, as positions in the drive."""
        return self.solved.rows


def check_lane(parts: list[MappedSegment], drive: Drive) -> None:
    """Refuse a map in which one of the lines is hardly seen.

    Raises:
        TrackingLostError: Names the share of the path along which each line was seen.
    """
    seen: dict[str, list[Bool[np.ndarray, "_"]]] = {side: [] for side in SIDES}
    for part in parts:
        for line in part.lines:
            if line.rank == 0:
                seen[line.side].append(line.supported(part.s_frames_cm))
    share = {side: float(np.mean(np.concatenate(found))) if found else 0.0 for side, found in seen.items()}
    if min(share.values()) >= LEAST_SEEN:
        return
    found = ", ".join(f"the {side} one along {100.0 * share[side]:.0f} % of the path" for side in SIDES)
    most = max(share.values())
    what = "no line" if most < MAYBE_LINE else "one line only" if most > _WHOLE_LINE else "one line at most"
    raise TrackingLostError(
        f"{drive.path}: {what} bounds the driven lane: {found}, expected {100.0 * LEAST_SEEN:.0f} % for each"
    )
