"""``lanenet sheets``: pictures of synthetic frames to look at."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.errors import ConfigError

app = typer.Typer()


@app.command(epilog="Example: lanenet sheets bfmc light --out runs/sheets")
def sheets(
    out: Annotated[Path, typer.Option(help="Folder for the pictures (.jpg).", show_default=False)],
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Presets and groups of effects; default all.")
    ] = None,
    max_kb: Annotated[
        int | None, typer.Option(min=5, help="Shrink each picture to so many kB.", show_default=False)
    ] = None,
) -> None:
    """Draw sheets of frames to look at: presets in random looks, and effects one by one."""
    from datagen.world.sheets import draw_sheet, encode_sheet, sheet_names
    from lanenet.data.files import write_bytes

    chosen = sheet_names() if not names else list(dict.fromkeys(names))
    for name in chosen:
        if name not in sheet_names():
            raise ConfigError(f"no sheet {name!r}, expected some of {', '.join(sheet_names())}")
    paths = [out / f"{name}.jpg" for name in chosen]
    with console.progress_bar("sheets") as progress:
        for done, (name, path) in enumerate(zip(chosen, paths, strict=True)):
            progress(done, len(chosen))
            data = encode_sheet(draw_sheet(name), None if max_kb is None else 1000 * max_kb)
            write_bytes(path, data)
        progress(len(chosen), len(chosen))
    console.wrote(*paths)
    console.next_command("track", "PRESET", "--out", "PICTURE.png")
