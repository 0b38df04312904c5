"""Frames that show both markings in plain sight, where an answer beside them is without excuse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network.refinement import RoadBorders

#: An answer further from a marking that is in plain sight is off, [cm]. Chosen: a line over bare floor.
OFF_CM = 3.0

#: Looked at is the road between these, in sections of this length, [cm]: the label rows that a frame shows.
_NEAR_CM, _FAR_CM, _SECTION_CM = 12.0, 30.0, 3.0
#: Of the sections, this share shows both borders of a marking. Chosen: the gaps of worn tape, not of dashes.
_SHOWN = 0.6
#: A border lies at most so far from the middle of its marking, [cm]. Chosen: tape of 5 cm and a rough map.
_REACH_CM = 3.5
#: Cosine between the normal of an edge and that of the line. Chosen: 37 degrees.
_ALIGNED = 0.8


@dataclass(frozen=True)
class PlainSight:
    """What a detector says about the frames with both markings in plain sight.

    Attributes:
        frames: Frames with both markings in plain sight.
        answered: Of these, those with an answer on a row that they show.
        off: Of these, those with an answer more than ``OFF_CM`` off one of the markings.
    """

    frames: int
    answered: int
    off: int


def in_plain_sight(
    edges_cm: Float[np.ndarray, "n 2"], normals: Float[np.ndarray, "n 2"], label_cm: Float[np.ndarray, "6"]
) -> bool:
    """Say whether the edges of a frame show both borders of both lines.

    Args:
        edges_cm: Edge points, frame car.
        normals: Their unit normals, from dark to light or the other way round, but alike for all.
        label_cm: The six labels; a line without all three is not in plain sight.
    """
    borders = RoadBorders(RoadEdges(edges_cm, normals))
    y = borders.near.y
    section = np.floor((y - _NEAR_CM) / _SECTION_CM)
    looked_at = (y >= _NEAR_CM) & (y < _FAR_CM)
    wanted = _SHOWN * (_FAR_CM - _NEAR_CM) / _SECTION_CM
    if not np.isfinite(label_cm).all():
        return False
    for off_cm, along in zip(*borders.off_cm(label_cm.reshape(len(SIDES), -1)), strict=True):
        near = looked_at & (np.abs(off_cm) <= _REACH_CM) & (np.abs(along) >= _ALIGNED)
        # A light marking has one polarity, a dark one the other.
        shown = 0
        for side in (1.0, -1.0):
            sections = [
                set(section[near & (s * off_cm > 0.0) & (s * side * along > 0.0)]) for s in (1.0, -1.0)
            ]
            shown = max(shown, len(sections[0] & sections[1]))
        if shown < wanted:
            return False
    return True


def off_markings(
    answers_cm: Float[np.ndarray, "n 6"], labels_cm: Float[np.ndarray, "n 6"]
) -> Float[np.ndarray, "n"]:
    """Return how far each answer lies off a marking on the rows ahead, across it, [cm]; NaN without one."""
    lines = labels_cm.reshape(-1, len(SIDES), len(ROWS_CM))
    slope = (lines[..., 2] - lines[..., 0]) / (ROWS_CM[2] - ROWS_CM[0])
    across = np.abs(answers_cm.reshape(lines.shape) - lines) / np.sqrt(1.0 + slope * slope)[..., None]
    # No frame shows the first row.
    ahead = across[..., 1:].reshape(len(lines), -1)
    known = np.isfinite(ahead)
    return np.where(known.any(axis=1), np.where(known, ahead, 0.0).max(axis=1), np.nan)


def count_off(
    answers_cm: Float[np.ndarray, "n 6"], labels_cm: Float[np.ndarray, "n 6"], plain: Bool[np.ndarray, "n"]
) -> PlainSight:
    """Count the frames in which a detector is off a marking that is in plain sight."""
    off_cm = off_markings(answers_cm[plain], labels_cm[plain])
    return PlainSight(int(plain.sum()), int(np.isfinite(off_cm).sum()), int((off_cm > OFF_CM).sum()))
