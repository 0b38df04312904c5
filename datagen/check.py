"""Check of an assembled map before it is written: held-out frames, local checks, figures, verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.assemble import AssembledMap
from datagen.lanes.trace import other_lane
from datagen.prepare import PreparedDrive
from datagen.quality.evidence import label_features
from datagen.quality.figures import map_evidence, map_notes, steering_answer
from datagen.quality.label_error import doubted_by, predict_errors
from datagen.quality.measure import MapQuality, WrongSection, frame_status, label_evidence, wrong_sections
from datagen.quality.residuals import Residuals, coverage, held_out_residuals, robust_sd
from datagen.quality.verdict import Verdict, judge
from lanenet.data.drives import Drive
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.errors import NoLaneError
from lanenet.geometry.lane import SIDES

#: Least coverage of both lines. Chosen: dashes and worn lines have more.
_LEAST_COVERAGE = 0.2
#: A line is clutter if its robust sd exceeds the first, in pixels of an image 160 px wide, and its coverage
#: is below the second; with more coverage it is a line that the map has bent. So it is, however well it fits
#: the little that it meets, if that is less than the third times what a line in the middle of the lane meets.
#: Measured: edges met by chance have 3 px, real lines 0.5 px at most
#: (:class:`datagen.quality.verdict.VerdictSettings`); real lines have a coverage of 0.41 at least on 44 maps,
#: that of a line traced along the verge was 1.4 times that of the middle.
_CLUTTER_PX, _CLUTTER_COVERAGE, _BY_CHANCE = 1.5, 0.4, 2.0


@dataclass(frozen=True)
class CheckedMap:
    """A map with its verdict.

    Attributes:
        mapped: The map with its drive; lines that frames contradict are marked.
        quality: What the held-out frames show of it.
        verdict: How far it can be trusted.
        figures: For machines.
        notes: For people, a sentence each.
    """

    mapped: MappedDrive
    quality: MapQuality
    verdict: Verdict
    figures: dict[str, Any]
    notes: tuple[str, ...]


def check_map(prepared: PreparedDrive, assembled: AssembledMap, camera_figures: dict[str, Any]) -> CheckedMap:
    """Compare a map with its frames and judge it.

    Args:
        prepared: The drive.
        assembled: The map.
        camera_figures: Those of the camera, where it was found or refined on this drive.

    Raises:
        NoLaneError: If held-out frames do not show the lines.
        CalibrationError: If they show one line only, but there is a lane of another width.
    """
    drive, drive_map, free_cm = prepared.drive, assembled.drive_map, assembled.free_lane_cm
    notes = map_notes(drive_map, assembled.segments, len(drive), free_cm is not None)
    mapped = MappedDrive(drive_map, drive, assembled.rows, prepared.settings.perception)
    # What is withheld of a false line is what would tell that it is one.
    traced = held_out_residuals(mapped)
    mapped, quality = compare_with_frames(mapped, camera_figures)
    drive_map = mapped.drive_map
    check_lines_seen(traced, quality.held_out, drive, drive_map.meta.lane_width_cm, free_cm)
    request = prepared.request
    figures = quality.figures(drive_map) | {
        "segments_mapped": assembled.segments,
        "lane_width": asdict(assembled.lane),
        "steering_correlation": steering_answer(mapped),
        "pauses": prepared.pauses,
        "given": {
            "lane_width_cm": request.lane_width_cm,
            "camera_height_cm": request.camera_height_cm,
            "tape_width_cm": request.tape_width_cm,
        },
    }
    evidence = map_evidence(drive_map, camera_figures | figures, quality, free_cm)
    verdict = judge(evidence, prepared.settings.verdict)
    meta = drive_map.meta.model_copy(update={"verdict": verdict.grade, "state": verdict.state})
    mapped = replace(mapped, drive_map=replace(drive_map, meta=meta))
    return CheckedMap(mapped, quality, verdict, figures | {"verdict": asdict(verdict)}, tuple(notes))


def compare_with_frames(
    mapped: MappedDrive, camera_figures: dict[str, Any]
) -> tuple[MappedDrive, MapQuality]:
    """Predict the errors of a map's labels, mark where it is wrong, and measure it in held-out frames."""
    drive_map = mapped.drive_map
    features = label_features(mapped, camera_figures)
    errors = predict_errors(features)
    wrong, share = wrong_sections(drive_map, features, errors)
    lines = {
        segment: [replace(line, contradicted_cm=_sections(wrong, segment, line.index)) for line in found]
        for segment, found in drive_map.lines.items()
    }
    mapped = replace(mapped, drive_map=replace(drive_map, lines=lines, errors=errors))
    status, points_cm = frame_status(mapped)
    doubted = doubted_by(features, errors, np.isfinite(points_cm))
    labels = label_evidence(mapped.drive_map, status, points_cm, doubted)
    return mapped, MapQuality(held_out_residuals(mapped), status, points_cm, labels, wrong, share)


def _sections(wrong: Sequence[WrongSection], segment: int, index: int) -> Float[np.ndarray, "w 2"]:
    own = [one.section_cm for one in wrong if (one.segment, one.index) == (segment, index)]
    return np.array(sorted(own)).reshape(-1, 2)


def check_lines_seen(
    traced: Residuals, held_out: Residuals, drive: Drive, lane_width_cm: float, free_lane_cm: float | None
) -> None:
    """Refuse lines that held-out frames do not show: clutter along the path.

    Args:
        traced: Residuals of the map's held-out frames, nothing withheld of the lines.
        held_out: The same without what is withheld.
        drive: The drive.
        lane_width_cm: The given lane width.
        free_lane_cm: Lane width found without the given one, if it fits better; else None.

    Raises:
        NoLaneError: If the frames show at most one of the lines; names the coverage.
        CalibrationError: If they show at most one, but there is a lane of another width.
    """
    share = coverage(np.concatenate(held_out[:2]))
    if share < _LEAST_COVERAGE:
        raise NoLaneError(
            f"{drive.path}: no lane: held-out frames show an edge along {100.0 * share:.0f} % of the "
            f"borders of its lines, expected {100.0 * _LEAST_COVERAGE:.0f} % at least"
        )
    lines = {side: (coverage(own), robust_sd(own)) for side, own in zip(SIDES, traced[:2], strict=True)}
    by_chance = _BY_CHANCE * coverage(held_out.chance)
    clutter = [
        side
        for (side, (met, sd_px)), kept in zip(lines.items(), held_out[:2], strict=True)
        if met < _CLUTTER_COVERAGE and (sd_px > _CLUTTER_PX or coverage(kept) < by_chance)
    ]
    if not clutter:
        return
    if free_lane_cm is not None:
        raise other_lane(lane_width_cm, free_lane_cm)
    found = " and ".join(
        f"{100.0 * met:.0f} % of the {side} line's borders, {sd_px:.1f} px off"
        for side, (met, sd_px) in lines.items()
    )
    raise NoLaneError(
        f"{drive.path}: {'one line only bounds the driven lane' if len(clutter) == 1 else 'no lane'}: "
        f"held-out frames show edges along {found} (robust sd); those of the {' and the '.join(clutter)} "
        "line are met by chance"
    )
