"""From a map to a label set: the lane of every frame, its edge points, and a report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from datagen.labels.quality import frame_residual_cm, label_report
from datagen.quality.figures import Report
from datagen.quality.page import PAGE_NAME
from datagen.quality.pictures import draw_contact_sheet
from datagen.slam.odometry.scans import Progress
from lanenet.data.files import atomic_file, write_json
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import (
    AWAY,
    BETWEEN_LANES,
    CONTRADICTED,
    DELETED,
    NO_LINE,
    NOT_TO_LABEL,
    UNCERTAIN,
    label_frame,
    labelled_points,
    open_mapped_drive,
    points_in_window,
    points_text,
)
from lanenet.errors import TrackingLostError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import N_POINTS
from lanenet.perception.edges.road import COLOUR_WEIGHT, RoadEdgeExtractor


def label_map(
    map_folder: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    drive_path: Path | None = None,
    colour_weight: float = COLOUR_WEIGHT,
    window: BirdseyeWindow | None = None,
    force: bool = False,
    pictures: bool = True,
) -> Report:
    """Project a map's lines into each frame and write the label set, its report and a contact sheet.

    Which frames and points get labels is decided by :func:`label_frame`.

    Args:
        map_folder: Folder that :func:`map_drive` wrote.
        out: Parquet file.
        progress: Called with (done, total).
        drive_path: Where the drive is now, if it has moved since it was mapped.
        colour_weight: What colours count beside brightness in the edges that the network sees; else they are
            found as the map's were.
        window: The network's window.
        force: Label a map that was rejected, too.
        pictures: Draw the contact sheet.
    """
    mapped = open_mapped_drive(map_folder, drive_path)
    drive_map, drive = mapped.drive_map, mapped.drive
    if not force:
        refuse_rejected(map_folder, drive_map)
    perception = mapped.perception.with_colours(colour_weight)
    window = BirdseyeWindow() if window is None else window
    extractor = RoadEdgeExtractor(drive_map.camera, perception)
    rows: list[int] = []
    edges, lines, residuals = [], [], []
    skipped = dict.fromkeys((DELETED, UNCERTAIN, CONTRADICTED, BETWEEN_LANES, AWAY, NO_LINE), 0)
    kept_points = np.full((len(drive_map.frames), N_POINTS), np.nan)
    in_window = np.zeros(kept_points.shape, dtype=bool)
    for k in range(len(drive_map.frames)):
        if progress is not None:
            progress(k + 1, len(drive_map.frames))
        labelled = label_frame(mapped, k, window)
        if labelled not in NOT_TO_LABEL:
            in_window[k] = points_in_window(drive_map, k, window)
        if isinstance(labelled, str):
            skipped[labelled] += 1
            continue
        seen, visible = labelled
        road = extractor.extract(drive.image(int(mapped.rows[k])))
        rows.append(k)
        edges.append(np.concatenate([road.points_cm, road.normals], axis=1).astype(np.float32))
        lines.append((seen.left_cm, seen.right_cm))
        kept_points[k] = visible
        residuals.append(frame_residual_cm(road.points_cm, seen, drive_map.meta.tape_cm))
    if not rows:
        raise TrackingLostError(f"{map_folder}: no frame can be labelled ({skipped})")
    residual = np.array(residuals)
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
        ),
        drive=[drive.name] * len(rows),
        file=[""] * len(rows),
        frame=drive_map.frames[rows],
        t_s=drive_map.t_s[rows],
        lap=drive_map.lap[rows],
        poses=drive_map.poses[rows],
        points_cm=kept_points[rows],
        edges=edges,
        lines=lines,
        quality=np.exp(-np.nan_to_num(residual, nan=2.0)),
        divides=drive_map.lanes.divides[rows],
    )
    shares = labelled_points(kept_points, in_window)
    report = label_report(labels, residual, len(drive_map.frames), skipped, shares)
    write_labels(out, labels)
    write_json(out.with_suffix(".json"), report)
    if pictures:
        order = np.argsort(np.nan_to_num(residual, nan=9.0))
        picks = np.concatenate([order[:8], order[len(order) // 2 - 4 : len(order) // 2 + 4], order[-8:]])
        with atomic_file(out.with_suffix(".png")) as temporary:
            draw_contact_sheet(temporary, mapped, np.array(rows)[picks])
    share = report["labelled_share"]
    lines_out = [
        f"{len(rows)} of {len(drive_map.frames)} frames labelled ({100 * share:.0f} %)",
        points_text(shares),
        *(f"{count} frames left out: {reason}" for reason, count in skipped.items() if count),
        f"markings lie {report['residual_cm']['median']:.2f} cm (median), "
        f"{report['residual_cm']['p95']:.2f} cm (p95) from the projected lines",
    ]
    return Report(tuple(lines_out), report)


def refuse_rejected(map_folder: Path, drive_map: DriveMap) -> None:
    """Raise if the map was rejected.

    Args:
        map_folder: Where it lies, with its report.
        drive_map: The map.

    Raises:
        TrackingLostError: With the first reason, and where the others stand.
    """
    if drive_map.meta.verdict != "reject":
        return
    try:
        reasons = json.loads((map_folder / "report.json").read_text(encoding="utf-8"))["verdict"]["reasons"]
        reason = str(reasons[0])
    except (OSError, ValueError, LookupError, TypeError):  # the verdict stands without its reasons
        reason = "its report cannot be read"
    page = map_folder / PAGE_NAME
    # Maps of which nobody wants pictures have no page.
    told_by = page if page.is_file() else map_folder / "report.json"
    raise TrackingLostError(
        f"{map_folder}: the map was rejected: {reason}; see {told_by}, and label it with --force if it is to "
        "be used all the same"
    )
