"""Arguments and options that mean the same in several verbs, and checks of output paths."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated

import typer

from lanenet.errors import ConfigError
from lanenet.outputs import lock_output
from lanenet.perception.registry import detector_names, listed

#: Widths of lanes. Chosen: a tenth of the width of 1:10 cars, and a road of many lanes.
_LANE_CM = (2.0, 1000.0)

ConfigArgument = Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file with the settings.")]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Settings that replace those of CONFIG.")
]


def centimetres_of_a_lane(value: float | None) -> float | None:
    """Refuse a lane's width that is no centimetres: the callback of ``--lane-width``."""
    least, most = _LANE_CM
    if value is not None and not least <= value <= most:
        metres = f"; {value:g} m are {100.0 * value:g} cm" if least <= 100.0 * value <= most else ""
        raise typer.BadParameter(
            f"{value:g}: expected the distance of the lane's two lines in cm, {least:g} to {most:g}{metres}"
        )
    return value


DriveArgument = Annotated[Path, typer.Argument(metavar="DRIVE", help="Drive, tub or video.")]
CameraOption = Annotated[
    Path | None, typer.Option("--camera", help="Camera YAML, or an earlier map of the same car.")
]
WheelbaseOption = Annotated[
    float | None, typer.Option("--wheelbase", min=0.1, help="Distance between the car's axles, cm.")
]
MappingOption = Annotated[
    Path | None, typer.Option("--config", help="YAML with the mapping's settings, or a map's settings.yaml.")
]
MarkingOption = Annotated[
    float | None,
    typer.Option(
        "--marking",
        help=f"Width of the tape for {listed(detector_names(lambda kind: kind.takes_marking))}, cm.",
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", help="Model (.onnx) or checkpoint folder of the network."),
]
AnyCameraOption = Annotated[
    bool, typer.Option("--any-camera", help="Use a model with another camera than it was trained with.")
]

#: Locks of the running command.
_held_to_the_end: ContextVar[ExitStack] = ContextVar("held_to_the_end")


def lock_outputs(*outs: Path | None) -> None:
    """Keep other runs from writing these outputs until the command ends; see :mod:`lanenet.outputs`.

    Args:
        outs: Files and folders, or the name that several of them begin with; None for none.

    Raises:
        LanenetError: If another run writes one of them.
    """
    stack = _held_to_the_end.get()
    for out in outs:
        if out is not None:
            stack.enter_context(lock_output(out))


@contextmanager
def held_to_the_end() -> Iterator[None]:
    """Keep what :func:`lock_outputs` locks in the block until its end: that of the command."""
    with ExitStack() as stack:
        token = _held_to_the_end.set(stack)
        try:
            yield
        finally:
            _held_to_the_end.reset(token)


def check_ending(path: Path, *endings: str) -> None:
    """Refuse an output whose ending is not one of its format.

    Raises:
        ConfigError: Names the endings.
    """
    if path.suffix.lower() not in endings:
        raise ConfigError(f"{path}: expected a name that ends in {' or '.join(endings)}")


def check_not_source(source: Path, *outs: Path | None) -> None:
    """Refuse an output that would replace a file of the source, or be read as part of it next time.

    Args:
        source: Photo, video, folder of photos, drive, tub, map or label set.
        outs: Files to write; None for none.

    Raises:
        ConfigError: Names the output and the source.
    """
    for out in outs:
        if out is not None and _belongs_to(source, source.resolve(), out.resolve()):
            raise ConfigError(
                f"{out}: is a file of {source}, which this command reads, or would be taken for one; choose "
                "another name"
            )


def _belongs_to(source: Path, resolved: Path, out: Path) -> bool:
    # Imported here: commands that read no drive need not wait for OpenCV.
    from lanenet.data.drives import FORMATS, find_format
    from lanenet.data.drives.sources import PHOTO_ENDINGS

    if not resolved.is_dir():
        # A link may lead elsewhere, but the files beside a source are found by the name that was given.
        files = [pattern for known in FORMATS for pattern in known.files if "{stem}" in pattern]
        ending = source.suffix.lower()
        files = ["{stem}.json", "{stem}.png"] if ending == ".parquet" else files
        files = [] if ending in PHOTO_ENDINGS else files
        folder = source.parent.resolve()
        return out == resolved or out in {folder / name.format(stem=source.stem) for name in files}
    if resolved not in out.parents:
        return False
    if (resolved / "map.yaml").is_file():
        return out.exists()
    files = [pattern for known in FORMATS for pattern in known.files]
    is_drive_file = any(fnmatch.fnmatch(out.name.lower(), pattern) for pattern in files)
    if is_drive_file and out.parent == resolved and find_format(resolved) is not None:
        return True
    return out.exists() and out.suffix.lower() in PHOTO_ENDINGS
