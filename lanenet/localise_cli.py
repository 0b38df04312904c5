"""The verb for localising a car as it drives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet import console
from lanenet.errors import CalibrationError
from lanenet.outputs import check_ending, check_not_source

app = typer.Typer()


@app.command(
    epilog="Example: lanenet localise data/tub --camera maps/tub/camera.yaml "
    "--config maps/tub/settings.yaml --out poses.csv"
)
def localise(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Drive, tub or video.", show_default=False)
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Poses to write, frame by frame (.csv); beside it a .tum and a .png.", show_default=False
        ),
    ],
    camera: Annotated[
        Path | None, typer.Option("--camera", help="Camera YAML; default: the drive's.", show_default=False)
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML with the mapping's settings, or a map's settings.yaml.")
    ] = None,
    factor: Annotated[
        float | None,
        typer.Option(
            min=1e-3,
            help="Usual way per frame, cm; with a recorded speed its gain. Default: found at the start.",
            show_default=False,
        ),
    ] = None,
    start_frames: Annotated[
        int, typer.Option(min=60, help="Frames in which speed and steering are found.")
    ] = 300,
) -> None:
    """Run the particle filter alone, as on the car: a pose per frame as it comes, memory bounded."""
    from datagen.localise import localise as run
    from datagen.map_settings import MapSettings
    from datagen.slam.moments import StartSettings, moments_of
    from lanenet.config import load_settings
    from lanenet.data.camera_file import read_camera
    from lanenet.data.drive import open_drive

    check_ending(out, ".csv")
    check_not_source(source, out, out.with_suffix(".tum"), out.with_suffix(".png"))
    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    drive = open_drive(source)
    known = read_camera(camera) if camera is not None else drive.camera
    if known is None:
        raise CalibrationError(f"{source}: comes without a camera, expected --camera camera.yaml")
    start = StartSettings(frames=start_frames, factor=factor)
    with console.progress_bar("localise") as progress:
        report = run(moments_of(drive), known, settings, out, start, lambda done: progress(done, len(drive)))
    lines = [
        f"{report.poses} poses of {report.frames} frames, {report.segments} segment(s); "
        f"{report.unreadable} unreadable, {report.standing} standing, {report.dropped} left out",
        f"{1e3 / report.median_ms:.0f} frames/s: {report.median_ms:.2f} ms per frame (median), "
        f"{report.p99_ms:.2f} ms (p99)",
        f"map {report.map_mb:.0f} MB"
        + ("" if report.process_mb is None else f", process {report.process_mb:.0f} MB at most"),
        f"gain of the speed {report.factor:.3f}"
        if report.speed_known
        else f"usual way per frame {report.factor:.2f} cm",
        f"median match {report.match:.2f}",
    ]
    if report.steering is not None:
        lines.append(
            f"steering found: correlation {report.steering.correlation:.2f}, "
            f"delay {report.steering.lag_frames} frames"
        )
    console.show_lines(lines)
    console.wrote(report.out, report.trajectory, report.picture)
    console.next_command("map", source, "--lane-width", "CM", "--out", "MAP")
