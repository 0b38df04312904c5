"""``lanenet map``: a drive becomes poses and a map of its lane lines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    CameraHeightOption,
    CameraOption,
    DriveArgument,
    FramesOption,
    MappingOption,
    TapeWidthOption,
    WheelbaseOption,
    frame_range,
    lane_cm,
)
from lanenet.cli.shared.viewing import NO_VIEWS, Views, with_viewers
from lanenet.config import load_settings, read_yaml
from lanenet.errors import LanenetError

app = typer.Typer()


@app.command("map", epilog="Example: lanenet map data/tub --lane-width 40 --out runs/tub")
@with_viewers
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
    camera_height: CameraHeightOption = None,
    tape_width: TapeWidthOption = None,
    frames: FramesOption = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the map of another drive in this folder, too.")
    ] = False,
    views: Views = NO_VIEWS,
) -> None:
    """Find the poses of a drive and a map of its lane lines; without a camera, find that too."""
    from datagen.pipeline import MapRequest, MapSettings
    from datagen.pipeline import map_drive as run
    from datagen.quality.verdict import folded
    from datagen.quality.without_map import hints_without_map

    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    views.check(drive)
    if not force:
        check_same_drive(out, drive)
    numbers = None if frames is None else frame_range(frames)
    request = MapRequest(
        drive, lane_width, camera, refine_camera, wheelbase, camera_height, tape_width, numbers
    )
    with console.progress_bar("map") as progress:
        report = run(request, settings, out, progress)
    page = out / "report.html"
    console.show_lines(folded(report.lines, page))
    if views:
        view_map(views, out)
    console.wrote(out, page, *views.files)
    if report.figures["verdict"]["grade"] == "reject":
        raise LanenetError(
            f"{out}: the map was rejected: it is kept for inspection, but gives no labels",
            hints=hints_without_map(drive, out, lane_width),
        )
    console.next_command("label", out, "--out", out.with_suffix(".parquet"))


def view_map(views: Views, folder: Path) -> None:
    """Show a map and its frames in viewers."""
    from lanenet.viewers.mapped import MapToSee

    seen = MapToSee(folder)
    with views.record(seen.scene) as recording, console.progress_bar("viewers") as progress:
        for done, frame in enumerate(seen.frames(), start=1):
            recording.add(frame)
            progress(done, len(seen.mapped.rows))


def check_same_drive(out: Path, drive: Path) -> None:
    """Refuse to replace a map of another drive: it takes minutes to make, and the name may be a mistake.

    Raises:
        LanenetError: Names the other drive.
    """
    file = out / "map.yaml"
    mapped = read_yaml(file).get("drive") if file.is_file() else None
    if mapped is not None and Path(str(mapped)).resolve() != drive.resolve():
        raise LanenetError(
            f"{out}: holds the map of another drive, {mapped}; choose another --out, or add --force"
        )
