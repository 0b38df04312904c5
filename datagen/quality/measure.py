"""What the labels of a map hold, where its lines are wrong, and how its held-out frames compare with them."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from datagen.quality.evidence import PLACE_CM, LabelFeatures, around
from datagen.quality.residuals import Residuals, coverage, robust_sd
from datagen.quality.verdict import LabelEvidence
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.mapped_drive import (
    DELETED,
    NOT_MAPPED,
    NOT_TO_LABEL,
    OUTSIDE,
    MappedDrive,
    label_frames,
)
from lanenet.data.segments import true_runs
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.geometry.poses import path_lengths

#: Status of a frame, beside the reasons of :mod:`lanenet.data.maps.mapped_drive`; reports use these as keys.
LABELLED = "labelled"
#: Random stream for held-out frames, so that other draws do not depend on them.
_STREAM = 1
#: Length over which labels are taken together and below which a section is not named, in places. Chosen: half
#: a dash.
_SHORTEST = 5
#: Radius of the path below which it is a bend, length over which its turn is taken, and longest step that
#: counts as seen road, [cm]. Chosen: five times the tightest bend of a 1:10 car, and a label row.
_BEND_RADIUS_CM, _TURN_CM, _STEP_CM = 250.0, 30.0, 15.0


@dataclass(frozen=True)
class WrongSection:
    """A section of a line along which most labels are more likely off by 3 cm than not.

    Attributes:
        segment: Segment of the map.
        index: Number of the line, see :attr:`lanenet.data.maps.line.LaneLine.index`.
        section_cm: From and to along the line.
        frames: Frames that show it, as positions in the map.
    """

    segment: int
    index: int
    section_cm: tuple[float, float]
    frames: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the line: that of its side, seen in the path's direction."""
        return f"{SIDES[self.index > 0]} line{'' if self.index in (0, 1) else ' of the adjacent lane'}"

    @property
    def length_cm(self) -> float:
        """Length of the section."""
        return self.section_cm[1] - self.section_cm[0]

    def text(self, drive_map: DriveMap) -> str:
        """Say how long it is, and which frame shows it."""
        length = f"{self.length_cm:.0f} cm" if self.length_cm < 100.0 else f"{0.01 * self.length_cm:.1f} m"
        return f"{length} of the {self.name} near frame {drive_map.frames[self.frames[0]]}"


@dataclass(frozen=True, eq=False)
class MapQuality:
    """How well a map agrees with its frames.

    Attributes:
        held_out: Residuals of the held-out frames.
        status: Per frame of the drive: labelled, or the reason why not.
        points_cm: Six labels per frame of the map.
        labels: What they hold.
        wrong: Sections of the lines that are withheld, the longest first.
        wrong_share: Their share of the length along which the driven lane's lines have labels.
    """

    held_out: Residuals
    status: list[str]
    points_cm: Float[np.ndarray, "n 6"]
    labels: LabelEvidence
    wrong: tuple[WrongSection, ...]
    wrong_share: float

    def figures(self, drive_map: DriveMap) -> dict[str, Any]:
        """Return the figures of a report."""
        both = np.concatenate(self.held_out[:2])
        return {
            "held_out": {
                "frames": int(drive_map.held_out.sum()),
                "robust_sd_px_at_160": robust_sd(both),
                "coverage": coverage(both),
                "coverage_by_chance": coverage(self.held_out.chance),
            },
            "labels": asdict(self.labels),
            "withheld": {"share": self.wrong_share, "places": [one.text(drive_map) for one in self.wrong]},
        }


def frame_status(mapped: MappedDrive) -> tuple[list[str], Float[np.ndarray, "n 6"]]:
    """Tell which frames of a drive get labels, or why not, and return the labels of the map's frames."""
    status = [DELETED if deleted else NOT_MAPPED for deleted in mapped.drive.deleted]
    labels = label_frames(mapped, BirdseyeWindow())
    for row, reason in zip(mapped.rows.tolist(), labels.reasons, strict=True):
        status[row] = reason or LABELLED
    return status, labels.points_cm


def label_evidence(
    drive_map: DriveMap, status: list[str], points_cm: Float[np.ndarray, "n 6"], doubted: dict[str, float]
) -> LabelEvidence:
    """Collect what the labels of a map hold; the arguments are those of :class:`MapQuality`."""
    given, counts = np.isfinite(points_cm), Counter(status)
    way_cm, heading = path_lengths(drive_map.poses), drive_map.poses[:, 2]
    step_m = 0.01 * np.minimum(np.diff(way_cm, prepend=0.0), _STEP_CM) * given.any(axis=1)
    ahead = np.minimum(np.searchsorted(way_cm, way_cm + _TURN_CM), len(way_cm) - 1)
    bend = (heading[ahead] - heading) * _BEND_RADIUS_CM / _TURN_CM
    places = np.stack([points_cm, np.broadcast_to(np.tile(ROWS_CM, len(SIDES)), given.shape)], axis=-1)[given]
    errors, seen = drive_map.errors, drive_map.camera.shows_ground(places)
    off_1, off_3, in_view = (
        float(each.mean()) if len(each) else float("nan")
        for each in (errors.off_1[given], errors.off_3[given], seen)
    )
    frames = sum(n for why, n in counts.items() if why not in NOT_TO_LABEL)
    return LabelEvidence(
        frames=frames,
        labelled=counts[LABELLED],
        off_1=off_1,
        off_3=off_3,
        metres=float(step_m.sum()),
        left_m=float(step_m[bend > 1.0].sum()),
        right_m=float(step_m[bend < -1.0].sum()),
        not_labelled={why: n for why, n in counts.most_common() if why not in (LABELLED, DELETED)},
        doubted=doubted,
        in_view=in_view,
        outside_share=counts[OUTSIDE] / max(frames + counts[OUTSIDE], 1),
    )


def wrong_sections(
    drive_map: DriveMap, features: LabelFeatures, errors: LabelErrors
) -> tuple[tuple[WrongSection, ...], float]:
    """Find the sections along which most labels of a line are more likely off by 3 cm than not.

    Returns:
        The sections, those of the driven lane first, the longest first; and their share of the length along
        which the driven lane's lines have labels.
    """
    found: list[WrongSection] = []
    seen = wrong = 0
    for segment, lines in drive_map.lines.items():
        for line in lines:
            mine = (features.line == line.index) & (drive_map.segment == segment)[:, None]
            frame, point = np.nonzero(mine & np.isfinite(errors.off_3))
            off = errors.off_3[frame, point] > 0.5
            (low, high), closed = line.span_cm, line.period_cm is not None
            count = max(1, round((high - low) / PLACE_CM))
            place_cm = (high - low) / count
            place = np.floor((features.s_cm[frame, point] - low) / place_cm).astype(np.int64)
            place = place % count if closed else np.clip(place, 0, count - 1)
            sums = np.stack(
                [np.bincount(place, minlength=count), np.bincount(place[off], minlength=count)], 1
            )
            of_all, of_wrong = around(sums, closed, _SHORTEST // 2).T
            against = of_wrong > 0.5 * of_all
            if line.rank == 0:
                seen, wrong = seen + int((of_all > 0).sum()), wrong + int(against.sum())
            for run in true_runs(against, closed):
                if len(run) >= _SHORTEST:
                    start = low + float(run[0]) * place_cm
                    shown = np.unique(frame[off & np.isin(place, run)])
                    section = (start, start + len(run) * place_cm)
                    found.append(WrongSection(segment, line.index, section, tuple(shown.tolist())))
    found.sort(key=lambda one: (one.index not in (0, 1), -one.length_cm))
    return tuple(found), wrong / max(seen, 1)


def held_out_frames(count: int, every: int, seed: int) -> Bool[np.ndarray, "n"]:
    """Choose every n-th frame; the seed decides the first one.

    Args:
        count: Number of frames of the drive.
        every: n; 0 chooses none.
        seed: Seed of the map's settings.
    """
    chosen = np.zeros(count, dtype=bool)
    if every:
        first = int(np.random.default_rng((seed, _STREAM)).integers(every))
        chosen[first::every] = True
    return chosen
