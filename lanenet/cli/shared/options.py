"""Arguments and options that mean the same in several verbs, and checks of output paths."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated

import typer

from lanenet.errors import ConfigError
from lanenet.geometry.camera import NOMINAL_WHEELBASE_CM
from lanenet.geometry.lane import check_lane_width
from lanenet.outputs import lock_output
from lanenet.perception.registry import detector_names, listed

#: A length is at least this; chosen: the thinnest tape has ten times as much.
_LEAST_CM = 0.1
#: The distance of axles and the height of a lens are at least this; chosen: less than the smallest model car
#: has, and more than the metres of any.
_LEAST_CAR_CM = 2.0
#: Units that may follow a length, in cm; without one it is in cm.
_UNITS_CM = {"": 1.0, "cm": 1.0, "mm": 0.1, "m": 100.0, "in": 2.54}

ConfigArgument = Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file with the settings.")]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Settings that replace those of CONFIG.")
]


def length_cm(text: str | float) -> float:
    """Read a length in cm, or with its unit (``40``, ``40cm``, ``0.4 m``): the parser of such options.

    Typer calls it with an option's default as well, which is a number.
    """
    found = re.fullmatch(r"([+-]?[\d.,]+)\s*([a-z]*)", str(text).strip().lower(), re.ASCII)
    number, unit = found.groups() if found is not None else ("", "")
    try:
        value_cm = float(number) * _UNITS_CM[unit]
    except (ValueError, KeyError):
        point = number.replace(",", ".")
        instead = f": type {point}{unit}" if unit in _UNITS_CM and point.count(".") == 1 else ""
        raise typer.BadParameter(
            f"{text!r}: expected a number of cm, as 40 or 40.5, or one with its unit, as 40cm, 400mm, 0.4m "
            f"or 16in{instead}"
        ) from None
    if value_cm < _LEAST_CM:
        raise typer.BadParameter(f"{text}: expected a length in cm, {_LEAST_CM:g} at least")
    return value_cm


def lane_cm(text: str | float) -> float:
    """Read the width of a lane as :func:`length_cm` does, and refuse one in metres: another parser."""
    value_cm = length_cm(text)
    try:
        check_lane_width(value_cm)
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from None
    return value_cm


def car_length_cm(text: str | float) -> float:
    """Read a length of the car as :func:`length_cm` does, and refuse one in metres: another parser."""
    value_cm = length_cm(text)
    try:
        check_car_length(value_cm)
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from None
    return value_cm


def check_car_length(value_cm: float) -> None:
    """Refuse a distance of axles, or a height of the lens, that is no centimetres.

    Raises:
        ConfigError: With the centimetres of what seem to be metres.
    """
    if not _LEAST_CAR_CM <= value_cm < math.inf:
        metres = f"; {value_cm:g} m are {100.0 * value_cm:g} cm: type {100.0 * value_cm:g}"
        raise ConfigError(
            f"{value_cm:g}: expected a length of the car in cm, {_LEAST_CAR_CM:g} at least"
            f"{metres if 0.0 < value_cm < _LEAST_CAR_CM else ''}"
        )


def frame_range(text: str) -> tuple[int, int]:
    """Read the numbers of a first and a last frame, ``FIRST:LAST``: the parser of such options."""
    first, colon, last = text.partition(":")
    if not (colon and first.strip().isdecimal() and last.strip().isdecimal()):
        raise ConfigError(f"--frames {text!r}: expected FIRST:LAST, as in 700:999")
    if int(last) < int(first):
        raise ConfigError(
            f"--frames {text!r}: the last frame is before the first, expected FIRST:LAST, as in 700:999"
        )
    return int(first), int(last)


def path_or_hub(text: str) -> Path:
    """Read the path of a model or a label set, or its name on the Hub: the parser of such options."""
    if not str(text).startswith("hf:"):
        return Path(text)
    # Imported here: few names are on the Hub.
    from lanenet.data.hub import pulled

    return pulled(text)


DriveArgument = Annotated[Path, typer.Argument(metavar="DRIVE", help="Drive, tub or video.")]
CameraOption = Annotated[
    Path | None, typer.Option("--camera", help="Camera YAML, or an earlier map of the same car.")
]
WheelbaseOption = Annotated[
    float | None,
    typer.Option(
        "--wheelbase",
        parser=car_length_cm,
        metavar="CM",
        help=f"Distance between the car's axles, cm; default: nominally {NOMINAL_WHEELBASE_CM:g}.",
    ),
]
CameraHeightOption = Annotated[
    float | None,
    typer.Option(
        "--camera-height",
        parser=car_length_cm,
        metavar="CM",
        help="Height of the lens above the road, cm: helps to find a camera that is not known.",
    ),
]
TapeWidthOption = Annotated[
    float | None,
    typer.Option(
        "--tape-width", parser=length_cm, metavar="CM", help="Width of the tape, cm: checks the lane width."
    ),
]
FramesOption = Annotated[
    str | None,
    typer.Option(
        "--frames",
        metavar="FIRST:LAST",
        help="Only the frames with these numbers, both included; default: all.",
    ),
]
MappingOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="YAML with the mapping's settings, or a map's settings.yaml; default: the usual ones.",
    ),
]
MarkingOption = Annotated[
    float | None,
    typer.Option(
        "--marking",
        parser=length_cm,
        metavar="CM",
        help=f"Width of the tape for {listed(detector_names(lambda kind: kind.takes_marking))}, cm.",
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        parser=path_or_hub,
        metavar="MODEL",
        help="Model (.onnx) or checkpoint folder of the network, or hf:owner/name on the Hugging Face Hub.",
    ),
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

    A table of answers (``.csv``) may have a video's name: readers tell it from the recording's own.

    Args:
        source: Photo, video, folder of photos, drive, tub, map or label set.
        outs: Files to write; None for none.

    Raises:
        ConfigError: Names the output and the source.
    """
    for out in outs:
        if out is not None and _belongs_to(source, source.resolve(), out.resolve()):
            found = (
                f"is a file of {source}, which this command reads"
                if out.exists()
                else f"would be taken for a file of {source}, for what was recorded with it"
            )
            raise ConfigError(f"{out}: {found}; choose another name: {out.with_stem(f'{out.stem}_out')}")


def check_beside(out: Path, *others: Path, first: Path | None = None) -> None:
    """Refuse to replace files that nobody named: those that a command writes beside its output.

    Files beside an output that is there are those of the last run.

    Args:
        out: The name that was given.
        others: What is written beside it.
        first: The output itself, if its name has an ending beyond the one that was given.

    Raises:
        ConfigError: Names the file.
    """
    taken = [] if (first or out).exists() else [path for path in others if path.exists()]
    if taken:
        raise ConfigError(
            f"{taken[0]}: is there already, and would be replaced by what is written beside {out.name}; "
            f"choose another name: {out.with_stem(f'{out.stem}_out')}"
        )


def _belongs_to(source: Path, resolved: Path, out: Path) -> bool:
    # Imported here: commands that read no drive need not wait for OpenCV.
    from lanenet.data.drives import FORMATS, PHOTO_ENDINGS, find_format
    from lanenet.data.tables import is_answers

    if not resolved.is_dir():
        # A link may lead elsewhere, but the files beside a source are found by the name that was given.
        files = [pattern for known in FORMATS for pattern in known.files if "{stem}" in pattern]
        ending = source.suffix.lower()
        files = ["{stem}.json", "{stem}.png"] if ending == ".parquet" else files
        files = [] if ending in PHOTO_ENDINGS else files
        folder = source.parent.resolve()
        beside = {folder / name.format(stem=source.stem) for name in files}
        if out not in beside:
            return out == resolved
        return out.suffix.lower() != ".csv" or (out.is_file() and not is_answers(out))
    if resolved not in out.parents:
        return False
    if (resolved / "map.yaml").is_file():
        return out.exists()
    files = [pattern for known in FORMATS for pattern in known.files]
    is_drive_file = any(fnmatch.fnmatch(out.name.lower(), pattern) for pattern in files)
    if is_drive_file and out.parent == resolved and find_format(resolved) is not None:
        return True
    return out.exists() and out.suffix.lower() in PHOTO_ENDINGS
