"""The report page of a map: one self-contained HTML file, readable on a phone."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable, Sequence
from string import Template
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.quality import plots
from datagen.quality.measure import MapQuality
from datagen.quality.pictures import contact_sheets
from datagen.quality.residuals import REFERENCE_WIDTH
from datagen.quality.verdict import Verdict, VerdictSettings
from datagen.slam.commands import SteeringFit
from lanenet.data.maps.folder import MapMeta
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES, SIDES

#: The report in a map's folder.
PAGE_NAME = "report.html"

Row = tuple[str, ...]

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
        quality: The map compared with its held-out frames.
        verdict: The verdict.
        figures: The contents of ``report.json``.
        opened_poses: Poses before the loops were closed, in the map's scale.
        map_png: Picture of the map from above.
        settings: Bounds of the verdict, drawn in the residual plot.
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
            "Distance in pixels between the projected borders of the driven lane's two lines and the edges "
            f"in {held['frames']} held-out frames, whose edges were used for their own poses but not for the "
            f"lines. An edge counts if it lies within {held['gate_px_at_160']:g} px (of an image 160 px "
            "wide) and brightens in the same direction. “Found” is the share of the borders in view that met "
            f"an edge. In the middle of the lane it is {_percent(chance)}: by chance, or because of paint."
        ),
        _table(residual_rows(held, drive.width)),
        _plot(plots.residual_plot, quality, drive.width, settings.max_sd_px, settings.max_p95_px),
        *(
            f"<h3>{title.capitalize()} held-out frames</h3>{_jpeg(sheet)}"
            for title, sheet in contact_sheets(mapped, quality).items()
        ),
        _section("Labels"),
        _table(share_rows(figures["labelled"])),
        _plot(plots.frames_plot, quality, drive, drive_map, drive.width),
        _section("Map"),
        _note("Edge points (hue: time), driven path (white), left line (green), right line (magenta)."),
        _jpeg(np.asarray(cv2.imdecode(np.frombuffer(map_png, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)),
        _section("Path and loops"),
        _table(loop_rows(figures["segments_mapped"])),
        _plot(plots.trajectory_plot, mapped, opened_poses),
        _section("Camera and scale"),
        _table(camera_rows(drive_map.camera, figures.get("calibration"))),
        _table(scale_rows(drive_map.meta)),
        _list(verdict.remarks),
        _section("Steering and speed"),
        _plot(plots.steering_plot, mapped, fits)
        or _note("There is no steering command, or it does not explain the path."),
        _plot(plots.speed_plot, mapped),
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
    """Lay out rows of text; the first row is the header."""
    head, *rest = ("".join(f"<T>{html.escape(cell)}</T>" for cell in row) for row in rows)
    lines = [head.replace("T>", "th>"), *(row.replace("T>", "td>") for row in rest)]
    return '<div class="scroll"><table>' + "".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"


def _plot(draw: Callable[..., bytes | None], *args: Any) -> str:
    """Inline a plot; nothing without Matplotlib."""
    try:
        png = draw(*args)
    except ImportError:
        return ""
    return "" if png is None else _inline(png, "png")


def _jpeg(image: UInt8[np.ndarray, "h w 3"]) -> str:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])
    return _inline(data.tobytes(), "jpeg")


def _inline(data: bytes, kind: str) -> str:
    return f'<img alt="" src="data:image/{kind};base64,{base64.b64encode(data).decode("ascii")}">'


def _number(value: float | None, decimals: int = 2) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def residual_rows(held_out: dict[str, Any], width: int) -> list[Row]:
    """Residuals by line and distance, in pixels of the image and of an image 160 px wide."""
    wide = width != REFERENCE_WIDTH
    own = ("sd, px", "p95, px", "offset, px")
    header = ("", "places", "found, %", *own, *(f"{name} at 160" for name in own if wide))
    keys = ("robust_sd_px", "p95_px", "median_px")
    rows: list[Row] = [header]
    reach = f"0-{held_out['reach_cm']:g} cm"
    parts = [(f"both lines, {reach}", held_out["both_lines"])]
    for side in SIDES:
        line = held_out["lines"][side]
        parts.append((f"{side} line, {reach}", line[reach]))
        parts += [(f"{side} line, {band}", figures) for band, figures in line["bands"].items()]
    for name, figures in parts:
        values = [_number(figures[key]) for key in keys]
        values += [_number(figures[f"{key}_at_160"]) for key in keys if wide]
        coverage = _number(100.0 * figures["coverage"], 0)
        rows.append((name, str(figures["samples"]), coverage, *values))
    return rows


def share_rows(labelled: dict[str, Any]) -> list[Row]:
    """Shares of labelled frames and points, and reasons for frames without labels."""
    rows: list[Row] = [
        ("frames", ""),
        ("labelled, of those not deleted", f"{100.0 * labelled['share']:.1f} %"),
        ("labelled, of all", f"{100.0 * labelled['share_of_all_frames']:.1f} %"),
        *(
            (f"{side} points labelled, of those in the window", f"{100.0 * share:.1f} %")
            for side, share in labelled["points_in_window"].items()
        ),
    ]
    rows += [(f"left out: {reason}", str(count)) for reason, count in labelled["why_not"].items()]
    return rows + [
        (f"{name} known", f"{100.0 * share:.1f} %")
        for name, share in zip(POINT_NAMES, labelled["points_share"], strict=True)
    ]


def loop_rows(segments: list[dict[str, Any]]) -> list[Row]:
    """Distance, revisits, loop closure and residuals between frames, by segment."""
    rows = []
    for segment in segments:
        closure = segment["closure_residual_median"]
        rows.append(
            {
                "first frame": str(segment["first_frame"]),
                "frames": str(segment["frames"]),
                "distance, m": _number(0.01 * segment["path_cm"], 1),
                "revisits": str(segment["revisits"]),
                "closure along, cm": _number(closure["along_cm"]),
                "across, cm": _number(closure["across_cm"]),
                "heading, deg": _number(_degrees(closure["heading_rad"])),
                "drift, deg/m": _number(_degrees(segment["heading_drift_rad_per_m"])),
                "between frames, px": _number(segment["reprojection_robust_sd_px"]),
            }
        )
    return [tuple(rows[0]), *(tuple(row.values()) for row in rows)]


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def camera_rows(camera: Camera, calibration: dict[str, Any] | None) -> list[Row]:
    """The camera's parameters, with their sigmas if they were found from the drive."""
    m, height_cm = camera.mounting, camera.mounting.height_cm
    sigma: dict[str, float] = {} if calibration is None else calibration["sigma"]
    focal = float(camera.K[0, 0])
    degree = math.degrees(1.0)
    # Name, value, decimals, key of the sigma, and the factor that converts the sigma to this unit.
    values = [
        ("focal length, px", focal, 2, "focal", focal),
        ("principal point u, px", float(camera.K[0, 2]), 2, "cx", 1.0),
        ("principal point v, px", float(camera.K[1, 2]), 2, "cy", 1.0),
        ("k1", float(camera.D[0]) if len(camera.D) else 0.0, 4, "k1", 1.0),
        ("pitch down, deg", math.degrees(m.pitch_down_rad), 2, "pitch", degree),
        ("roll, deg", math.degrees(m.roll_rad), 2, "roll", degree),
        ("yaw, deg", math.degrees(m.yaw_rad), 2, "yaw", degree),
        ("ahead of the rear axle, cm", m.ahead_of_front_axle_cm + camera.wheelbase_cm, 2, "lever", height_cm),
        ("height, cm", height_cm, 2, None, 1.0),
    ]
    rows: list[Row] = [(f"camera ({camera.model})", "value", "sigma")]
    for name, value, decimals, key, factor in values:
        known = None if key is None or key not in sigma else sigma[key] * factor
        rows.append((name, _number(value, decimals), _number(known, decimals)))
    return rows


def scale_rows(meta: MapMeta) -> list[Row]:
    """What sets the scale, and the resulting widths."""
    return [
        ("scale from", meta.scale_from),
        ("lane width given, cm", f"{meta.lane_width_cm:.1f}"),
        ("lane width on the map, cm", f"{meta.mapped_lane_cm:.1f}"),
        ("marking on the map, cm", f"{meta.tape_cm:.1f}"),
    ]
