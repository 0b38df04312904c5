"""``lanenet join``: maps of several drives of one track become one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console

app = typer.Typer()


@app.command(epilog="Example: lanenet join runs/monday runs/tuesday --out runs/track")
def join(
    maps: Annotated[list[Path], typer.Argument(metavar="MAP...", help="Maps of drives of one track.")],
    out: Annotated[Path, typer.Option(help="Folder for the joined maps.")],
) -> None:
    """Put maps of one track into one frame, with one set of lines; refuse those of another track.

    The track is known again by the shape of its lines, from any start and in both directions. Cars that
    shared a camera get one that fits all drives. Lines that were laid anew between the drives are named and
    give no labels there.
    """
    from datagen.tracks.join import join_maps

    with console.progress_bar("join") as progress:
        report = join_maps(maps, out, progress)
    console.show_lines(report.lines)
    console.wrote(out, out / "map.png")
    console.next_command("label", out, "--out", out.with_suffix(".parquet"))
