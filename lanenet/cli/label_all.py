"""``lanenet label-all``: many drives become maps and label sets, on this machine or on a cluster."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import astuple
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    CameraHeightOption,
    MappingOption,
    TapeWidthOption,
    WheelbaseOption,
    lane_cm,
)
from lanenet.cli.shared.own_drive import sources_in
from lanenet.config import load_settings
from lanenet.data.drives import open_drive
from lanenet.data.library.entry import name_of
from lanenet.errors import ConfigError, DriveFormatError, LanenetError, counted
from lanenet.reading import is_folder, is_regular

if TYPE_CHECKING:
    from datagen.fleet.engine import Engine
    from datagen.fleet.result import FleetResult
    from datagen.fleet.task import FleetDrive

app = typer.Typer()

#: The log, beside the results of a storage that is a folder.
_LOG_NAME = "label-all.log"


class EngineName(StrEnum):
    """What spreads the drives over processes."""

    local = "local"
    ray = "ray"


@app.command(epilog="Example: lanenet label-all my_tub other_tub --lane-width 40 --out runs/labelled")
def label_all(
    out: Annotated[
        str, typer.Option(metavar="FOLDER|URL", help="Where maps and labels are kept, as s3://bucket/labels.")
    ],
    drives: Annotated[
        list[str] | None,
        typer.Argument(metavar="[DRIVE]...", help="Drives, tubs, videos or bags; folders of them; URLs."),
    ] = None,
    library: Annotated[
        Path | None, typer.Option(help="Also all drives of a library (lanenet drives).")
    ] = None,
    lane_width: Annotated[
        float | None,
        typer.Option(
            parser=lane_cm,
            metavar="CM",
            help="Between the middles of the lane's two lines, cm, of drives that do not say it.",
        ),
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Camera YAML of drives that do not name one.")] = None,
    wheelbase: WheelbaseOption = None,
    camera_height: CameraHeightOption = None,
    tape_width: TapeWidthOption = None,
    config: MappingOption = None,
    colour_weight: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=1.0, help="Weight of colour beside brightness when edges are found; default 0.75."
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Drives at a time; default: one per core of the machine or cluster."),
    ] = None,
    engine: Annotated[
        EngineName | None,
        typer.Option(
            help="What spreads the drives: processes of this machine (default), or Ray (with --address)."
        ),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT|auto",
            help="Ray cluster that this machine is part of; default: a new one here.",
        ),
    ] = None,
    car: Annotated[
        str, typer.Option(metavar="NAME", help="Car of the drives that are listed: they have one camera.")
    ] = "",
    track: Annotated[
        str, typer.Option(metavar="NAME", help="Track of the drives that are listed: their maps are joined.")
    ] = "",
    find_tracks: Annotated[
        bool,
        typer.Option("--find-tracks", help="Recognise drives of one track by their maps, and join them."),
    ] = False,
    each_alone: Annotated[
        bool, typer.Option("--each-alone", help="No camera for all drives of a car, and no joined maps.")
    ] = False,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Draw the report of each map and the frames of each label set.")
    ] = False,
    refused_again: Annotated[
        bool, typer.Option("--refused-again", help="Try again what was refused before.")
    ] = False,
) -> None:
    """Map and label many drives; what is finished is used, and what fails stops nothing.

    Drives of one car (of the library, or --car) share a camera that is found from them together, if theirs
    agree. Maps of one track (of the library, or --track) are joined.
    """
    from datagen.fleet.checksums import with_checksums
    from datagen.fleet.run import label_all as run
    from datagen.fleet.storage import Storage
    from datagen.fleet.task import FleetSettings
    from datagen.settings import MapSettings

    settings = FleetSettings(pictures=pictures)
    if config is not None:
        settings = settings.model_copy(update={"map": load_settings(MapSettings, config)})
    if colour_weight is not None:
        settings = settings.model_copy(update={"colour_weight": colour_weight})
    told = Told(
        lane_width,
        None if camera is None else _full(camera),
        wheelbase,
        camera_height,
        tape_width,
        car,
        track,
    )
    known = [] if library is None else drives_of_library(library, told)
    sources = [source for each in drives or () for source in found_in(each)]
    known += [told.drive(name, source) for name, source in named(sources, known).items()]
    if not known:
        raise ConfigError("expected drives, or a --library that holds some")
    storage = Storage(_full(out))
    chosen = engine_of(engine, address, workers)
    with ExitStack() as stack:
        storage.claim()
        if storage.folder is not None:
            storage.folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(console.log_file(storage.folder / _LOG_NAME))
        checked = with_checksums(known, storage)
        with console.fleet_bar() as show:
            result = run(
                checked,
                settings,
                storage,
                chosen,
                lambda counts: show(*astuple(counts)),
                refused_again=refused_again,
                each_alone=each_alone,
                find_tracks=find_tracks,
            )
        show_result(result, out)


def engine_of(name: EngineName | None, address: str | None, workers: int | None) -> Engine:
    """Return the engine that the command line names; an address is one of Ray.

    Raises:
        ConfigError: If an address is given to processes of this machine.
    """
    from datagen.fleet.local_engine import LocalEngine
    from datagen.fleet.ray_engine import RayEngine

    if name is EngineName.local and address is not None:
        raise ConfigError("--address: expected --engine ray, found local, which knows no other machines")
    if name is EngineName.ray or address is not None:
        return RayEngine(address, workers)
    return LocalEngine(workers or os.cpu_count() or 1)


def show_result(result: FleetResult, out: str) -> None:
    """Say what became of the drives.

    Raises:
        LanenetError: If some failed, or were left when a disk was full.
    """
    from datagen.fleet.page import FLEET_PAGE_NAME

    labelled, refused = result.with_labels, result.of("reject", "refused")
    failed, left, twice = (result.of(verdict) for verdict in ("failed", "left", "duplicate"))
    new = sum(found.new for found in result.drives)
    console.say(
        f"{counted(len(labelled), 'drive')} with labels, {len(refused)} refused, {len(failed)} failed, "
        f"{len(left)} left; {new} done in this run"
    )
    console.show_problems([f"{found.drive.name}: {found.reason}" for found in (*refused, *failed, *twice)])
    for car in result.cars:
        with_it = f"found from {', '.join(car.from_drives)}" if car.camera else f"none for all: {car.reason}"
        console.say(f"camera of {car.name}: {with_it}")
        console.show_problems([f"{name} keeps its own camera: {why}" for name, why in car.own.items()])
    for joint in result.tracks:
        console.say(f"{joint.name}: {len(joint.joined)} of {counted(joint.count, 'map')} joined")
        problems = [joint.reason] if joint.reason else []
        problems += [f"{name} {why}" for name, why in joint.left_out.items()]
        console.show_problems([*problems, *(f"laid anew: {text}" for text in joint.relaid)])
    console.show_problems([f"could not be compared: {text}" for text in result.uncompared])
    console.say(f"wrote {out.rstrip('/')}/{FLEET_PAGE_NAME}")
    again = "run the command again: what is finished is kept"
    if result.disk_full:
        raise LanenetError(f"{result.disk_full}; {counted(len(left), 'drive')} left; make room, then {again}")
    if failed:
        raise LanenetError(f"{counted(len(failed), 'drive')} failed, the first: {failed[0].reason}; {again}")


class Told(NamedTuple):
    """What the command line says of drives; see :class:`datagen.fleet.task.FleetDrive`."""

    lane_width_cm: float | None
    camera: str | None
    wheelbase_cm: float | None
    camera_height_cm: float | None
    tape_width_cm: float | None
    car: str = ""
    track: str = ""

    def drive(
        self,
        name: str,
        source: str,
        lane_width_cm: float | None = None,
        camera: str | None = None,
        car: str | None = None,
        track: str | None = None,
    ) -> FleetDrive:
        """Return a drive that says so much of itself; None for what it does not say.

        One that cannot be read may lack its lane width: it fails, and the others are done.

        Raises:
            ConfigError: If its lane width is not known.
        """
        from datagen.fleet.task import FleetDrive

        own_cm, readable = (None, True) if lane_width_cm else _own_width_cm(source)
        width_cm = lane_width_cm or own_cm or self.lane_width_cm
        if width_cm is None and readable:
            raise ConfigError(
                f"{source}: expected --lane-width: the distance in cm between the middles of the lane's two "
                "lines"
            )
        return FleetDrive(
            name,
            source,
            "",
            width_cm,
            camera or self.camera,
            self.wheelbase_cm,
            self.camera_height_cm,
            self.tape_width_cm,
            self.car if car is None else car,
            self.track if track is None else track,
        )


def drives_of_library(file: Path, told: Told) -> list[FleetDrive]:
    """Return the drives of a library.

    Raises:
        LibraryError: If it cannot be read.
        ConfigError: If the lane width of one is not known.
    """
    from lanenet.data.library import Library

    library = Library.open(file)
    drives = []
    for entry in library.entries():
        # It may also be just a name.
        camera = library.folder / entry.camera
        given = str(camera.resolve()) if entry.camera and camera.exists() else None
        path = str(library.path_of(entry).resolve())
        # A car may carry several cameras.
        car = f"{entry.car}, camera {entry.camera}" if entry.car and entry.camera and not given else entry.car
        drives.append(told.drive(entry.name, path, entry.lane_width_cm, given, car, entry.track))
    return drives


def _own_width_cm(source: str) -> tuple[float | None, bool]:
    """Return the lane width that a drive on this machine knows by itself, and whether it can be read."""
    if "://" in source:
        return None, True
    try:
        return open_drive(Path(source)).lane_width_cm, True
    except (LanenetError, OSError):
        return None, False


def found_in(source: str) -> list[str]:
    """Return the drives that a path or URL names: a drive, or those in a folder, by their full paths.

    What cannot be read, or is a pipe or a device, is a drive that fails: it does not stop the others.

    Raises:
        DriveFormatError: If it is a file or a folder, and no drive.
    """
    if "://" in source:
        return [source]
    path = Path(source)
    try:
        return [str(each.resolve()) for each in sources_in(path)]
    except OSError:
        return [str(path.absolute())]
    except DriveFormatError:
        if path.exists() and not is_regular(path) and not is_folder(path):
            return [str(path.absolute())]
        raise


def named(sources: Sequence[str], others: Sequence[FleetDrive] = ()) -> dict[str, str]:
    """Return sources by a name of their own: the last part of the path, numbered where that is taken.

    Args:
        sources: Paths or URLs.
        others: Drives that have names already; what is one of them is left out.
    """
    names, taken = dict[str, str](), {drive.name for drive in others}
    for source in dict.fromkeys(sources):
        if source in {drive.source for drive in others}:
            continue
        stem = name_of(Path(source))
        numbered = (stem if number == 1 else f"{stem}_{number}" for number in itertools.count(1))
        names[next(name for name in numbered if name not in names and name not in taken)] = source
    return names


def _full(place: str) -> str:
    """Return a path in full, since workers have other working folders; a URL as it is."""
    return place if "://" in place else str(Path(place).resolve())
