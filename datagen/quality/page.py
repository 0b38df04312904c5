"""The report page of a map."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from datagen.quality.measure import LABELLED, MapQuality
from datagen.quality.pictures import doubtful_pictures, withheld_pictures
from datagen.quality.verdict import MOST_LINES, Check, Verdict, verdict_lines
from datagen.quality.without_map import commands_without_map
from lanenet.data.drives import Drive
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.errors import counted
from lanenet.evaluation.report import new_figure, png_bytes
from lanenet.page import (
    PLOT_DPI,
    PLOT_WIDTH_IN,
    Picture,
    Row,
    bullets,
    commands,
    details,
    gallery,
    note,
    page_of,
    photo,
    plot,
    section,
    table,
)


def report_page(
    mapped: MappedDrive,
    quality: MapQuality,
    verdict: Verdict,
    figures: dict[str, Any],
    image: UInt8[np.ndarray, "h w 3"],
    out: Path,
) -> str:
    """Write the report of a map as HTML.

    Args:
        mapped: The map with its drive.
        quality: The map compared with its frames.
        verdict: The verdict.
        figures: The contents of ``report.json``.
        image: Picture of the map from above.
        out: Where the map will be.
    """
    drive, drive_map = mapped.drive, mapped.drive_map
    said = verdict_lines(verdict.reasons, verdict.remarks)
    body = [
        bullets(said[:MOST_LINES]),
        details(f"{len(said) - MOST_LINES} more", bullets(said[MOST_LINES:])),
    ]
    if verdict.grade == "reject":
        instead = commands_without_map(drive.path, out, drive_map.meta.lane_width_cm)
        body += [section("Lines all the same"), commands(instead)]
    body += [
        table(summary_rows(figures, drive_map)),
        section("Map"),
        photo(Picture(image, _map_caption(drive_map))),
    ]
    for title, text, pictures in (
        (
            "Withheld",
            "Red: most labels of the line are more likely off by 3 cm than not here, and none are given.",
            withheld_pictures(mapped, quality.wrong),
        ),
        (
            "Worst frames with labels",
            "From each part of the drive the frame with the label that is most likely to be off by more than "
            "3 cm. If the lines lie on the tape here, too, the labels are right. Green: left line, magenta: "
            "right line, red circles: the six points of a label.",
            doubtful_pictures(mapped, quality.points_cm),
        ),
    ):
        body += [section(title), note(text), gallery(pictures)] if pictures else []
    body += [
        section("Strip of frames"),
        plot(
            "Along the drive, a mark for each frame. Above: the largest standard deviation that its labels "
            "are expected to have. Below, the strip: green frames have labels, and each further row is a "
            "reason why others have none.",
            frames_plot,
            *(quality, drive, drive_map),
        ),
        section("More"),
        details("Checks of the verdict", table(check_rows(verdict.checks), texts=5)),
        details("What was done", bullets(figures["notes"])),
        details("Sections that are withheld", bullets(figures["withheld"]["places"])),
    ]
    return page_of(f"Map of {drive.name}", verdict.grade, verdict.sentence, body)


def summary_rows(figures: dict[str, Any], drive_map: DriveMap) -> list[Row]:
    """What most readers ask of a map."""
    held, labels, meta = figures["held_out"], figures["labels"], drive_map.meta
    metres = 0.01 * sum(segment["path_cm"] for segment in figures["segments_mapped"])
    camera, mounting = drive_map.camera, drive_map.camera.mounting
    return [
        ("The drive in figures", ""),
        ("frames mapped", f"{len(drive_map.frames)} of {figures['frames']}"),
        ("driven", f"{metres:.1f} m, {counted(meta.laps, 'lap') if meta.laps else 'no whole lap'}"),
        ("frames with labels", f"{labels['labelled']} of {labels['frames']}"),
        ("road with labels", f"{labels['metres']:.1f} m"),
        ("of it in bends", f"{labels['left_m']:.1f} m left, {labels['right_m']:.1f} m right"),
        ("held-out frames: borders that met an edge", f"{100.0 * held['coverage']:.0f} %"),
        ("their distance from it, robust sd", f"{held['robust_sd_px_at_160']:.2f} px of 160"),
        ("lane width", f"{meta.mapped_lane_cm:.1f} cm; scale from the {meta.scale_from}"),
        ("tape width", f"{meta.tape_cm:.1f} cm"),
        ("camera height", f"{mounting.height_cm:.1f} cm"),
        ("camera pitch down", f"{math.degrees(mounting.pitch_down_rad):.1f} degrees"),
        ("focal length", f"{camera.K[0, 0]:.1f} px"),
    ]


def check_rows(checks: tuple[Check, ...]) -> list[Row]:
    """The table of checks; what is good has no cause to be told."""
    rows: list[Row] = [("check", "found", "expected", "cause", "what to do")]
    for one in checks:
        told = ("", "") if one.grade == "good" else (one.cause, one.remedy)
        rows.append((one.name, one.found, one.bound, *told))
    return rows


def frames_plot(quality: MapQuality, drive: Drive, drive_map: DriveMap) -> bytes | None:
    """Expected errors of the labels, and labelled frames with the reasons of the others, along the drive."""
    figure = new_figure(PLOT_WIDTH_IN, PLOT_WIDTH_IN, PLOT_DPI)
    if figure is None:
        return None
    axes, strip = figure.subplots(2, 1, sharex=True)
    sigma_cm = np.where(np.isfinite(quality.points_cm), drive_map.errors.sigma_cm, 0.0).max(axis=1)
    axes.plot(drive_map.frames[sigma_cm > 0.0], sigma_cm[sigma_cm > 0.0], ".")
    axes.set(ylabel="sigma, cm", ylim=(0.0, None))
    status = np.array(quality.status)
    names = [LABELLED, *(name for name, _ in Counter(quality.status).most_common() if name != LABELLED)]
    for i, name in enumerate(names):
        at = drive.frames[status == name]
        strip.plot(at, np.full(len(at), i), "|", color="green" if name == LABELLED else f"C{i}")
        # Above its row: beside it, a phone has no room for words.
        strip.text(drive.frames[0], i - 0.1, f"{name} ({len(at)})", va="bottom", fontsize="small")
    strip.set(ylim=(len(names) - 0.5, -1.0), yticks=[], xlabel="frame")
    return png_bytes(figure)


def _map_caption(drive_map: DriveMap) -> str:
    caption = (
        "The road from above, put together from all frames. White: the driven path; green: left line, "
        "magenta: right line; dots: edges seen by the camera, coloured by time."
    )
    lines = [line for own in drive_map.lines.values() for line in own]
    if any(line.rank for line in lines):
        caption += " Blue: a line of the lane beside it."
    if any(len(line.contradicted_cm) for line in lines):
        caption += " Red: withheld, since the line is likely wrong there."
    return caption
