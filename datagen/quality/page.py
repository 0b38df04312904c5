"""The report page of a map."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from datagen.quality.measure import MapQuality
from datagen.quality.pictures import held_out_pictures, withheld_pictures
from datagen.quality.plots import frames_plot, residual_plot, speed_plot, steering_plot, trajectory_plot
from datagen.quality.residuals import REFERENCE_WIDTH
from datagen.quality.verdict import Verdict, VerdictSettings
from datagen.slam.commands import SteeringFit
from lanenet.data.drives import Drive
from lanenet.data.maps.folder import DriveMap, MapMeta
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.errors import counted
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES, SIDES
from lanenet.page import (
    Picture,
    Row,
    bullets,
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
    held, pictures = figures["held_out"], held_out_pictures(mapped, quality)
    worst = pictures.pop("worst", [])
    body = [
        bullets([*verdict.reasons, *verdict.remarks]),
        table(summary_rows(figures, drive_map)),
        section("Map"),
        photo(_shown_map(map_png, drive_map)),
        *withheld_section(mapped, quality, figures["withheld"]["places"]),
        section("Worst held-out frames") if worst else "",
        note(
            "Of the frames that had no say in the lines, those whose edges lie furthest from them, in pixels "
            f"of an image {REFERENCE_WIDTH:g} px wide. If the lines lie on the tape here, too, the map is "
            f"right. {_LINES_DRAWN}"
        )
        if worst
        else "",
        gallery(worst),
        section("More"),
        details("What was done", bullets(figures["notes"])),
        details(
            "Best and median held-out frames",
            *(subsection(title.capitalize()) + gallery(shown) for title, shown in pictures.items()),
        ),
        details("Distance of the lines from the edges", *_residuals(quality, held, drive, settings)),
        details(
            "Labels",
            table(share_rows(figures["labelled"])),
            plot(
                "Along the drive: above, how far each held-out frame lies from the map; below, which frames "
                "have labels, and why others get none.",
                frames_plot,
                *(quality, drive, drive_map, drive.width),
            ),
        ),
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
        details("Steering and speed", *_commands(mapped, figures["segments_mapped"])),
    ]
    return page_of(f"Map of {drive.name}", verdict.grade, verdict.sentence, body)


def summary_rows(figures: dict[str, Any], drive_map: DriveMap) -> list[Row]:
    """What most readers ask of a map."""
    held, labelled, meta = figures["held_out"], figures["labelled"], drive_map.meta
    metres = 0.01 * sum(segment["path_cm"] for segment in figures["segments_mapped"])
    laps = counted(meta.laps, "lap") if meta.laps else "no whole lap"
    mounting = drive_map.camera.mounting
    return [
        ("The drive in figures", ""),
        ("frames mapped", f"{len(drive_map.frames)} of {figures['frames']}"),
        ("driven", f"{metres:.1f} m, {laps}"),
        ("frames with labels", _percent(labelled["share"])),
        ("edges from the lines, 95 % within", f"{_number(held['both_lines']['p95_px_at_160'])} px"),
        ("borders of the lines found", _percent(held["both_lines"]["coverage"])),
        ("lane width", f"{meta.mapped_lane_cm:.1f} cm"),
        ("tape width", f"{meta.tape_cm:.1f} cm"),
        ("camera height", f"{mounting.height_cm:.1f} cm"),
        ("camera pitch down", f"{math.degrees(mounting.pitch_down_rad):.1f} degrees"),
    ]


def _shown_map(map_png: bytes, drive_map: DriveMap) -> Picture:
    image = np.asarray(cv2.imdecode(np.frombuffer(map_png, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
    factor = _MAP_PX / max(image.shape)
    caption = (
        "The road from above, put together from all frames. White: the driven path; green: left line, "
        "magenta: right line; dots: edges seen by the camera, coloured by time."
    )
    if any(len(line.contradicted_cm) for lines in drive_map.lines.values() for line in lines):
        caption += " Red: withheld, since the images show something else there."
    return Picture(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), caption)


def _residuals(
    quality: MapQuality, held: dict[str, Any], drive: Drive, settings: VerdictSettings
) -> list[str]:
    return [
        note(
            "Distance in pixels between the projected borders of the driven lane's two lines and the edges "
            f"in {held['frames']} held-out frames, whose edges were used for their own poses but not for the "
            f"lines. An edge counts if it lies within {held['gate_px_at_160']:g} px (of an image 160 px "
            "wide) and brightens in the same direction. “Found” is the share of the borders in view that met "
            f"an edge. In the middle of the lane it is {_percent(held['coverage_by_chance'])}: by chance, or "
            "because of paint."
        ),
        plot(
            "Above: distance of edges from the lines by how far ahead they are; dotted: the bounds of a good "
            "map. Below: how much of the lines' borders met an edge.",
            residual_plot,
            *(quality, drive.width, settings.max_sd_px, settings.max_p95_px),
        ),
        table(residual_rows(held, drive.width)),
    ]


def _commands(mapped: MappedDrive, segments: list[dict[str, Any]]) -> list[str]:
    fits = [None if one["steering"] is None else SteeringFit(**one["steering"]) for one in segments]
    steering = plot(
        "Each dot is a frame: how the car was steered, and how the path bends there. On a line, the steering "
        "explains the path.",
        steering_plot,
        *(mapped, fits),
    )
    return [
        steering or note("There is no steering command, or it does not explain the path."),
        plot("Distance between neighbouring frames, and the command.", speed_plot, mapped),
    ]


def _percent(share: float) -> str:
    return "unknown" if share != share else f"{100.0 * share:.0f} %"


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


def withheld_section(mapped: MappedDrive, quality: MapQuality, places: list[dict[str, Any]]) -> list[str]:
    """The worst places: sections of the lines that the images contradict, and frames that show them."""
    pictures = withheld_pictures(mapped, quality.wrong)
    if not pictures:
        return []
    rows: list[Row] = [("line", "along the path, cm", "border seen, cm to the right", "frames")]
    for place in places:
        frames = ", ".join(str(frame) for frame in place["frames"][:_FRAMES_NAMED])
        span = f"{place['from_cm']:.0f} to {place['to_cm']:.0f}"
        rows.append((place["line"], span, _number(place["beside_cm"], 0), frames))
    return [
        section("Withheld"),
        note(
            "Red: most frames that pass here do not see the line where the map has it, but a border beside "
            "it, or none. No frame gets labels of a line there."
        ),
        gallery(pictures),
        details("Where that is", table(rows)),
    ]


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
