"""From a map to a label set: the lane of every frame, its edge points, and a report."""

from __future__ import annotations

import shlex
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from datagen.quality.figures import Report
from datagen.quality.pictures import draw_contact_sheet
from datagen.quality.without_map import hints_without_map
from datagen.slam.odometry.scans import Progress
from lanenet.data.files import atomic_file, write_json
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.data.maps.folder import DriveMap, verdict_of
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.data.maps.mapped_drive import (
    AWAY,
    BETWEEN_LANES,
    DELETED,
    DOUBTFUL,
    NO_LINE,
    NOT_TO_LABEL,
    OUTSIDE,
    check_images,
    label_frames,
    labelled_points,
    open_mapped_drive,
    points_text,
)
from lanenet.errors import MapFormatError, TrackingLostError, counted
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES
from lanenet.page import PAGE_NAME
from lanenet.perception.edges.road import COLOUR_WEIGHT, RoadEdgeExtractor

_REPORT_FORMAT = "lanenet-label-report/1"
#: Edge points up to this distance ahead count for the residual of a frame. Chosen: twice the farthest label
#: row.
_REACH_CM = 60.0
#: Frames in each row of the contact sheet: the best, the middle and the worst.
_SHOWN = 8


def label_map(
    map_folder: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    colour_weight: float = COLOUR_WEIGHT,
    window: BirdseyeWindow | None = None,
    force: bool = False,
    pictures: bool = True,
    drive: Path | None = None,
    name: str | None = None,
) -> Report:
    """Project a map's lines into each frame; write the label set, its report and a contact sheet.

    Which frames and points have labels is decided by :func:`lanenet.data.maps.mapped_drive.label_frame`.

    Args:
        map_folder: Folder that :func:`map_drive` wrote.
        out: Parquet file.
        progress: Called with (done, total).
        colour_weight: Weight of colour beside brightness in the edges that the network sees; otherwise they
            are found like the map's.
        window: The network's window; None takes the default.
        force: Label a rejected map, too.
        pictures: Draw the contact sheet.
        drive: Where the drive is now, if it has moved since it was mapped.
        name: Of the drive in the label set; None for that of its folder or file.

    Raises:
        TrackingLostError: If the map was rejected, or no frame can be labelled.
        DriveFormatError: If the drive was recorded anew since it was mapped.
    """
    mapped = open_mapped_drive(map_folder, drive)
    # All images are read below; so are their bytes.
    check_images(mapped, map_folder, every=True)
    drive_map = mapped.drive_map
    if not force:
        refuse_rejected(map_folder, drive_map)
    perception = mapped.perception.with_colours(colour_weight)
    window = BirdseyeWindow() if window is None else window
    found = label_frames(mapped, window)
    left_out = {
        reason: found.reasons.count(reason)
        for reason in (DELETED, DOUBTFUL, BETWEEN_LANES, AWAY, NO_LINE, OUTSIDE)
    }
    rows = np.array([k for k, reason in enumerate(found.reasons) if not reason], dtype=np.int64)
    if not rows.size:
        raise TrackingLostError(f"{map_folder}: no frame can be labelled ({left_out})")
    extractor = RoadEdgeExtractor(drive_map.camera, perception)
    edges, lines, residuals = [], [], []
    for k in rows.tolist():
        if progress is not None:
            progress(k + 1, len(drive_map.frames))
        seen = found.lines[k]
        assert seen is not None
        road = extractor.extract(mapped.drive.image(int(mapped.rows[k])))
        edges.append(road.rows())
        lines.append((seen.left_cm, seen.right_cm))
        residuals.append(frame_residual_cm(road.points_cm, seen, drive_map.meta.tape_cm))
    residual_cm = np.array(residuals)
    labels = LabelSet(
        meta=LabelMeta(
            window=window,
            camera_hash=drive_map.camera.hash,
            wheelbase_cm=drive_map.camera.wheelbase_cm,
            lane_width_cm=drive_map.meta.lane_cm,
            source="map",
            perception=perception,
            marking_cm=drive_map.meta.tape_cm,
            camera_cm=drive_map.camera.mounting.at_cm,
            camera=drive_map.camera,
            verdict=drive_map.meta.verdict,
        ),
        drive=[mapped.drive.name if name is None else name] * len(rows),
        file=[""] * len(rows),
        frame=drive_map.frames[rows],
        t_s=drive_map.t_s[rows],
        lap=drive_map.lap[rows],
        poses=drive_map.poses[rows],
        points_cm=found.points_cm[rows],
        edges=edges,
        lines=lines,
        quality=np.exp(-np.nan_to_num(residual_cm, nan=2.0)),
        divides=drive_map.lanes.divides[rows],
    )
    mapped_frames = len(drive_map.frames)
    shares = labelled_points(found.points_cm, found.in_window)
    report = label_report(labels, residual_cm, mapped_frames, left_out, shares)
    # All of them are written before the first gets its name.
    with ExitStack() as stack:
        if pictures:
            picture = stack.enter_context(atomic_file(out.with_suffix(".png")))
            draw_contact_sheet(picture, mapped, rows[_shown(residual_cm)])
        write_json(stack.enter_context(atomic_file(out.with_suffix(".json"))), report)
        write_labels(stack.enter_context(atomic_file(out)), labels)
    residual = report["residual_cm"]
    text = [
        labelled_text(len(rows), mapped_frames, left_out),
        points_text(shares),
        *(f"{counted(count, 'frame')} left out: {reason}" for reason, count in left_out.items() if count),
        f"distance of markings from the projected lines: {residual['median']:.2f} cm (median), "
        f"{residual['p95']:.2f} cm (p95)",
    ]
    return Report(tuple(text), report)


def labelled_text(labelled: int, mapped_frames: int, left_out: dict[str, int]) -> str:
    """Say how many frames are labelled, and, as the map's verdict counts, of how many that should be."""
    expected = mapped_frames - sum(left_out.get(reason, 0) for reason in NOT_TO_LABEL)
    text = f"{labelled} of {mapped_frames} frames labelled ({100 * labelled / mapped_frames:.0f} %"
    if labelled <= expected < mapped_frames:
        text += f"; {100 * labelled / expected:.0f} % of those that should have labels"
    return f"{text})"


def _shown(residual_cm: Float[np.ndarray, "n"]) -> Int[np.ndarray, "s"]:
    """Choose the best, the median and the worst frames; frames without a residual count as worst."""
    order = np.argsort(np.nan_to_num(residual_cm, nan=9.0))
    first = len(order) // 2 - _SHOWN // 2
    return np.concatenate([order[:_SHOWN], order[first : first + _SHOWN], order[-_SHOWN:]])


def frame_residual_cm(points_cm: Float[np.ndarray, "m 2"], lines: FrameLines, tape_cm: float) -> float:
    """Median distance of edge points from the projected borders of the markings.

    Args:
        points_cm: Edge points of the frame, frame car.
        lines: The frame's lane.
        tape_cm: Width of a marking that has no measured width.

    Returns:
        [cm]; NaN if the frame shows fewer than ten edge points near the lines.
    """
    near = points_cm[points_cm[:, 1] <= _REACH_CM]
    distances = []
    for side, line in enumerate((lines.left_cm, lines.right_cm)):
        known = line[np.isfinite(line[:, 0])]
        if len(known) < 2 or not len(near):
            continue
        offset = np.abs(_distance_to_polyline(near, known))
        # One width for what the frame shows: it changes by little over so short a way.
        marking_cm = float(np.median(lines.markings_cm(side, tape_cm)))
        distances.append(np.abs(offset[offset < 1.5 * marking_cm + 1.0] - 0.5 * marking_cm))
    found = np.concatenate(distances) if distances else np.empty(0)
    return float(np.median(found)) if found.size >= 10 else float("nan")


def _distance_to_polyline(
    points: Float[np.ndarray, "m 2"], line: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "m"]:
    start, step = line[:-1], np.diff(line, axis=0)
    step_x, step_y = step.T
    length2 = np.maximum(step_x * step_x + step_y * step_y, 1e-12)
    to_x, to_y = points[:, :1] - start[:, 0], points[:, 1:] - start[:, 1]
    t = np.clip((to_x * step_x + to_y * step_y) / length2, 0.0, 1.0)
    off_x, off_y = to_x - t * step_x, to_y - t * step_y
    return np.sqrt((off_x * off_x + off_y * off_y).min(axis=1))


def label_report(
    labels: LabelSet,
    residual_cm: Float[np.ndarray, "n"],
    mapped_frames: int,
    left_out: dict[str, int],
    point_shares: dict[str, float],
) -> dict[str, Any]:
    """Collect the figures of a label set's report.

    Args:
        labels: The labels.
        residual_cm: Residual of each frame, see :func:`frame_residual_cm`.
        mapped_frames: Number of frames of the map.
        left_out: Number of frames without labels, by reason.
        point_shares: See :func:`lanenet.data.maps.mapped_drive.labelled_points`.
    """
    known = np.isfinite(labels.points_cm)
    finite = residual_cm[np.isfinite(residual_cm)]

    def percentile(q: float) -> float:
        return float(np.percentile(finite, q)) if finite.size else float("nan")

    return {
        "format": _REPORT_FORMAT,
        "frames_mapped": mapped_frames,
        "frames_labelled": len(labels),
        "labelled_share": len(labels) / max(mapped_frames, 1),
        "frames_left_out": left_out,
        "points_in_window_labelled_share": point_shares,
        "points_labelled_share": {
            name: float(known[:, i].sum()) / max(mapped_frames, 1) for i, name in enumerate(POINT_NAMES)
        },
        "residual_cm": {"median": percentile(50.0), "p95": percentile(95.0), "frames": int(finite.size)},
        "residual_of": "edge points within 60 cm, of frames that made the map, from the marking's borders",
    }


def refuse_rejected(map_folder: Path, drive_map: DriveMap) -> None:
    """Refuse to label a rejected map.

    Raises:
        TrackingLostError: With the verdict's sentence, and the file that holds its figures.
    """
    if drive_map.meta.verdict != "reject":
        return
    try:
        reason = verdict_of(map_folder).sentence
    except MapFormatError:  # the verdict stands without its reasons
        reason = "its report cannot be read"
    page = map_folder / PAGE_NAME
    instead = hints_without_map(Path(drive_map.meta.drive), map_folder, drive_map.meta.lane_width_cm)
    labels = map_folder.with_suffix(".parquet")
    again = shlex.join(["lanenet", "label", "--force", str(map_folder), "--out", str(labels)])
    # A map without pictures has no page.
    details = page if page.is_file() else map_folder / "report.json"
    raise TrackingLostError(
        f"{map_folder}: the map was rejected: {reason}; see {details}",
        hints=[f"to label it all the same: {again}", *instead],
    )
