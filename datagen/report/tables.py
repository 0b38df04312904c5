"""The report's tables as rows of text, the first one the header."""

from __future__ import annotations

import math
from typing import Any

from datagen.map_folder import MapMeta
from datagen.report.residuals import REFERENCE_WIDTH
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES, SIDES

Row = tuple[str, ...]


def _number(value: float | None, decimals: int = 2) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def residual_rows(held_out: dict[str, Any], width: int) -> list[Row]:
    """Residuals per line and distance; in the image's pixels and those of an image 160 px wide."""
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
    """Which frames have labels, and why others have none."""
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
    """Way, revisits, closure and residuals between frames of each segment."""
    rows: list[Row] = [
        (
            "first frame",
            "frames",
            "way, m",
            "revisits",
            "closure along, cm",
            "across, cm",
            "heading, deg",
            "drift, deg/m",
            "between frames, px",
        )
    ]
    for segment in segments:
        closure = segment["closure_residual_median"]
        heading, drift = closure["heading_rad"], segment["heading_drift_rad_per_m"]
        rows.append(
            (
                str(segment["first_frame"]),
                str(segment["frames"]),
                _number(0.01 * segment["path_cm"], 1),
                str(segment["revisits"]),
                _number(closure["along_cm"]),
                _number(closure["across_cm"]),
                _number(None if heading is None else math.degrees(heading)),
                _number(None if drift is None else math.degrees(drift)),
                _number(segment["reprojection_robust_sd_px"]),
            )
        )
    return rows


def camera_rows(camera: Camera, calibration: dict[str, Any] | None) -> list[Row]:
    """The camera's numbers, with their uncertainty where the drive told them."""
    m, height_cm = camera.mounting, camera.mounting.height_cm
    sigma: dict[str, float] = {} if calibration is None else calibration["sigma"]
    focal = float(camera.K[0, 0])
    degree = math.degrees(1.0)
    # Name, value, decimals, name of the uncertainty and the factor that turns it into this unit.
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
    """What sets the scale, and the widths that follow."""
    return [
        ("scale from", meta.scale_from),
        ("lane width given, cm", f"{meta.lane_width_cm:.1f}"),
        ("lane width on the map, cm", f"{meta.mapped_lane_cm:.1f}"),
        ("marking on the map, cm", f"{meta.tape_cm:.1f}"),
    ]
