"""``lanenet map``: a drive becomes poses and a map of its lane lines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    CameraOption,
    DriveArgument,
    MappingOption,
    WheelbaseOption,
    lane_cm,
    length_cm,
)
from lanenet.config import load_settings
from lanenet.errors import LanenetError

app = typer.Typer()


@app.command("map", epilog="Example: lanenet map data/tub --lane-width 40 --out runs/tub")
def map_drive(
    drive: DriveArgument,
    lane_width: Annotated[
        float,
        typer.Option(parser=lane_cm, metavar="CM", help="Between the middles of the lane's two lines, cm."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the map.")],
    camera: CameraOption = None,
    config: MappingOption = None,
    refine_camera: Annotated[
        bool, typer.Option("--refine-camera", help="Adjust a known camera to this drive.")
    ] = False,
    wheelbase: WheelbaseOption = None,
    camera_height: Annotated[
        float | None,
        typer.Option(
            parser=length_cm,
            metavar="CM",
            help="Height of the lens above the road, cm: helps to find a camera that is not known.",
        ),
    ] = None,
    tape_width: Annotated[
        float | None,
        typer.Option(parser=length_cm, metavar="CM", help="Width of the tape, cm: checks the lane width."),
    ] = None,
) -> None:
    """Find the poses of a drive and a map of its lane lines; without a camera, find that too."""
    from datagen.pipeline import MapRequest, MapSettings
    from datagen.pipeline import map_drive as run

    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    request = MapRequest(drive, lane_width, camera, refine_camera, wheelbase, camera_height, tape_width)
    with console.progress_bar("map") as progress:
        report = run(request, settings, out, progress)
    console.show_lines(report.lines)
    console.wrote(out, out / "report.html")
    if report.figures["verdict"]["grade"] == "reject":
        raise LanenetError(f"{out}: the map was rejected: it is kept for inspection, but gives no labels")
    console.next_command("label", out, "--out", out.with_suffix(".parquet"))
