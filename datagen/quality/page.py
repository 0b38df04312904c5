"""The report page of a map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from datagen.quality.figures import steering_answer
from datagen.quality.measure import MapQuality
from datagen.quality.pictures import held_out_pictures, withheld_pictures
from datagen.quality.plots import frames_plot, residual_plot, speed_plot, steering_plot, trajectory_plot
from datagen.quality.residuals import REFERENCE_WIDTH
from datagen.quality.rows import (
    camera_rows,
    loop_rows,
    percent,
    residual_rows,
    scale_rows,
    share_rows,
    summary_rows,
)
from datagen.quality.verdict import MOST_LINES, Verdict, verdict_lines
from datagen.quality.without_map import commands_without_map
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.page import (
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
    subsection,
    table,
)

#: Frames that are named for each section that is withheld.
_FRAMES_NAMED = 6
#: Longer side of the map on the page, [px]. Chosen: it fills a screen.
_MAP_PX = 1200
#: What one sees on a frame.
_LINES_DRAWN = "Green: left line, magenta: right line, red circles: the six points of a label."


def report_page(
    mapped: MappedDrive,
    quality: MapQuality,
    verdict: Verdict,
    figures: dict[str, Any],
    opened_poses: Float[np.ndarray, "n 3"],
    map_png: bytes,
    folder: Path,
) -> str:
    """Write the report of a map as HTML.

    Args:
        mapped: The map with its drive.
        quality: The map compared with its held-out frames.
        verdict: The verdict.
        figures: The contents of ``report.json``.
        opened_poses: Poses before the loops were closed, in the map's scale.
        map_png: Picture of the map from above.
        folder: Where the map will be.
    """
    drive, drive_map = mapped.drive, mapped.drive_map
    held, pictures = figures["held_out"], held_out_pictures(mapped, quality)
    worst = pictures.pop("worst", [])
    said = verdict_lines(verdict.reasons, verdict.remarks)
    lane_cm, rejected = drive_map.meta.lane_width_cm, verdict.grade == "reject"
    body = [
        bullets(said[:MOST_LINES]),
        details(f"{len(said) - MOST_LINES} more", bullets(said[MOST_LINES:])),
        section("Lines all the same") if rejected else "",
        commands(commands_without_map(drive.path, folder, lane_cm)) if rejected else "",
        table(summary_rows(figures, drive_map)),
        section("Map"),
        photo(_shown_map(map_png, drive_map)),
        *withheld_section(mapped, quality, figures["withheld"]["places"]),
        section("Worst held-out frames") if worst else "",
        note(
            "Of the frames that were not used for the lines, those whose edges lie furthest from them, in "
            f"pixels of an image {REFERENCE_WIDTH:g} px wide. If the lines lie on the tape here, too, the "
            f"map is right. {_LINES_DRAWN}"
        )
        if worst
        else "",
        gallery(worst),
        section("Strip of frames"),
        plot(
            "Along the drive, a mark for each frame. Above: how far each held-out frame lies from the map. "
            "Below, the strip: green frames have labels, and each further row is a reason why others have "
            "none.",
            frames_plot,
            *(quality, drive, drive_map),
        ),
        section("More"),
        details("What was done", bullets(figures["notes"])),
        details(
            "Best and median held-out frames",
            *(subsection(title.capitalize()) + gallery(shown) for title, shown in pictures.items()),
        ),
        details("Distance of the lines from the edges", *_residuals(quality, held)),
        details("Labels", table(share_rows(figures["labelled"]))),
        details(
            "Path and loops",
            plot(
                "The driven path before (dashed) and after the places that were passed twice were brought "
                "together. The dot is the start.",
                trajectory_plot,
                *(mapped, opened_poses),
            ),
            table(loop_rows(figures["segments_mapped"])),
        ),
        details(
            "Camera and scale",
            table(camera_rows(drive_map.camera, figures.get("calibration"))),
            table(scale_rows(drive_map.meta), texts=2),
        ),
        details("Steering and speed", *_commands(mapped)),
    ]
    return page_of(f"Map of {drive.name}", verdict.grade, verdict.sentence, body)


def _shown_map(map_png: bytes, drive_map: DriveMap) -> Picture:
    image = np.asarray(cv2.imdecode(np.frombuffer(map_png, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
    factor = _MAP_PX / max(image.shape)
    caption = (
        "The road from above, put together from all frames. White: the driven path; green: left line, "
        "magenta: right line; dots: edges seen by the camera, coloured by time."
    )
    if any(line.rank for lines in drive_map.lines.values() for line in lines):
        caption += " Turquoise: a line of the lane beside it."
    if any(len(line.contradicted_cm) for lines in drive_map.lines.values() for line in lines):
        caption += " Red: withheld, since the line is likely wrong there."
    return Picture(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), caption)


def _residuals(quality: MapQuality, held: dict[str, Any]) -> list[str]:
    return [
        note(
            "Distance in pixels between the projected borders of the driven lane's two lines and the edges "
            f"in {held['frames']} held-out frames, whose edges were used for their own poses but not for the "
            f"lines. An edge counts if it lies within {held['gate_px_at_160']:g} px (of an image 160 px "
            "wide) and brightens in the same direction. “Found” is the share of the borders in view that met "
            f"an edge. In the middle of the lane it is {percent(held['coverage_by_chance'])}: by chance, or "
            "because of paint."
        ),
        plot(
            "Above: distance of edges from the lines by how far ahead they are. Below: how much of the "
            "lines' borders met an edge.",
            residual_plot,
            quality,
        ),
        table(residual_rows(held, quality.scale)),
    ]


def _commands(mapped: MappedDrive) -> list[str]:
    answer = steering_answer(mapped)
    if answer is None:
        steering = note("There is no steering command, or it does not explain the path.")
    else:
        reversed_too = " It falls: the car turns the other way." if answer.correlation < 0.0 else ""
        steering = plot(
            "Each dot is a frame: how the car was steered, and how the path bends there. Along the line, the "
            f"steering explains the path.{reversed_too}",
            steering_plot,
            *(mapped, answer.delay_frames),
        )
    return [
        steering,
        plot("Distance between neighbouring frames, and the command.", speed_plot, mapped),
    ]


def withheld_section(mapped: MappedDrive, quality: MapQuality, places: list[dict[str, Any]]) -> list[str]:
    """The worst places: sections of the lines that the images contradict, and frames that show them."""
    pictures = withheld_pictures(mapped, quality.wrong)
    if not pictures:
        return []
    rows: list[Row] = [("line", "along the path, cm", "frames")]
    for place in places:
        frames = ", ".join(str(frame) for frame in place["frames"][:_FRAMES_NAMED])
        span = f"{place['from_cm']:.0f} to {place['to_cm']:.0f}"
        rows.append((place["line"], span, frames))
    return [
        section("Withheld"),
        note(
            "Red: by what most frames show that pass here, the line is more likely off by 3 cm than not. No "
            "frame gets labels of it there."
        ),
        gallery(pictures),
        details("Where that is", table(rows)),
    ]
