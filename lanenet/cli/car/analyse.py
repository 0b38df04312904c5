"""``lanenet analyse``: how accurately a camera sees the road."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import check_ending

app = typer.Typer()


@app.command(epilog="Example: lanenet analyse runs/camera.yaml --out runs/density.png")
def analyse(
    camera: Annotated[Path, typer.Argument(metavar="CAMERA", help="Camera YAML.")],
    out: Annotated[Path | None, typer.Option(help="Picture of pixels per ground cell (.png).")] = None,
) -> None:
    """Show how accurately a camera sees the road: cm per pixel and the worst steering error."""
    from lanenet.data.camera_file import read_camera
    from lanenet.data.files import write_bytes
    from lanenet.data.tables import png_bytes
    from lanenet.perception.error_analysis import analyse_errors, draw_analysis, figures

    if out is not None:
        check_ending(out, ".png")
    analysis = analyse_errors(read_camera(camera))
    console.show_table(str(camera), ("", "found", "paper"), figures(analysis))
    ahead_cm = analysis.settings.lookahead_cm
    console.say(f"L and R: the middles of the lane's two lines, {ahead_cm:g} cm ahead; -: not seen")
    if out is not None:
        write_bytes(out, png_bytes(draw_analysis(analysis)))
        console.wrote(out)
    console.next_command("doctor", "--camera", camera)
