"""The data sheet of a trained network: which drives it learned from, how long, which lanes, lenses and roads.

Everything in it is read from the run's settings, label sets, maps and drives. What none of them says is None,
and is written as "not recorded".
"""

from __future__ import annotations

import contextlib
import re
import subprocess
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from datagen.datasets.build import PreparedData
from datagen.datasets.jobs import Part, RecordedJob, SyntheticJob
from datagen.datasets.settings import ROLES, DataSettings, RecordedSettings, Role
from datagen.datasets.splits import chosen_split, driven_cm
from lanenet.data.drives.recording import read_drive_file
from lanenet.data.label_set import LabelSet, read_places
from lanenet.data.library.library import DEFAULT_LIBRARY, Library
from lanenet.data.maps.folder import DriveMap, read_map
from lanenet.data.segments import map_segments
from lanenet.errors import LanenetError
from lanenet.geometry.camera import Camera

FORMAT = "lanenet-data-sheet/1"
Sheet = dict[str, Any]

#: What ``random`` stands for in the settings of a line; which of them it became, the drive's seed decides.
_DRAWN_KIND, _DRAWN_COLOUR = {"random": "solid or dashed"}, {"random": "white or yellow"}
_LANES = {1: "one lane", 2: "two lanes"}


def data_sheet(
    name: str, settings: DataSettings, data: PreparedData, work_dir: Path, jobs: Sequence[RecordedJob] = ()
) -> Sheet:
    """Collect the facts about the data of a training run.

    Args:
        name: Of the network.
        settings: The data of the run.
        data: What was made of them.
        work_dir: Folder of the drives, maps and label sets.
        jobs: The recorded drives.

    Returns:
        Plain values, with units in the keys.

    Raises:
        LabelFormatError: If a label set of the run cannot be read.
        MapFormatError: Likewise a map.
    """
    parts = {role: [_extent(part) for part in data.of(role)] for role in ROLES}
    simulated = None
    if any(getattr(settings.synthetic, role) for role in ROLES):
        drawn = draw_jobs(settings, "train", work_dir)
        there = {part.labels for part in data.parts}
        made = {
            role: sum(job.labels in there for job in draw_jobs(settings, role, work_dir)) for role in ROLES
        }
        simulated = simulated_facts(settings, [job for job in drawn if job.labels in there], "made")
        simulated |= {"made": made, "left_out": left_out_reasons(data.left_out)}
    recorded = [_recorded(job, data) for job in jobs]
    return {
        "format": FORMAT,
        "name": name,
        "made_by": {"lanenet": metadata.version("lanenet"), "commit": commit_of_this_code()},
        "parts": {role: _total(extents) for role, extents in parts.items()},
        "simulated": simulated,
        "recorded": recorded,
        "licences": licences(recorded),
    }


def licences(recorded: Iterable[Sheet]) -> dict[str, Sheet]:
    """Sum up recorded drives by their licences; those of drives that say none are under "".

    Args:
        recorded: What the sheet says of each drive.
    """
    found: dict[str, list[Mapping[str, int | float]]] = {}
    for drive in recorded:
        extents = list(drive["parts"].values())
        found.setdefault(drive["licence"] or "", []).append(_total(extents) | {"drives": 1})
    return {licence: _total(extents) for licence, extents in sorted(found.items())}


def draw_jobs(settings: DataSettings, role: Role, work_dir: Path) -> list[SyntheticJob]:
    """Return the simulated drives of a role; they follow from the settings, nothing is simulated."""
    count = getattr(settings.synthetic, role)
    return [SyntheticJob.draw(settings, role, number, work_dir) for number in range(count)]


def simulated_facts(settings: DataSettings, jobs: Sequence[SyntheticJob], which: str) -> Sheet:
    """Describe simulated drives by what was drawn for them.

    Args:
        settings: The data of the run.
        jobs: The training drives that are described.
        which: ``made`` if these are the ones that gave labels, ``asked for`` if some of them may not have.
    """
    synthetic, drives = settings.synthetic, [job.simulation for job in jobs]
    tracks = [drive.track for drive in drives]
    lines: dict[str, Counter[str]] = {}
    for track in tracks:
        for line, (_, marking) in track.lines.items():
            lines.setdefault(line, Counter())[
                f"{_DRAWN_KIND.get(marking.kind, marking.kind)}, "
                f"{_DRAWN_COLOUR.get(marking.colour, marking.colour)}"
            ] += 1
    return {
        "seed": synthetic.seed,
        "variety": synthetic.variety,
        "asked": {role: getattr(synthetic, role) for role in ROLES},
        "described": {"which": which, "drives": len(drives)},
        "frames_each": synthetic.simulation.frames,
        "rate_hz": synthetic.simulation.rate_hz,
        "roads": _counts(track.preset or "drawn at random" for track in tracks),
        "shapes": _counts("closed" if track.closed else "open" for track in tracks),
        "lanes": _counts(_LANES[track.lanes] for track in tracks),
        "with_kinks": sum(any(piece.kink is not None for piece in track.pieces) for track in tracks),
        "with_corners": sum(track.corners > 0.0 for track in tracks),
        "with_widening": sum(track.widening > 0.0 for track in tracks),
        "lines": {line: dict(counts.most_common()) for line, counts in lines.items()},
        "lane_width_cm": spread(track.lane_width_cm for track in tracks),
        "marking_cm": spread(track.line_width_cm for track in tracks),
        "speed_cm_s": spread(drive.driver.chosen_speed_cm_s(drive.rate_hz) for drive in drives),
        "wheelbase_cm": spread(drive.car.wheelbase_cm for drive in drives),
        "cameras": camera_kinds([drive.camera.build(drive.car.wheelbase_cm) for drive in drives]),
    }


def camera_kinds(cameras: Iterable[Camera]) -> list[Sheet]:
    """Group cameras by lens model and image size; ranges of the rest."""
    groups: dict[tuple[str, int, int], list[Camera]] = {}
    for camera in cameras:
        groups.setdefault((camera.model, camera.width, camera.height), []).append(camera)
    return [
        {
            "model": model,
            "width_px": width,
            "height_px": height,
            "drives": len(group),
            "focal_px": spread(camera.K[0, 0] for camera in group),
            "field_of_view_deg": spread(field_of_view_deg(camera) for camera in group),
            "camera_height_cm": spread(camera.mounting.height_cm for camera in group),
            "pitch_down_deg": spread(np.degrees(camera.mounting.pitch_down_rad) for camera in group),
        }
        for (model, width, height), group in sorted(groups.items())
    ]


def field_of_view_deg(camera: Camera) -> float:
    """Return the angle between the left and the right end of the row of the principal point, [deg].

    NaN where the lens does not reach them.
    """
    row_px = float(camera.K[1, 2])
    rays = camera.unproject(np.array([[-0.5, row_px], [camera.width - 0.5, row_px]]))
    # Each to the optical axis: the whole may exceed half a turn.
    off_axis_rad = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    return float(np.degrees(off_axis_rad.sum()))


def spread(values: Iterable[float]) -> dict[str, float] | None:
    """Return least, median and greatest; None of nothing, or where one is unknown."""
    array = np.array([float(value) for value in values])
    if not array.size or not np.isfinite(array).all():
        return None
    return {"min": float(array.min()), "median": float(np.median(array)), "max": float(array.max())}


def left_out_reasons(left_out: Iterable[str]) -> dict[str, int]:
    """Count why simulated drives have no labels, with the numbers and paths in the reasons blanked.

    Args:
        left_out: ``title: reason``, see :class:`datagen.datasets.build.PreparedData`.
    """
    reasons = (text.split(": ", 1)[-1].split("; see ")[0] for text in left_out)
    blanked = (re.sub(r"\d+(\.\d+)?", "#", re.sub(r"^\S*/\S*: ", "", reason)) for reason in reasons)
    return dict(Counter(blanked).most_common())


def commit_of_this_code() -> str | None:
    """Return the commit of the working tree that this package runs from; None if it runs from none.

    Ends with ``-dirty`` where files of the tree differ from the commit.
    """
    root = Path(__file__).resolve().parents[2]
    # An installed package may lie inside the working tree of something else.
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def _counts(values: Iterable[str]) -> dict[str, int]:
    return dict(Counter(values).most_common())


def _extent(part: Part) -> Sheet:
    """Measure a label set: labelled frames, the time between those that follow one another, the distance."""
    labels = read_places(part.labels)
    return {"drives": 1, "frames": len(labels), "minutes": _driven_s(labels) / 60.0, "km": _km(labels)}


def _driven_s(labels: LabelSet) -> float:
    """Time between neighbouring rows of one segment, [s]; rows are missing where a frame has no labels."""
    steps_s = np.diff(labels.t_s)
    return float(steps_s[np.diff(map_segments(labels.frame, labels.poses)) == 0].sum())


def _km(labels: LabelSet) -> float:
    return float(driven_cm(labels)[-1]) / 1e5 if len(labels) else 0.0


def _total(extents: Sequence[Mapping[str, int | float]]) -> Sheet:
    return {key: sum(extent[key] for extent in extents) for key in ("drives", "frames", "minutes", "km")}


def _recorded(job: RecordedJob, data: PreparedData) -> Sheet:
    """Describe a recorded drive by its map, its label sets and what people said of it."""
    recording, labels = job.recording, read_places(job.whole)
    drive_map = None if job.is_labels else read_map(job.frames)
    source = job.recording.path if drive_map is None else Path(drive_map.meta.drive)
    roles = {part.role: _extent(part) for part in data.parts if part.frames == job.frames}
    facts: Sheet = {
        "name": labels.drive[0] if len(labels) else source.name,
        "from": "label set" if job.is_labels else "map",
        **_told(recording, source),
        "lane_width_cm": recording.lane_width_cm,
        "marking_cm": labels.meta.marking_cm,
        "split": chosen_split(labels, recording),
        "counts_as": recording.counts_as,
        "weight": recording.weight,
        "parts": roles,
    }
    return facts | (dict.fromkeys(_MAPPED) if drive_map is None else _mapped(drive_map))


_MAPPED = ("verdict", "laps", "shape", "lines", "camera")


def _mapped(drive_map: DriveMap) -> Sheet:
    """Describe road and camera as the map has them."""
    lines: dict[str, set[str]] = {}
    for line in (line for lines in drive_map.lines.values() for line in lines if line.rank == 0):
        if np.isfinite(line.unpainted):
            lines.setdefault(line.side, set()).add("dashed" if line.dashed else "solid")
    meta = drive_map.meta
    closed = any(line.period_cm is not None for lines in drive_map.lines.values() for line in lines)
    return {
        "verdict": meta.verdict,
        "laps": meta.laps,
        "shape": "closed" if closed else "open",
        "lines": {side: " and ".join(sorted(kinds)) for side, kinds in sorted(lines.items())},
        "camera": camera_kinds([drive_map.camera])[0],
    }


def _told(recording: RecordedSettings, source: Path) -> Sheet:
    """What people said of a drive: in the run's config or library, that of this folder, or ``drive.yaml``."""
    told: Sheet = {key: getattr(recording, key) or None for key in ("licence", "car", "track")}
    # A sheet comes at the end of a long training, which a damaged file of these must not spoil.
    with contextlib.suppress(LanenetError):
        entry = Library.open(DEFAULT_LIBRARY).find(source) if DEFAULT_LIBRARY.is_file() else None
        if entry is not None:
            told = {key: told[key] or getattr(entry, key) or None for key in told}
    with contextlib.suppress(LanenetError):
        told["licence"] = told["licence"] or read_drive_file(source)[0].licence or None
    return told
