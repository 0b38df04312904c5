"""Plots of a map's report, as PNG images; without Matplotlib they raise ImportError."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from datagen.quality.measure import LABELLED, VERDICT_REACH_CM, MapQuality
from datagen.quality.residuals import join_samples, summarise
from datagen.slam.commands import commands_of, delayed
from lanenet.data.drives import Drive
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import DELETED, MappedDrive
from lanenet.evaluation.report import new_figure, png_bytes
from lanenet.geometry.lane import SIDES
from lanenet.page import PLOT_DPI, PLOT_WIDTH_IN

#: Colours of the lines, as in the pictures.
_COLOURS = {"left": "#2e9e2e", "right": "#c832c8"}
#: Distance bins of the residuals. Chosen: three per label row.
_BIN_CM = 5.0


def _figure(height_in: float, panels: int = 1) -> tuple[Any, list[Any]]:
    """Make a figure with panels one below the other."""
    figure = new_figure(PLOT_WIDTH_IN, height_in, PLOT_DPI)
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
    figure, (axes,) = _figure(3.8)
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


def residual_plot(quality: MapQuality) -> bytes:
    """Residuals and coverage over the distance ahead, by line."""
    figure, (axes, below) = _figure(4.4, 2)
    every = join_samples(quality.samples)
    edges = np.arange(0.0, max(float(every.ahead_cm.max(initial=0.0)), VERDICT_REACH_CM) + _BIN_CM, _BIN_CM)
    centres = 0.5 * (edges[:-1] + edges[1:])
    for side in SIDES:
        part = every.select(every.right == (side == "right"))
        bins = [
            summarise(part.select((part.ahead_cm >= a) & (part.ahead_cm < b)))
            for a, b in pairwise(edges.tolist())
        ]
        for name, style, values in (
            ("p95", ".--", [quality.scale * b.p95_px for b in bins]),
            ("robust sd", "o-", [quality.scale * b.robust_sd_px for b in bins]),
        ):
            axes.plot(centres, values, style, color=_COLOURS[side], label=f"{side}, {name}", lw=0.9, ms=3)
        below.plot(centres, [100.0 * b.coverage for b in bins], "o-", color=_COLOURS[side], label=side, ms=3)
    for ax in (axes, below):
        ax.axvline(VERDICT_REACH_CM, color="gray", lw=0.8, ls=":")
    axes.set(ylim=(0.0, None), ylabel="px at 160 px width")
    axes.legend(fontsize=7, ncol=2)
    below.set(ylim=(0.0, 105.0), ylabel="edge found, %", xlabel="ahead of the front axle, cm")
    return png_bytes(figure)


def frames_plot(quality: MapQuality, drive: Drive, drive_map: DriveMap) -> bytes:
    """Residuals of held-out frames, and labelled frames with the reasons of the others, along the drive."""
    figure, (axes, strip) = _figure(5.0, 2)
    median_px = quality.frame_median_px * quality.scale
    axes.plot(drive_map.frames[quality.held_out], median_px, ".", color="#2060c0", ms=4)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("median residual\nof held-out frame, px", fontsize=8)
    status = np.array(quality.status)
    names = [LABELLED, *(reason for reason in quality.not_labelled)]
    for i, name in enumerate(names):
        colour = "#2e9e2e" if name == LABELLED else "#999999" if name == DELETED else f"C{(i + 2) % 10}"
        at = drive.frames[status == name]
        strip.plot(at, np.full(len(at), i), "|", color=colour, ms=7)
        # Above its row: beside it, a phone has no room for words.
        strip.text(drive.frames[0], i - 0.3, f"{name} ({len(at)})", fontsize=7, va="bottom")
    strip.set(ylim=(len(names) - 0.5, -1.0), yticks=[], xlabel="frame")
    return png_bytes(figure)


def steering_plot(mapped: MappedDrive, delay_frames: int) -> bytes | None:
    """Curvature of the driven path over the steering command, with a line fitted to each segment.

    Args:
        mapped: The map with its drive.
        delay_frames: Delay of the steering.

    Returns:
        None where nothing was commanded.
    """
    drive, drive_map, rows = mapped.drive, mapped.drive_map, mapped.rows
    turn = commands_of(drive, drive_map.camera.wheelbase_cm).turn
    if turn is None:
        return None
    figure, (axes,) = _figure(3.2)
    for segment in np.unique(drive_map.segment).tolist():
        part = np.flatnonzero(drive_map.segment == segment)
        if len(part) < 3:
            continue
        delta = np.diff(drive_map.poses[part], axis=0)
        step = np.hypot(delta[:, 0], delta[:, 1])
        moving = (step > 0.3 * np.median(step)) & ~mapped.starts[part[1:]]
        command = delayed(turn, delay_frames)[rows[part]][1:][moving]
        curvature = 100.0 * delta[moving, 2] / step[moving]
        axes.plot(command, curvature, ".", ms=2, alpha=0.5, color=f"C{segment}")
        if np.std(command) < 1e-9 or np.std(curvature) < 1e-9:
            continue
        gain, trim = np.polyfit(command, curvature, 1)
        r = float(np.corrcoef(command, curvature)[0, 1])
        ends = np.array([command.min(), command.max()])
        label = f"{gain:.2f} per unit, delay {delay_frames} frames, r = {r:.2f}"
        axes.plot(ends, gain * ends + trim, "k-", lw=1.0, label=label)
    axes.set(xlabel="steering command, positive left", ylabel="curvature, 1/m")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    return png_bytes(figure)


def speed_plot(mapped: MappedDrive) -> bytes:
    """Step length of each frame, with the commanded speed or throttle."""
    drive, drive_map, rows = mapped.drive, mapped.drive_map, mapped.rows
    figure, (axes,) = _figure(2.6)
    step = np.hypot(*np.diff(drive_map.poses[:, :2], axis=0).T)
    # A step across a break was not driven by the car.
    step[mapped.starts[1:]] = np.nan
    axes.plot(drive_map.frames[1:], step, "-", color="#2060c0", lw=0.8)
    # Single steps across what was left out of the drive would flatten all others.
    axes.set(ylim=(0.0, 1.5 * float(np.nanpercentile(step, 99.0))), xlabel="frame")
    axes.set_ylabel("step length, cm", color="#2060c0")
    commands = drive.commands
    for values, name in ((commands.speed_cm_s, "commanded speed, cm/s"), (commands.throttle, "throttle")):
        if values is not None:
            other = axes.twinx()
            other.plot(drive.frames[rows], values[rows], "-", color="#d08020", lw=0.6, alpha=0.7)
            other.set_ylabel(name, color="#d08020")
            break
    return png_bytes(figure)
