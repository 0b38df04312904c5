"""``lanenet export``: the files that the car runs, and labels for other tools."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import check_beside, check_ending, check_not_source, lock_outputs
from lanenet.cli.shared.standing import next_on_car
from lanenet.errors import ConfigError, counted

#: Those of lanenet.data.exports, which needs more than the car has.
_FORMATS = ("huggingface", "tusimple", "coco")
if TYPE_CHECKING:
    from lanenet.data.hub import Kind

    FormatName = str
else:
    FormatName = StrEnum("FormatName", {name: name for name in _FORMATS})

app = typer.Typer()


@app.command(epilog="Example: lanenet export checkpoints/small --out runs/small.onnx")
def export(
    source: Annotated[
        Path,
        typer.Argument(metavar="SOURCE", help="Checkpoint folder; with --format a label set (.parquet)."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Model to write; default CHECKPOINT/model.onnx, with --int8 model-int8.onnx. With --format "
            "the folder to write."
        ),
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
    format: Annotated[
        FormatName | None, typer.Option("--format", help="Write labels and their pictures for other tools.")
    ] = None,
    frames: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="MAP", help="The map, or the simulated drive, that the labels were made from."
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="With --format: replace an earlier export in the folder.")
    ] = False,
    push: Annotated[
        str | None,
        typer.Option(
            metavar="OWNER/NAME",
            help="Then put the checkpoint, or what --format huggingface wrote, on the Hugging Face Hub.",
        ),
    ] = None,
    public: Annotated[
        bool, typer.Option("--public", help="With --push: others may see it; default: only you.")
    ] = False,
) -> None:
    """Write a checkpoint as one ONNX file, checked against PyTorch; or labels in other tools' formats."""
    if format is not None:
        if int8 or check:
            raise ConfigError("--format writes labels: it cannot be combined with --int8 or --check")
        if push is not None and format != "huggingface":
            raise ConfigError(f"--push: expected --format huggingface, found {format}")
        folder = _export_labels(source, str(format), frames, out, force)
        if push is not None:
            _push(folder, push, "dataset", public)
        return
    if frames is not None or force or source.suffix == ".parquet":
        raise ConfigError(f"{source}: to export labels expected --format {'|'.join(_FORMATS)}")
    if push is not None and (int8 or out is not None or not source.is_dir()):
        raise ConfigError("--push: puts a checkpoint folder on the Hub, without --int8 and --out")
    _export_model(source, out, check or [], int8)
    if push is not None:
        _push(source, push, "model", public)


def _push(folder: Path, name: str, kind: Kind, public: bool) -> None:
    from lanenet.data.hub import push

    tags = ["lane-detection", "autonomous-driving", "donkeycar", "onnx"]
    card = {"library_name": "lanenet", "pipeline_tag": "keypoint-detection", "tags": tags}
    console.say(f"on the Hub: {push(folder, name, kind, card if kind == 'model' else None, public)}")
    again = f"hf:{name}" if kind == "model" else f"hf:datasets/{name}"
    console.next_command(
        *(("detect", "my_tub", "--model", again) if kind == "model" else ("val", "MODEL", again))
    )


def _export_labels(labels: Path, name: str, frames: Path | None, out: Path | None, force: bool) -> Path:
    from lanenet.data.exports import check_export, export_labels

    if frames is None or out is None:
        missing = (
            "--out with a folder to write" if out is None else "--map with the map that the labels are of"
        )
        raise ConfigError(f"--format {name}: expected {missing}")
    check_not_source(frames, out)
    lock_outputs(out)
    check_export(out, force)
    with console.progress_bar(f"export ({name})") as progress:
        report = export_labels(labels, frames, name, out, force, progress)
    console.show_problems(report.problems)
    console.say(f"{counted(report.frames, 'frame')} with {counted(report.points, 'point')}")
    console.wrote(out)
    console.say(f"how to read it: {out / 'README.md'}")
    return out


def _export_model(checkpoint: Path, out: Path | None, check: list[Path], int8: bool) -> None:
    if out is not None:
        check_ending(out, ".onnx")
    if int8 and check:
        raise ConfigError("--check: compares with PyTorch; it cannot be combined with --int8")
    if int8 and out is not None:
        check_beside(out, out.with_suffix(".json"))
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

        path, rasters, difference = export_checkpoint(checkpoint, out, check)
        console.say(f"onnxruntime and PyTorch differ by {difference:.1g} cm at most, on {rasters} rasters")
        console.wrote(path)
    next_on_car(checkpoint)
