"""``lanenet track`` and ``lanenet sheets``: synthetic roads and frames to look at."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import check_ending, lock_outputs
from lanenet.errors import ConfigError

app = typer.Typer()


@app.command(epilog="Example: lanenet track bfmc --out runs/bfmc.png --seed 3")
def track(
    road: Annotated[
        str,
        typer.Argument(metavar="FILE|PRESET", help="YAML file, or name of a preset."),
    ],
    out: Annotated[Path, typer.Option(help="Picture to write (.png).")],
    seed: Annotated[int, typer.Option(min=0, help="Seed for what the road file leaves open.")] = 0,
    size: Annotated[int, typer.Option(min=100, max=20_000, help="Longer side of the picture, px.")] = 1600,
) -> None:
    """Check a road and draw it from above."""
    import numpy as np

    from datagen.world.road.build import random_track
    from datagen.world.road.track_picture import draw_track, picture_scale
    from datagen.world.road.track_settings import load_track_settings, preset, preset_names
    from lanenet.data.files import write_bytes
    from lanenet.data.tables import png_bytes

    check_ending(out, ".png")
    lock_outputs(out)
    path = Path(road)
    if path.suffix.lower() in (".yaml", ".yml") or path.exists():
        settings = load_track_settings(path)
    elif road in preset_names():
        settings = preset(road)
    else:
        raise ConfigError(
            f"{road}: expected a YAML file, or a preset: {', '.join(preset_names())}; found neither"
        )
    drawn = random_track(settings, np.random.default_rng(seed))
    picture = draw_track(drawn, picture_scale(drawn, size), settings.floor_bgr)
    tightest = float(np.max(np.abs(drawn.curvature_per_cm)))
    radius = f"{1.0 / tightest:.0f} cm" if tightest > 1e-6 else "none"
    console.say(
        f"{'loop' if drawn.closed else 'road'} of {drawn.length_cm:.0f} cm, {settings.lanes} lane(s) of "
        f"{drawn.lane_width_cm:g} cm, tightest bend {radius}, {len(drawn.markings)} lines, "
        f"{len(drawn.boxes)} painted rectangles"
    )
    write_bytes(out, png_bytes(picture))
    console.wrote(out)
    console.next_command(
        "simulate", "CONFIG", f"track.{'file' if path.exists() else 'preset'}={road}", "--out", "DRIVE"
    )


@app.command(epilog="Example: lanenet sheets bfmc light --out runs/sheets")
def sheets(
    out: Annotated[Path, typer.Option(help="Folder for the pictures (.jpg).")],
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="Presets and groups of effects; default all.")
    ] = None,
    max_kb: Annotated[int | None, typer.Option(min=5, help="Shrink each picture to so many kB.")] = None,
) -> None:
    """Draw sheets of frames to look at: presets in random looks, and effects one by one."""
    from datagen.world.sheets import draw_sheet, encode_sheet, sheet_names
    from lanenet.data.files import write_bytes

    chosen = sheet_names() if not names else list(dict.fromkeys(names))
    for name in chosen:
        if name not in sheet_names():
            raise ConfigError(f"no sheet {name!r}, expected some of {', '.join(sheet_names())}")
    lock_outputs(out)
    paths = [out / f"{name}.jpg" for name in chosen]
    with console.progress_bar("sheets") as progress:
        for done, (name, path) in enumerate(zip(chosen, paths, strict=True)):
            progress(done, len(chosen))
            data = encode_sheet(draw_sheet(name), None if max_kb is None else 1000 * max_kb)
            write_bytes(path, data)
        progress(len(chosen), len(chosen))
    console.wrote(*paths)
    console.next_command("track", "PRESET", "--out", "PICTURE.png")
