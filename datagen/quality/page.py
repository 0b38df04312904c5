"""The report page of a map: one self-contained HTML file, readable on a phone.

The plots are PNG images; without Matplotlib they raise ImportError.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float

from datagen.quality.layout import Row, bullets, jpeg, note, page_of, plot, section, table
from datagen.quality.measure import LABELLED, VERDICT_REACH_CM, MapQuality
from datagen.quality.pictures import contact_sheets, withheld_sheet
from datagen.quality.residuals import REFERENCE_WIDTH, join_samples, summarise
from datagen.quality.verdict import Verdict, VerdictSettings
from datagen.slam.commands import SteeringFit, commands_of, delayed
from lanenet.data.drives import Drive
from lanenet.data.maps.folder import DriveMap, MapMeta
from lanenet.data.maps.mapped_drive import DELETED, MappedDrive
from lanenet.evaluation.report import new_figure, png_bytes
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES, SIDES

#: Colours of the lines, as in the pictures.
_COLOURS = {"left": "#2e9e2e", "right": "#c832c8"}
#: Distance bins of the residuals. Chosen: three per label row.
_BIN_CM = 5.0
#: Frames that are named for each section that is withheld.
_FRAMES_NAMED = 6


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
        section("What the verdict rests on"),
        bullets([*verdict.reasons, *verdict.remarks]),
        section("The drive"),
        bullets(figures["notes"]),
        section("Held-out frames"),
        note(
            "Distance in pixels between the projected borders of the driven lane's two lines and the edges "
            f"in {held['frames']} held-out frames, whose edges were used for their own poses but not for the "
            f"lines. An edge counts if it lies within {held['gate_px_at_160']:g} px (of an image 160 px "
            "wide) and brightens in the same direction. “Found” is the share of the borders in view that met "
            f"an edge. In the middle of the lane it is {_percent(chance)}: by chance, or because of paint."
        ),
        table(residual_rows(held, drive.width)),
        plot(residual_plot, quality, drive.width, settings.max_sd_px, settings.max_p95_px),
        *(
            f"<h3>{title.capitalize()} held-out frames</h3>{jpeg(sheet)}"
            for title, sheet in contact_sheets(mapped, quality).items()
        ),
        *withheld_section(mapped, quality, figures["withheld"]["places"]),
        section("Labels"),
        table(share_rows(figures["labelled"])),
        plot(frames_plot, quality, drive, drive_map, drive.width),
        section("Map"),
        note(
            "Edge points (hue: time), driven path (white), left line (green), right line (magenta); red: "
            "withheld."
        ),
        jpeg(np.asarray(cv2.imdecode(np.frombuffer(map_png, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)),
        section("Path and loops"),
        table(loop_rows(figures["segments_mapped"])),
        plot(trajectory_plot, mapped, opened_poses),
        section("Camera and scale"),
        table(camera_rows(drive_map.camera, figures.get("calibration"))),
        table(scale_rows(drive_map.meta)),
        section("Steering and speed"),
        plot(steering_plot, mapped, fits)
        or note("There is no steering command, or it does not explain the path."),
        plot(speed_plot, mapped),
    ]
    return page_of(f"Map of {drive.name}", verdict.grade, verdict.sentence, body)


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
    sheet = withheld_sheet(mapped, quality.wrong)
    if sheet is None:
        return []
    rows: list[Row] = [("line", "along the path, cm", "border seen, cm to the right", "frames")]
    for place in places:
        frames = ", ".join(str(frame) for frame in place["frames"][:_FRAMES_NAMED])
        span = f"{place['from_cm']:.0f} to {place['to_cm']:.0f}"
        rows.append((place["line"], span, _number(place["beside_cm"], 0), frames))
    return [
        section("Withheld"),
        note(
            "Along these sections most frames do not see the line where the map has it, but a border beside "
            "it, or none. No frame gets labels of a line there."
        ),
        table(rows),
        jpeg(sheet),
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


def _figure(width: float, height: float, panels: int = 1) -> tuple[Any, list[Any]]:
    """Make a figure with panels one below the other."""
    figure = new_figure(width, height, dpi=110)
    if figure is None:
        raise ImportError("Matplotlib is not installed")
    axes = figure.subplots(panels, 1, sharex=panels > 1, squeeze=False)[:, 0]
    for ax in axes:
        ax.grid(True, alpha=0.3)
    return figure, list(axes)


def _interrupted(values: Float[np.ndarray, "n d"], starts: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "m d"]:
    """Insert a row of NaN before each row that does not continue the one before: no line is drawn there."""
    return np.insert(values, np.flatnonzero(starts[1:]) + 1, np.nan, axis=0)


def trajectory_plot(mapped: MappedDrive, opened_poses: Float[np.ndarray, "n 3"]) -> bytes:
    """Driven path before and after the loops were closed."""
    figure, (axes,) = _figure(6.5, 5.0)
    drive_map = mapped.drive_map
    for poses, style, name in (
        (opened_poses, {"color": "#d08020", "lw": 1.0, "ls": "--"}, "open loop"),
        (drive_map.poses, {"color": "#2060c0", "lw": 1.3}, "closed"),
    ):
        axes.plot(*_interrupted(0.01 * poses[:, :2], mapped.starts).T, label=name, **style)
    axes.plot(*(0.01 * drive_map.poses[0, :2]), "ko", ms=4)
    axes.annotate(" start", 0.01 * drive_map.poses[0, :2], fontsize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.legend(fontsize=8)
    return png_bytes(figure)


def residual_plot(quality: MapQuality, width: int, max_sd_px: float, max_p95_px: float) -> bytes:
    """Residuals and coverage over the distance ahead, by line."""
    figure, (axes, below) = _figure(6.5, 4.6, 2)
    every = join_samples(quality.samples)
    scale = REFERENCE_WIDTH / width
    edges = np.arange(0.0, max(float(every.ahead_cm.max(initial=0.0)), VERDICT_REACH_CM) + _BIN_CM, _BIN_CM)
    centres = 0.5 * (edges[:-1] + edges[1:])
    for side in SIDES:
        part = every.select(every.right == (side == "right"))
        bins = [
            summarise(part.select((part.ahead_cm >= a) & (part.ahead_cm < b)))
            for a, b in pairwise(edges.tolist())
        ]
        for name, style, values in (
            ("p95", ".--", [scale * b.p95_px for b in bins]),
            ("robust sd", "o-", [scale * b.robust_sd_px for b in bins]),
        ):
            axes.plot(centres, values, style, color=_COLOURS[side], label=f"{side}, {name}", lw=0.9, ms=3)
        below.plot(centres, [100.0 * b.coverage for b in bins], "o-", color=_COLOURS[side], label=side, ms=3)
    for bound in (max_sd_px, max_p95_px):
        axes.axhline(bound, color="gray", lw=0.8, ls=":")
    for ax in (axes, below):
        ax.axvline(VERDICT_REACH_CM, color="gray", lw=0.8, ls=":")
    axes.set(ylim=(0.0, None), ylabel="px at 160 px width")
    axes.legend(fontsize=7, ncol=2)
    below.set(ylim=(0.0, 105.0), ylabel="edge found, %", xlabel="ahead of the front axle, cm")
    return png_bytes(figure)


def frames_plot(quality: MapQuality, drive: Drive, drive_map: DriveMap, width: int) -> bytes:
    """Residuals of held-out frames, and labelled frames with the reasons of the others, along the drive."""
    figure, (axes, strip) = _figure(6.5, 3.8, 2)
    median_px = quality.frame_median_px * REFERENCE_WIDTH / width
    axes.plot(drive_map.frames[quality.held_out], median_px, ".", color="#2060c0", ms=4)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("median residual\nof held-out frame, px", fontsize=8)
    status = np.array(quality.status)
    names = [LABELLED, *(reason for reason in quality.not_labelled)]
    for i, name in enumerate(names):
        colour = "#2e9e2e" if name == LABELLED else "#999999" if name == DELETED else f"C{(i + 2) % 10}"
        at = drive.frames[status == name]
        strip.plot(at, np.full(len(at), i), "|", color=colour, ms=9)
    strip.set_yticks(range(len(names)), [f"{n} ({int((status == n).sum())})" for n in names], fontsize=8)
    strip.set(ylim=(len(names) - 0.5, -0.5), xlabel="frame")
    return png_bytes(figure)


def steering_plot(mapped: MappedDrive, fits: list[SteeringFit | None]) -> bytes | None:
    """Curvature of the driven path over the steering command, with a fitted line; None without a fit."""
    drive, drive_map, rows = mapped.drive, mapped.drive_map, mapped.rows
    turn = commands_of(drive, drive_map.camera.wheelbase_cm).turn
    if turn is None or not any(fits):
        return None
    figure, (axes,) = _figure(6.5, 3.6)
    for segment, fit in enumerate(fits):
        part = np.flatnonzero(drive_map.segment == segment)
        if fit is None or len(part) < 3:
            continue
        delta = np.diff(drive_map.poses[part], axis=0)
        step = np.hypot(delta[:, 0], delta[:, 1])
        moving = (step > 0.3 * np.median(step)) & ~mapped.starts[part[1:]]
        command = delayed(turn[rows[part]], fit.lag_frames)[1:][moving]
        curvature = 100.0 * delta[moving, 2] / step[moving]
        axes.plot(command, curvature, ".", ms=2, alpha=0.5, color=f"C{segment}")
        if np.std(command) < 1e-9 or np.std(curvature) < 1e-9:
            continue
        # Fitted again: the filter's own fit preceded the adjustment of camera and poses.
        gain, trim = np.polyfit(command, curvature, 1)
        r = float(np.corrcoef(command, curvature)[0, 1])
        ends = np.array([command.min(), command.max()])
        label = f"{gain:.2f} per unit, delay {fit.lag_frames} frames, r = {r:.2f}"
        axes.plot(ends, gain * ends + trim, "k-", lw=1.0, label=label)
    axes.set(xlabel="steering command, positive left", ylabel="curvature, 1/m")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    return png_bytes(figure)


def speed_plot(mapped: MappedDrive) -> bytes:
    """Step length of each frame, with the commanded speed or throttle."""
    drive, drive_map, rows = mapped.drive, mapped.drive_map, mapped.rows
    figure, (axes,) = _figure(6.5, 2.8)
    step = np.hypot(*np.diff(drive_map.poses[:, :2], axis=0).T)
    # A step across a break was not driven by the car.
    step[mapped.starts[1:]] = np.nan
    axes.plot(drive_map.frames[1:], step, "-", color="#2060c0", lw=0.8)
    axes.set(ylim=(0.0, None), xlabel="frame")
    axes.set_ylabel("step length, cm", color="#2060c0")
    commands = drive.commands
    for values, name in ((commands.speed_cm_s, "commanded speed, cm/s"), (commands.throttle, "throttle")):
        if values is not None:
            other = axes.twinx()
            other.plot(drive.frames[rows], values[rows], "-", color="#d08020", lw=0.6, alpha=0.7)
            other.set_ylabel(name, color="#d08020")
            break
    return png_bytes(figure)
