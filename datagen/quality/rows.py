"""The rows of the tables in a map's report."""

from __future__ import annotations

import math
from typing import Any

from lanenet.data.maps.folder import DriveMap, MapMeta
from lanenet.errors import counted
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES, SIDES
from lanenet.page import Row


def percent(share: float) -> str:
    """Show a share in per cent."""
    return "unknown" if share != share else f"{100.0 * share:.0f} %"


def number(value: float | None, decimals: int = 2) -> str:
    """Show a figure; a dash if it is unknown."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def residual_rows(held_out: dict[str, Any], scale: float) -> list[Row]:
    """Residuals by line and distance, in pixels of the image and of an image 160 px wide."""
    wide = scale != 1.0
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
        values = [number(figures[key]) for key in keys]
        values += [number(figures[f"{key}_at_160"]) for key in keys if wide]
        coverage = number(100.0 * figures["coverage"], 0)
        rows.append((name, str(figures["samples"]), coverage, *values))
    return rows


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
        ("frames with labels", percent(labelled["share"])),
        ("edges from the lines, 95 % within", f"{number(held['both_lines']['p95_px_at_160'])} px"),
        ("borders of the lines found", percent(held["both_lines"]["coverage"])),
        ("lane width", f"{meta.mapped_lane_cm:.1f} cm"),
        ("tape width", f"{meta.tape_cm:.1f} cm"),
        ("camera height", f"{mounting.height_cm:.1f} cm"),
        ("camera pitch down", f"{math.degrees(mounting.pitch_down_rad):.1f} degrees"),
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
                "distance, m": number(0.01 * segment["path_cm"], 1),
                "revisits": str(segment["revisits"]),
                "closure along, cm": number(closure["along_cm"]),
                "across, cm": number(closure["across_cm"]),
                "heading, deg": number(_degrees(closure["heading_rad"])),
                "drift, deg/m": number(_degrees(segment["heading_drift_rad_per_m"])),
                "between frames, px": number(segment["reprojection_robust_sd_px"]),
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
        rows.append((name, number(value, decimals), number(known, decimals)))
    return rows


def scale_rows(meta: MapMeta) -> list[Row]:
    """What sets the scale, and the resulting widths."""
    return [
        ("scale from", meta.scale_from),
        ("lane width given, cm", f"{meta.lane_width_cm:.1f}"),
        ("lane width on the map, cm", f"{meta.mapped_lane_cm:.1f}"),
        ("marking on the map, cm", f"{meta.tape_cm:.1f}"),
    ]
