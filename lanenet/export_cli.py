"""The verb that makes the files which the car runs: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet import console

app = typer.Typer()


@app.command(epilog="Example: lanenet export checkpoints/small --out small.onnx")
def export(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="CHECKPOINT", help="Checkpoint folder.", show_default=False)
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Model to write; default CHECKPOINT/model.onnx, with --int8 model-int8.onnx."),
    ] = None,
    int8: Annotated[
        bool,
        typer.Option(
            "--int8", help="Quantise CHECKPOINT/model.onnx, and say what that costs and brings here."
        ),
    ] = False,
) -> None:
    """Write a checkpoint as one ONNX file, checked against PyTorch."""
    if int8:
        from lanenet.learn.quantise import export_int8

        path, report = export_int8(checkpoint, out)
        console.show_lines(report.lines)
        console.wrote(path, path.with_suffix(".json"))
    else:
        from lanenet.learn.export import export_checkpoint

        path = export_checkpoint(checkpoint, out)
        console.wrote(path)
    console.next_command("bench", "--model", path)
