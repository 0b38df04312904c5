"""``lanenet label``: a map becomes a label set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import check_beside, check_ending, check_not_source, lock_outputs

if TYPE_CHECKING:
    from datagen.pipeline import Report

app = typer.Typer()


@app.command(epilog="Example: lanenet label runs/tub --out runs/tub.parquet")
def label(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="Folder of a map.")],
    out: Annotated[
        Path, typer.Option(help="Label set to write (.parquet); of joined maps one for each drive.")
    ],
    force: Annotated[bool, typer.Option("--force", help="Label a rejected map, too.")] = False,
    colour_weight: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=1.0, help="Weight of colour beside brightness when edges are found; default 0.75."
        ),
    ] = None,
) -> None:
    """Project a map's lane lines into each frame: six labels per frame, and a report of their quality."""
    from lanenet.data.maps.joined import maps_in

    maps = maps_in(map_folder)
    # Each drive of joined maps has a camera, frame numbers and laps of its own.
    outs = [out] if maps == [map_folder] else [out.with_stem(f"{out.stem}-{one.name}") for one in maps]
    for one, own in zip(maps, outs, strict=True):
        report = label_set(one, own, force, colour_weight)
        console.show_lines(report.lines)
    console.wrote(*outs)
    # A rejected map is refused there; its labels are not.
    console.next_command("train", outs[0] if force else maps[0], "--name", maps[0].resolve().name)


def label_set(map_folder: Path, out: Path, force: bool, colour_weight: float | None) -> Report:
    """Label a map as the command does, with its progress and without its words.

    Raises:
        ConfigError: If ``out`` is no Parquet file, or one of the map's own files.
        TrackingLostError: As :func:`datagen.pipeline.label_map`.
        LanenetError: If another run writes ``out``.
    """
    from datagen.pipeline import label_map
    from lanenet.geometry.birdseye import GENERAL_WINDOW
    from lanenet.perception.edges.road import COLOUR_WEIGHT

    check_ending(out, ".parquet")
    beside = (out.with_suffix(".json"), out.with_suffix(".png"))
    check_not_source(map_folder, out, *beside)
    check_beside(out, *beside)
    lock_outputs(out)
    with console.progress_bar("label") as progress:
        weight = COLOUR_WEIGHT if colour_weight is None else colour_weight
        return label_map(map_folder, out, progress, force=force, colour_weight=weight, window=GENERAL_WINDOW)
