"""From a map to a label set: the lane of every frame, its edge points, and a report."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datagen.labels.project import FrameLines, lines_of_frame
from datagen.labels.quality import frame_residual_cm, label_report
from datagen.map_folder import DriveMap, read_map
from datagen.map_report import Report
from datagen.map_settings import SETTINGS_NAME, MapSettings
from datagen.pictures import draw_contact_sheet
from datagen.slam.scans import Progress
from lanenet.config import load_settings
from lanenet.data.drive import open_drive
from lanenet.data.files import atomic_file, write_json
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.birdseye import PerceptionSettings, RoadEdgeExtractor

_MIN_MATCH = 0.15


def lines_at(drive_map: DriveMap, k: int) -> FrameLines:
    """Return the lane of the map's k-th frame."""
    lines = drive_map.lines[int(drive_map.segment[k])]
    return lines_of_frame(lines, drive_map.poses[k], float(drive_map.s_cm[k]), drive_map.camera.wheelbase_cm)


def label_map(
    map_folder: Path,
    out: Path,
    progress: Progress | None = None,
    *,
    drive_path: Path | None = None,
    perception: PerceptionSettings | None = None,
    window: BirdseyeWindow | None = None,
) -> Report:
    """Project a map's lines into each frame and write the label set, its report and a contact sheet.

    A frame gets no labels where its pose is uncertain (few edges match the map) or the driver has deleted
    it; a point is masked where the map does not support the line, or where it lies beside the window.

    Args:
        map_folder: Folder that :func:`map_drive` wrote.
        out: Parquet file.
        progress: Called with (done, total).
        drive_path: Where the drive is now, if it has moved since it was mapped.
        perception: How the network's edge points are found; None takes what the map was made with.
        window: The network's window.
    """
    drive_map = read_map(map_folder)
    source = drive_path if drive_path is not None else Path(drive_map.meta.drive)
    if not source.exists():
        raise DriveFormatError(f"{source}: the drive of {map_folder} is not there")
    drive = open_drive(source)
    if (drive_map.camera.width, drive_map.camera.height) != (drive.width, drive.height):
        raise CalibrationError(
            f"{map_folder / 'camera.yaml'}: is for {drive_map.camera.width}x{drive_map.camera.height} px, "
            f"the images of {source} have {drive.width}x{drive.height}"
        )
    if perception is None:
        perception = load_settings(MapSettings, map_folder / SETTINGS_NAME).perception
    window = BirdseyeWindow() if window is None else window
    extractor = RoadEdgeExtractor(drive_map.camera, perception)
    index = {int(frame): i for i, frame in enumerate(drive.frames)}
    rows: list[int] = []
    edges, lines, points, residuals = [], [], [], []
    skipped = {"deleted": 0, "pose uncertain": 0, "no line in the window": 0}
    for k, frame in enumerate(drive_map.frames):
        if progress is not None:
            progress(k + 1, len(drive_map.frames))
        i = index.get(int(frame))
        if i is None:
            raise DriveFormatError(f"{source}: frame {int(frame)} of {map_folder} is not in it")
        if drive.deleted[i]:
            skipped["deleted"] += 1
            continue
        # The first frame of a segment has no map to match yet, so that its match is NaN.
        if drive_map.match[k] < _MIN_MATCH:
            skipped["pose uncertain"] += 1
            continue
        seen = lines_at(drive_map, k)
        visible = window.labelled(seen.points_cm)
        if not np.isfinite(visible).any():
            skipped["no line in the window"] += 1
            continue
        road = extractor.extract(drive.image(i))
        rows.append(k)
        edges.append(np.concatenate([road.points_cm, road.normals], axis=1).astype(np.float32))
        lines.append((seen.left_cm, seen.right_cm))
        points.append(visible)
        residuals.append(
            frame_residual_cm(road.points_cm, (seen.left_cm, seen.right_cm), drive_map.meta.tape_cm)
        )
    if not rows:
        raise TrackingLostError(f"{map_folder}: no frame can be labelled ({skipped})")
    residual = np.array(residuals)
    labels = LabelSet(
        meta=LabelMeta(
            window=window,
            camera_hash=drive_map.camera.hash,
            wheelbase_cm=drive_map.camera.wheelbase_cm,
            lane_width_cm=drive_map.meta.lane_width_cm,
            source="map",
            perception=perception,
            marking_cm=drive_map.meta.tape_cm,
        ),
        drive=[drive.name] * len(rows),
        file=[""] * len(rows),
        frame=drive_map.frames[rows],
        t_s=drive_map.t_s[rows],
        lap=drive_map.lap[rows],
        poses=drive_map.poses[rows],
        points_cm=np.array(points),
        edges=edges,
        lines=lines,
        quality=np.exp(-np.nan_to_num(residual, nan=2.0)),
    )
    report = label_report(labels, residual, len(drive_map.frames), skipped)
    write_labels(out, labels)
    write_json(out.with_suffix(".json"), report)
    order = np.argsort(np.nan_to_num(residual, nan=9.0))
    picks = np.concatenate([order[:8], order[len(order) // 2 - 4 : len(order) // 2 + 4], order[-8:]])
    with atomic_file(out.with_suffix(".png")) as temporary:
        draw_contact_sheet(
            temporary,
            [
                (
                    drive.image(index[int(labels.frame[j])]),
                    lines_at(drive_map, rows[j]),
                    int(labels.frame[j]),
                )
                for j in picks
            ],
            drive_map.camera,
        )
    share = report["labelled_share"]
    lines_out = [
        f"{len(rows)} of {len(drive_map.frames)} frames labelled ({100 * share:.0f} %)",
        *(f"{count} frames left out: {reason}" for reason, count in skipped.items() if count),
        f"markings lie {report['residual_cm']['median']:.2f} cm (median), "
        f"{report['residual_cm']['p95']:.2f} cm (p95) from the projected lines",
    ]
    return Report(tuple(lines_out), report)
