"""Label sets with their pictures as folders that other tools read.

A format is a module with a function that fills a folder, and one entry in :data:`EXPORTS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import yaml

from lanenet.data.camera_file import write_camera
from lanenet.data.exports import coco, huggingface, tusimple
from lanenet.data.exports.pictures import Pictures, open_pictures
from lanenet.data.files import atomic_folder, check_replaceable, write_text
from lanenet.errors import ConfigError

EXPORT_FILE, EXPORT_FORMAT = "export.yaml", "lanenet-export/1"


@dataclass(frozen=True)
class ExportFormat:
    """A format of exported labels.

    Attributes:
        fill: Fills a folder; returns how many points it wrote.
        reading: How to read it, for its README.
        header: What stands at the head of the README for a number of frames, as YAML; None for nothing.
    """

    fill: Callable[[Path, Pictures], int]
    reading: str
    header: Callable[[Pictures, int], dict[str, object]] | None = None


EXPORTS: dict[str, ExportFormat] = {
    "huggingface": ExportFormat(huggingface.fill, huggingface.READING, huggingface.card_header),
    "tusimple": ExportFormat(tusimple.fill, tusimple.READING),
    "coco": ExportFormat(coco.fill, coco.READING),
}


@dataclass(frozen=True)
class ExportReport:
    """What was exported: frames, points in the format's own count, and what was left out."""

    frames: int
    points: int
    problems: tuple[str, ...]


def check_export(out: Path, force: bool) -> None:
    """Refuse a folder that :func:`export_labels` would not write.

    Raises:
        ConfigError: If an earlier export is there, and ``force`` is False.
        LanenetError: If another folder or a file is there.
    """
    check_replaceable(out, "export")
    if not force and out.is_dir() and any(out.iterdir()):
        raise ConfigError(f"{out}: holds an export already; choose another name, or replace it with --force")


def export_labels(
    labels: Path,
    frames: Path,
    name: str,
    out: Path,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ExportReport:
    """Write labels and their pictures in the format of other tools.

    Args:
        labels: The label set.
        frames: The map, or the simulated drive, that it was made from: gives pictures and camera.
        name: Of the format, one of :data:`EXPORTS`.
        out: Folder to write; appears when it is complete.
        force: Replace an earlier export there.
        progress: Called with frames done and all frames.

    Raises:
        ConfigError: If an earlier export is there, and ``force`` is False.
        LabelFormatError: If the labels were not made from these frames.
        DriveFormatError: If no picture can be read.
        LanenetError: If the folder cannot be written.
    """
    check_export(out, force)
    pictures, known = open_pictures(labels, frames), EXPORTS[name]
    pictures.progress = progress
    with atomic_folder(out, "export") as folder:
        points = known.fill(folder, pictures)
        count = len(pictures) - len(pictures.problems)
        if count == 0:
            raise ConfigError(f"{frames}: no picture could be read ({pictures.problems[0]})")
        write_camera(folder / "camera.yaml", pictures.camera, f"as in {frames.name}")
        header = (
            ""
            if known.header is None
            else f"---\n{yaml.safe_dump(known.header(pictures, count), sort_keys=False)}---\n\n"
        )
        write_text(folder / "README.md", header + _readme(pictures, count, known.reading))
        about = {
            "format": EXPORT_FORMAT,
            "kind": name,
            "labels": labels.name,
            "frames": count,
            "points": points,
        }
        write_text(folder / EXPORT_FILE, yaml.safe_dump(about, sort_keys=False))
    return ExportReport(count, points, tuple(pictures.problems))


def _readme(pictures: Pictures, frames: int, reading: str) -> str:
    meta, camera = pictures.labels.meta, pictures.camera
    origin = {
        "map": "The labels come from a map of the drive, not by hand: they are as exact as the map.",
        "truth": "The labels are a simulator's ground truth.",
    }[meta.source]
    return f"""# Lanes of {pictures.drive.name}

{frames} labelled frames, {camera.width}x{camera.height} px, lane of {meta.lane_width_cm:g} cm between the
middles of its two lines. {origin}

A label is the x of the left or the right line of the car's own lane at y = 0, 15 and 30 cm ahead of the
front axle, in cm, x to the right, on the ground; a line's position is the middle of its marking.
`camera.yaml` is the camera; each frame was projected with the tilt that the car had in it.

{reading}

Made by `lanenet export`.
"""
