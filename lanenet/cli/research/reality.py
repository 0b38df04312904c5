"""``lanenet reality``: synthetic drives compared with real ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import lock_outputs
from lanenet.config import check_settings, load_settings
from lanenet.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from datagen.reality.drives import RealitySettings
    from datagen.reality.measure import MeasuredDrive
    from lanenet.data.drives import Drive
    from lanenet.geometry.camera import Camera

app = typer.Typer()

_YAML = (".yaml", ".yml")


@app.command(
    epilog="Example: lanenet reality my_tub --camera runs/camera.yaml --count 100 --out runs/reality"
)
def reality(
    drives: Annotated[
        list[Path],
        typer.Argument(metavar="REAL_DRIVE...", help="Real drives, tubs or videos."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for tables and pictures.")],
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[DRIVE=]FILE",
            help="Camera YAML of the drive with this folder name; without a name, of all others.",
        ),
    ] = None,
    synthetic: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="CONFIG|DRIVE",
            help="YAML with the settings of the synthetic drives, or a simulated drive; may be given again.",
        ),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Synthetic drives; default 60.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Frames of each of them; default 40.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of all synthetic drives; default 0.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
) -> None:
    """Compare the network's input on synthetic and on real drives: statistics, histograms, sheets."""
    from datagen.reality.drives import measure_all_synthetic
    from datagen.reality.measure import measure_drive
    from datagen.reality.report import compare, histograms, sheet, summary, table, write_report
    from lanenet.data.drives import open_drive
    from lanenet.data.files import write_bytes
    from lanenet.data.tables import png_bytes

    lock_outputs(out)
    settings, given = _synthetic(synthetic or [], {"count": count, "frames": frames, "seed": seed})
    opened = [open_drive(path) for path in drives]
    cameras = _cameras(opened, camera or [])
    simulated = [open_drive(path) for path in given]
    own = _cameras(simulated, [])
    measured: list[MeasuredDrive] = []
    with console.progress_bar("reality") as progress:

        def measure(stage: str, chosen: list[Drive], cameras: list[Camera]) -> list[MeasuredDrive]:
            found = []
            for k, (drive, lens) in enumerate(zip(chosen, cameras, strict=True)):
                progress(stage, k, len(chosen))
                found.append(measure_drive(drive, lens, settings.sampling(settings.real_frames)))
            progress(stage, len(chosen), len(chosen))
            return found

        real = measure("real drives", opened, cameras)
        if simulated:
            measured = measure("synthetic drives", simulated, own)
        else:
            measured = measure_all_synthetic(
                settings, cameras, workers, lambda *done: progress("synthetic drives", *done)
            )
    _warn_of_sizes(real, measured)
    rows, names = compare(real, measured), [drive.name for drive in real]
    headers, *lines = table(rows, names)
    console.show_table(f"{len(measured)} synthetic drives and the real ones", headers, lines)
    console.show_lines(summary(rows, names))
    how: dict[str, Any] = settings.model_dump(mode="json")
    how = {"drives": [str(path) for path in given], **how} if given else how
    paths = write_report(out, how, real, measured)
    pictures = {
        "histograms.png": histograms(rows, real, measured),
        "sheet.png": png_bytes(sheet(real, measured, settings)),
    }
    for name, data in pictures.items():
        if data is not None:
            write_bytes(out / name, data)
            paths.append(out / name)
    console.wrote(*paths)
    console.next_command("simulate", "CONFIG", "--out", "DRIVE")


def _synthetic(given: list[Path], options: dict[str, int | None]) -> tuple[RealitySettings, list[Path]]:
    """Return the settings and simulated drives that ``--synthetic`` names."""
    from datagen.reality.drives import RealitySettings

    overrides = {key: value for key, value in options.items() if value is not None}
    configs = [path for path in given if path.suffix.lower() in _YAML]
    if not configs:
        return check_settings(RealitySettings, overrides, "reality"), given
    if len(given) > 1:
        raise ConfigError(
            f"--synthetic {configs[0]}: a YAML with settings stands alone, found {len(given)} values; give "
            "one YAML file, or simulated drives"
        )
    lines = [f"{key}={value}" for key, value in overrides.items()]
    return load_settings(RealitySettings, configs[0], lines), []


def _cameras(drives: list[Drive], options: list[str]) -> list[Camera]:
    """Return each drive's camera: the one given for it, else the one given for all, else its own."""
    from lanenet.data.camera_file import read_camera

    files: dict[str, Path] = {}
    for text in options:
        # Split at the last equals sign: a drive's path may hold one, a camera file hardly does.
        name, _, file = text.rpartition("=")
        name = Path(name).name
        if name in files:
            raise ConfigError(f"--camera {text}: a camera was given for {name or 'all drives'} before")
        files[name] = Path(file)
    names = [drive.name for drive in drives]
    unknown = [name for name in files if name and name not in names]
    if unknown:
        raise ConfigError(f"--camera {unknown[0]}=...: no such drive, expected one of {', '.join(names)}")
    found = []
    for drive in drives:
        given = files.get(drive.name, files.get(""))
        lens = read_camera(given) if given is not None else drive.camera
        if lens is None:
            raise CalibrationError(
                f"{drive.path}: the drive has no camera; give --camera {drive.name}=camera.yaml (a rough "
                "one will do: focal length and pitch matter, the height does not)"
            )
        if (lens.width, lens.height) != (drive.width, drive.height):
            raise CalibrationError(
                f"{drive.path}: images of {drive.width}x{drive.height} px, but "
                f"{'its camera' if given is None else given} is of {lens.width}x{lens.height}"
            )
        found.append(lens)
    return found


def _warn_of_sizes(real: list[MeasuredDrive], synthetic: list[MeasuredDrive]) -> None:
    """Warn where image sizes differ, since the number of edge points depends on them."""
    sizes = {(drive.camera.width, drive.camera.height) for drive in real}
    other = {(drive.camera.width, drive.camera.height) for drive in synthetic} - sizes
    if other:
        shown = ", ".join(f"{w}x{h}" for w, h in sorted(other))
        console.show_problems(
            [f"synthetic images of {shown} px and real ones of other sizes: counts cannot be compared"]
        )
