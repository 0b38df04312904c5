"""The report for people: one HTML file that needs no other, readable on a phone."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from string import Template
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.labels.mapped_drive import MappedDrive
from datagen.report import plots
from datagen.report.quality import MapQuality
from datagen.report.sheet import contact_sheets
from datagen.report.tables import Row, camera_rows, loop_rows, residual_rows, scale_rows, share_rows
from datagen.report.verdict import Verdict, VerdictSettings
from datagen.slam.mapper import SteeringFit

#: The report in a map's folder.
PAGE_NAME = "report.html"

_PAGE = Template(
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body{font:16px/1.45 system-ui,sans-serif;max-width:60rem;margin:0 auto;padding:0 1rem 3rem;color:#222}
h1{font-size:1.4rem}h2{font-size:1.15rem;margin-top:2rem;border-bottom:1px solid #ddd}
img{max-width:100%;height:auto;display:block;margin:.5rem 0}
.verdict{padding:.6rem 1rem;border-radius:.5rem;color:#fff}
.verdict strong{font-size:1.5rem;text-transform:uppercase}
.good{background:#2e7d32}.usable{background:#b26a00}.reject{background:#b71c1c}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.9rem}
td,th{padding:.25rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}
td:first-child,th:first-child{text-align:left;white-space:normal}
p.note{color:#555;font-size:.9rem}
</style></head><body>
<h1>$title</h1>
<div class="verdict $grade"><strong>$grade</strong><ul>$reasons</ul></div>
$body
</body></html>
"""
)


def report_page(
    mapped: MappedDrive,
    quality: MapQuality,
    verdict: Verdict,
    figures: dict[str, Any],
    opened_poses: Float[np.ndarray, "n 3"],
    map_png: bytes,
    settings: VerdictSettings,
) -> str:
    """Write the report of a map as HTML.

    Args:
        mapped: The map with its drive.
        quality: What the held-out frames say.
        verdict: What it amounts to.
        figures: Everything that ``report.json`` holds.
        opened_poses: Poses before the loops were closed, in the map's scale.
        map_png: Picture of the map from above.
        settings: Bounds of the verdict, drawn beside the residuals.
    """
    drive, drive_map = mapped.drive, mapped.drive_map
    fits = [
        None if s["steering"] is None else SteeringFit(**s["steering"]) for s in figures["segments_mapped"]
    ]
    held = figures["held_out"]
    chance = held["coverage_by_chance"]
    body = [
        _list(figures["notes"]),
        _section("Held-out frames"),
        _note(
            f"Distance in pixels between the projected borders of the two lines of the driven lane and the "
            f"edges in {held['frames']} frames that had no say in the lines; their poses come from the "
            f"chain, as all do. An edge counts within {held['gate_px_at_160']:g} px (of an image 160 px "
            "wide) and if it brightens the same way. “Found” is the share of the borders in view that met "
            f"one. In the middle of the lane it is {_percent(chance)}: by chance, or because something is "
            "painted there."
        ),
        _table(residual_rows(held, drive.width)),
        _picture(plots.residual_plot(quality, drive.width, settings.max_sd_px, settings.max_p95_px)),
        *(
            f"<h3>{sheet.title.capitalize()} held-out frames</h3>{_jpeg(sheet.picture)}"
            for sheet in contact_sheets(mapped, quality)
        ),
        _section("Labels"),
        _table(share_rows(figures["labelled"])),
        _picture(plots.frames_plot(quality, drive, drive_map, drive.width)),
        _section("Map"),
        _note("Edges by time (hue), driven path (white), left line (green), right line (magenta)."),
        _jpeg(np.asarray(cv2.imdecode(np.frombuffer(map_png, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)),
        _section("Path and loops"),
        _table(loop_rows(figures["segments_mapped"])),
        _picture(plots.trajectory_plot(mapped, opened_poses)),
        _section("Camera and scale"),
        _table(camera_rows(drive_map.camera, figures.get("calibration"))),
        _table(scale_rows(drive_map.meta)),
        _list(verdict.remarks),
        _section("Steering and speed"),
        _picture(plots.steering_plot(mapped, fits))
        or _note("The steering command does not explain the path, or there is none."),
        _picture(plots.speed_plot(mapped)),
    ]
    return _PAGE.substitute(
        title=html.escape(f"Map of {drive.name}"),
        grade=verdict.grade,
        reasons="".join(f"<li>{html.escape(reason)}</li>" for reason in verdict.reasons),
        body="\n".join(part for part in body if part),
    )


def _percent(share: float) -> str:
    return "unknown" if share != share else f"{100.0 * share:.0f} %"


def _section(title: str) -> str:
    return f"<h2>{html.escape(title)}</h2>"


def _note(text: str) -> str:
    return f'<p class="note">{html.escape(text)}</p>'


def _list(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _table(rows: list[Row]) -> str:
    """Lay out rows of text; the first one is the header."""
    head, *rest = ("".join(f"<T>{html.escape(cell)}</T>" for cell in row) for row in rows)
    lines = [head.replace("T>", "th>"), *(row.replace("T>", "td>") for row in rest)]
    return '<div class="scroll"><table>' + "".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


def _picture(png: bytes | None) -> str:
    return "" if png is None else _inline(png, "png")


def _jpeg(image: UInt8[np.ndarray, "h w 3"]) -> str:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return _inline(data.tobytes(), "jpeg")


def _inline(data: bytes, kind: str) -> str:
    return f'<img alt="" src="data:image/{kind};base64,{base64.b64encode(data).decode("ascii")}">'
