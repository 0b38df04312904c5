"""``lanenet export``: the files that the car runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import check_ending, lock_outputs
from lanenet.errors import ConfigError

app = typer.Typer()


@app.command(epilog="Example: lanenet export checkpoints/small --out runs/small.onnx")
def export(
    checkpoint: Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="Checkpoint folder.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Model to write; default CHECKPOINT/model.onnx, with --int8 model-int8.onnx."),
    ] = None,
    check: Annotated[
        list[Path] | None,
        typer.Option(help="Also check the file on the frames of these labels.", metavar="LABELS.parquet"),
    ] = None,
    int8: Annotated[
        bool,
        typer.Option(
            "--int8",
            help="Quantise CHECKPOINT/model.onnx to INT8, and show what it costs in cm and saves in time.",
        ),
    ] = False,
) -> None:
    """Write a checkpoint as one ONNX file, checked against PyTorch."""
    if out is not None:
        check_ending(out, ".onnx")
    if int8 and check:
        raise ConfigError("--check: compares with PyTorch; it cannot be combined with --int8")
    lock_outputs(out)
    if int8:
        from lanenet.learn.export import export_int8
        from lanenet.perception.network.model_file import MODEL_NAME

        path, report = export_int8(checkpoint, out)
        console.show_lines(report.lines)
        console.wrote(path, path.with_suffix(".json"))
        path = path if report.recommended else checkpoint / MODEL_NAME
    else:
        from lanenet.learn.export import export_checkpoint

        path, rasters, difference = export_checkpoint(checkpoint, out, check or ())
        console.say(f"onnxruntime and PyTorch differ by {difference:.1g} cm at most, on {rasters} rasters")
        console.wrote(path)
    console.next_command("bench", "--model", path)
