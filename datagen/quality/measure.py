"""Compare a map with its held-out frames, and find which frames get labels.

A held-out frame is left out of the lines only. Its edges are still used to find its own pose, without which
it could not be compared. So the comparison shows errors of the lines and of neighbouring poses relative to
its own, but not errors that all poses share.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import uniform_filter1d

from datagen.quality.evidence import LabelFeatures
from datagen.quality.residuals import (
    BANDS_CM,
    GATE_PX,
    BorderSamples,
    border_samples,
    frame_edges,
    join_samples,
    reference_scale,
    summarise,
)
from datagen.quality.verdict import LabelEvidence
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.mapped_drive import (
    DELETED,
    NOT_TO_LABEL,
    OUTSIDE,
    MappedDrive,
    label_frames,
    labelled_points,
    lines_at,
)
from lanenet.data.segments import true_runs
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.geometry.poses import path_lengths

#: Status of a frame, beside the reasons of :mod:`lanenet.data.maps.mapped_drive`; reports use these as keys.
NOT_MAPPED, LABELLED = "segment not mapped", "labelled"
#: Residuals up to this distance ahead count for the verdict. Chosen: the label rows and one row beyond.
VERDICT_REACH_CM = 45.0
#: Random stream for held-out frames, so that other draws do not depend on them.
_STREAM = 1
#: Least number of residuals for the median of a frame. Chosen: one border over 10 cm.
_MIN_SAMPLES = 10


#: Length of a place of a line, and length over which labels are taken together and below which a section is
#: not named, [cm]. Chosen: a tenth of a dash, half a dash.
_PLACE_CM, _SHORTEST_CM = 2.0, 10.0
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
        side, rank = (SIDES[0], -self.index) if self.index <= 0 else (SIDES[1], self.index - 1)
        return f"{side} line" + (" of the adjacent lane" if rank else "")

    @property
    def length_cm(self) -> float:
        """Length of the section."""
        return self.section_cm[1] - self.section_cm[0]


@dataclass(frozen=True, eq=False)
class MapQuality:
    """How well a map agrees with its frames.

    Attributes:
        held_out: Positions of the held-out frames in the map.
        samples: Samples on the borders of the lines, per held-out frame.
        chance: Samples of a line shifted into the middle of the lane, where no marking is.
        status: Per frame of the drive: labelled, or the reason why not.
        points_cm: Six labels per frame of the map.
        in_window: Which points a complete map would label; none for frames that are not to be labelled.
        wrong: Sections of the lines that are withheld, the longest first.
        wrong_share: Their share of the length along which the driven lane's lines have labels.
        doubted: See :attr:`datagen.quality.verdict.LabelEvidence.doubted`.
        scale: Reference pixels per pixel, see :func:`datagen.quality.residuals.reference_scale`.
        in_view: Share of the labels whose places lie in the image; NaN without labels.
    """

    held_out: Int[np.ndarray, "h"]
    samples: list[BorderSamples]
    chance: BorderSamples
    status: list[str]
    points_cm: Float[np.ndarray, "n 6"]
    in_window: Bool[np.ndarray, "n 6"]
    wrong: tuple[WrongSection, ...] = ()
    wrong_share: float = 0.0
    doubted: dict[str, float] = field(default_factory=dict)
    scale: float = 1.0
    in_view: float = float("nan")

    @property
    def near(self) -> BorderSamples:
        """Samples of all held-out frames that count for the verdict."""
        every = join_samples(self.samples)
        return every.select(every.ahead_cm < VERDICT_REACH_CM)

    @property
    def frame_median_px(self) -> Float[np.ndarray, "h"]:
        """Median absolute residual of each held-out frame; NaN if few were found."""
        medians = np.full(len(self.samples), np.nan)
        for i, samples in enumerate(self.samples):
            found = samples.residual_px[samples.found & (samples.ahead_cm < VERDICT_REACH_CM)]
            if found.size >= _MIN_SAMPLES:
                medians[i] = np.median(np.abs(found))
        return medians

    @property
    def labelled_share(self) -> float:
        """Share of frames with labels, of those that a complete map would label."""
        kept = [status for status in self.status if status not in NOT_TO_LABEL]
        return sum(status == LABELLED for status in kept) / max(len(kept), 1)

    @property
    def outside_share(self) -> float:
        """Share of frames with both lines beside the window, of those that might have been labelled."""
        kept = [status for status in self.status if status == OUTSIDE or status not in NOT_TO_LABEL]
        return kept.count(OUTSIDE) / max(len(kept), 1)

    @property
    def point_shares(self) -> dict[str, float]:
        """Share of each line's points in the window that are labelled, in the same frames."""
        return labelled_points(self.points_cm, self.in_window, self.status.count(NOT_MAPPED))

    @property
    def not_labelled(self) -> dict[str, int]:
        """Number of frames without labels by reason, the most frequent reason first."""
        counts = Counter(status for status in self.status if status != LABELLED)
        return dict(counts.most_common())


def measure_map(mapped: MappedDrive) -> MapQuality:
    """Compare the map's lines with its held-out frames, and find which frames get labels."""
    drive_map, drive = mapped.drive_map, mapped.drive
    rows = np.flatnonzero(drive_map.held_out)
    samples, chance = [], []
    tape_cm, lane_cm = drive_map.meta.tape_cm, drive_map.meta.mapped_lane_cm
    for k, edges, keep in frame_edges(mapped, rows):
        # What is withheld is no part of the map's answer.
        lines = lines_at(drive_map, k).without(drive_map.errors.doubted[k])
        nodded = drive_map.camera_at(k)
        samples.append(border_samples(edges, lines, tape_cm, nodded, keep))
        left = lines.without(np.repeat([False, True], len(ROWS_CM)))
        chance.append(border_samples(edges, left, tape_cm, nodded, keep, aside_cm=0.5 * lane_cm))
    status = [DELETED if deleted else NOT_MAPPED for deleted in drive.deleted]
    labels = label_frames(mapped, BirdseyeWindow())
    for row, reason in zip(mapped.rows.tolist(), labels.reasons, strict=True):
        status[row] = reason or LABELLED
    scale = reference_scale(drive_map.camera)
    points_cm, in_window = labels.points_cm, labels.in_window
    seen = share_in_view(drive_map.camera, points_cm)
    return MapQuality(
        rows, samples, join_samples(chance), status, points_cm, in_window, scale=scale, in_view=seen
    )


def wrong_sections(
    drive_map: DriveMap, features: LabelFeatures, errors: LabelErrors
) -> tuple[list[WrongSection], float]:
    """Find the sections along which most labels of a line are more likely off by 3 cm than not.

    Returns:
        The sections, the longest first, and their share of the length along which the driven lane's lines
        have labels.
    """
    found: list[WrongSection] = []
    seen = wrong = 0.0
    around = 2 * int(0.5 * _SHORTEST_CM / _PLACE_CM) + 1
    for segment, lines in drive_map.lines.items():
        for line in lines:
            mine = (features.line == line.index) & (drive_map.segment == segment)[:, None]
            frame, point = np.nonzero(mine & np.isfinite(errors.off_3))
            low, high = line.span_cm
            count, closed = max(1, int((high - low) / _PLACE_CM)), line.period_cm is not None
            place_cm = (high - low) / count
            place = np.floor((features.s_cm[frame, point] - low) / place_cm).astype(np.int64)
            place = place % count if closed else np.clip(place, 0, count - 1)
            off = errors.off_3[frame, point] > 0.5
            sums = np.stack([np.bincount(place, w, count) for w in (np.ones(len(place)), off)])
            of_all, of_wrong = uniform_filter1d(
                sums, min(around, count), axis=1, mode="wrap" if closed else "constant"
            )
            against = (of_wrong > 0.5 * of_all) & (of_all > 1e-9)
            if line.rank == 0:
                seen, wrong = seen + float((of_all > 1e-9).sum()), wrong + float(against.sum())
            for run in true_runs(against, closed):
                if len(run) * place_cm >= _SHORTEST_CM:
                    start = low + float(run[0]) * place_cm
                    shown = np.unique(frame[off & np.isin(place, run)])
                    section = (start, start + len(run) * place_cm)
                    found.append(WrongSection(segment, line.index, section, tuple(shown.tolist())))
    return sorted(found, key=lambda one: -one.length_cm), wrong / max(seen, 1.0)


def withheld_figures(drive_map: DriveMap, quality: MapQuality) -> dict[str, Any]:
    """Return the report's figures on the sections that are withheld, the longest first."""
    places = [
        {
            "segment": one.segment,
            "line": one.name,
            "from_cm": one.section_cm[0],
            "to_cm": one.section_cm[1],
            "frames": [int(drive_map.frames[k]) for k in one.frames],
        }
        for one in quality.wrong
    ]
    return {"share": quality.wrong_share, "places": places}


def label_evidence(mapped: MappedDrive, quality: MapQuality) -> LabelEvidence:
    """Collect what the labels of a map hold."""
    drive_map, given = mapped.drive_map, np.isfinite(quality.points_cm)
    way_cm = path_lengths(drive_map.poses)
    step_cm = np.minimum(np.diff(way_cm, prepend=0.0), _STEP_CM) * given.any(axis=1)
    ahead = np.minimum(np.searchsorted(way_cm, way_cm + _TURN_CM), len(way_cm) - 1)
    turn = np.diff(drive_map.poses[:, 2][np.stack([np.arange(len(ahead)), ahead])], axis=0)[0]
    bend = turn * _BEND_RADIUS_CM / _TURN_CM
    off_1, off_3 = (
        float(off[given].mean()) if given.any() else float("nan")
        for off in (drive_map.errors.off_1, drive_map.errors.off_3)
    )
    return LabelEvidence(
        frames=sum(status not in NOT_TO_LABEL for status in quality.status),
        labelled=quality.status.count(LABELLED),
        off_1=off_1,
        off_3=off_3,
        metres=0.01 * float(step_cm.sum()),
        left_m=0.01 * float(step_cm[bend > 1.0].sum()),
        right_m=0.01 * float(step_cm[bend < -1.0].sum()),
        not_labelled={why: n for why, n in quality.not_labelled.items() if why not in NOT_TO_LABEL},
        doubted=quality.doubted,
        in_view=quality.in_view,
        outside_share=quality.outside_share,
    )


def share_in_view(camera: Camera, points_cm: Float[np.ndarray, "n 6"]) -> float:
    """Share of labelled points that lie in a camera's image; NaN without any."""
    ahead_cm = np.broadcast_to(np.tile(ROWS_CM, len(SIDES)), points_cm.shape)
    places = np.stack([points_cm, ahead_cm], axis=-1)[np.isfinite(points_cm)]
    return float(camera.shows_ground(places).mean()) if len(places) else float("nan")


def quality_figures(quality: MapQuality) -> dict[str, Any]:
    """Return the report's figures: residuals by line and distance, coverage, and labelled shares."""
    every, near = join_samples(quality.samples), quality.near
    chance = quality.chance.select(quality.chance.ahead_cm < VERDICT_REACH_CM)
    lines: dict[str, Any] = {}
    for side in SIDES:
        part = every.select(every.right == (side == "right"))
        bands = {
            f"{low:g}-{high:g} cm": summarise(
                part.select((part.ahead_cm >= low) & (part.ahead_cm < high))
            ).as_dict(quality.scale)
            for low, high in pairwise(BANDS_CM)
        }
        within = part.select(part.ahead_cm < VERDICT_REACH_CM)
        lines[side] = {f"0-{VERDICT_REACH_CM:g} cm": summarise(within).as_dict(quality.scale), "bands": bands}
    medians = quality.frame_median_px
    known = medians[np.isfinite(medians)]
    return {
        "held_out": {
            "frames": len(quality.samples),
            "what": "edges of these frames had no say in the lines; their poses come from the chain",
            "reach_cm": VERDICT_REACH_CM,
            "gate_px_at_160": GATE_PX,
            "both_lines": summarise(near).as_dict(quality.scale),
            "coverage_by_chance": summarise(chance).coverage,
            "lines": lines,
            "frame_median_px": {
                "median": float(np.median(known)) if known.size else None,
                "p95": float(np.percentile(known, 95.0)) if known.size else None,
                "below_1_px_share": float((known < 1.0).mean()) if known.size else None,
            },
        },
        "labelled": {
            "share": quality.labelled_share,
            "share_of_all_frames": quality.status.count(LABELLED) / max(len(quality.status), 1),
            "why_not": quality.not_labelled,
            "points_in_window": quality.point_shares,
            "outside_share": quality.outside_share,
            "in_view": quality.in_view,
            "points_share": np.isfinite(quality.points_cm).mean(axis=0).tolist(),
        },
    }


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
