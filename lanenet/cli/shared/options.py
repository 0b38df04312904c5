"""Arguments and options that mean the same in several verbs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.perception.registry import detector_names, listed

ConfigArgument = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="YAML file with the settings.", show_default=False)
]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Settings that replace those of CONFIG.")
]
DriveArgument = Annotated[
    Path, typer.Argument(metavar="DRIVE", help="Drive, tub or video.", show_default=False)
]
CameraOption = Annotated[Path | None, typer.Option("--camera", help="Camera YAML.", show_default=False)]
WheelbaseOption = Annotated[
    float | None, typer.Option("--wheelbase", min=0.1, help="Distance between the car's axles, cm.")
]
MappingOption = Annotated[Path | None, typer.Option("--config", help="YAML with the mapping's settings.")]
MarkingOption = Annotated[
    float | None,
    typer.Option(
        "--marking",
        help=f"Width of the tape for {listed(detector_names(lambda kind: kind.takes_marking))}, cm.",
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", help="Model (.onnx) or checkpoint folder of the network.", show_default=False),
]
AnyCameraOption = Annotated[
    bool, typer.Option("--any-camera", help="Use a model with another camera than it was trained with.")
]
