"""The command line: one verb per thing people do, each a thin shell over a Python function.

``datagen`` and ``lanenet.learn`` are imported inside the commands, since the car has neither torch nor numba.
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lanenet.cli import calibrate as calibrate_cli
from lanenet.cli import console
from lanenet.cli import export as export_cli
from lanenet.cli import train as train_cli
from lanenet.cli import val as val_cli
from lanenet.cli.car import drive as drive_cli
from lanenet.cli.car import verbs as onboard_cli
from lanenet.cli.outputs import check_ending, check_not_source
from lanenet.cli.research import judge as judge_cli
from lanenet.cli.research import localise as localise_cli
from lanenet.cli.research import reality as reality_cli
from lanenet.cli.research import worlds as world_cli
from lanenet.config import load_settings
from lanenet.errors import ConfigError, LanenetError

_Config = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="YAML file with the settings.", show_default=False)
]
_Overrides = Annotated[
    list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Settings that replace those of CONFIG.")
]
_CameraOption = Annotated[Path | None, typer.Option("--camera", help="Camera YAML.", show_default=False)]
#: Packages of the extras, for the message when one is missing.
_EXTRA_OF = {
    **dict.fromkeys(("torch", "torchvision", "onnx", "onnxscript", "safetensors", "tensorboard"), "train"),
    **dict.fromkeys(("scipy", "numba", "pyarrow"), "data"),
    "matplotlib": "viz",
    "optuna": "sweep",
    **dict.fromkeys(("smbus2", "serial"), "car"),
}


class _Group(TyperGroup):
    """Turns errors that are the input's fault into one line and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (LanenetError, PermissionError, FileNotFoundError, IsADirectoryError) as error:
            message = str(error)
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in _EXTRA_OF:
                raise
            message = (
                f"this command needs the package {package}, which is not installed: "
                f"pip install 'lanenet[{_EXTRA_OF[package]}]'"
            )
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise SystemExit(130) from None
        typer.echo(f"error: {message}", err=True)
        raise SystemExit(1)


app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
    help="Drive two laps, get a lane network. Every command has --help with an example.",
)


app.add_typer(train_cli.app)
app.add_typer(calibrate_cli.app, name="calibrate")
app.add_typer(onboard_cli.app)
app.add_typer(drive_cli.app)
app.add_typer(export_cli.app)
app.add_typer(localise_cli.app)
app.add_typer(val_cli.app)
app.add_typer(world_cli.app)
app.add_typer(judge_cli.app)
app.add_typer(reality_cli.app)


def main() -> None:
    """Run the command line; the entry point of the package."""
    app()


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"lanenet {metadata.version('lanenet')}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


@app.command(epilog="Example: lanenet simulate configs/drives/example.yaml seed=3 --out runs/three")
def simulate(
    config: _Config,
    out: Annotated[Path, typer.Option(help="Folder for the drive.", show_default=False)],
    overrides: _Overrides = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that draw the frames.")] = 1,
    detector: Annotated[
        str | None, typer.Option(help="Who steers instead of the scripted driver.", show_default=False)
    ] = None,
    model: onboard_cli.ModelOption = None,
) -> None:
    """Make a synthetic drive with ground truth, by a scripted driver or in closed loop by a detector."""
    from datagen.world.simulate import SimulationSettings, simulate_drive

    settings = load_settings(SimulationSettings, config, overrides)
    if model is not None and detector is None:
        raise ConfigError("--model: is the network's, expected --detector network as well")
    width_cm = settings.track.lane_width_cm
    pilot = None if detector is None else judge_cli.pilot_builder(detector, model, width_cm)
    with console.progress_bar("simulate") as progress:
        drive = simulate_drive(settings, out, progress, workers=workers, pilot=pilot)
    console.wrote(drive)
    console.next_command("map", drive, "--lane-width", f"{width_cm:g}", "--out", "MAP")


@app.command("map", epilog="Example: lanenet map data/tub --lane-width 40 --out runs/tub")
def map_(
    drive: Annotated[Path, typer.Argument(metavar="DRIVE", help="Drive, tub or video.", show_default=False)],
    lane_width: Annotated[
        float,
        typer.Option(min=1.0, help="Between the middles of the lane's two lines, cm.", show_default=False),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the map.", show_default=False)],
    camera: _CameraOption = None,
    config: Annotated[Path | None, typer.Option(help="YAML with the mapping's settings.")] = None,
    refine_camera: Annotated[
        bool, typer.Option("--refine-camera", help="Adjust a known camera to this drive.")
    ] = False,
    wheelbase: Annotated[float | None, typer.Option(min=0.1, help="Distance of the car's axles, cm.")] = None,
) -> None:
    """Find the poses of a drive and one map of its lane lines; without a camera it is calibrated too."""
    from datagen.pipeline import MapSettings, map_drive

    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    with console.progress_bar("map") as progress:
        report = map_drive(drive, lane_width, camera, settings, out, progress, refine_camera, wheelbase)
    console.show_lines(report.lines)
    console.wrote(out, out / "report.html")
    if report.figures["verdict"]["grade"] == "reject":
        raise LanenetError(f"{out}: the map was rejected; it is kept to be looked at, and gives no labels")
    console.next_command("label", out, "--out", out.with_suffix(".parquet"))


@app.command(epilog="Example: lanenet label runs/tub --out runs/tub.parquet")
def label(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="Folder of a map.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Label set to write (.parquet).", show_default=False)],
    force: Annotated[bool, typer.Option("--force", help="Label a rejected map, too.")] = False,
    colour_weight: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=1.0, help="What colours count beside brightness in the frames' edges; default 0.75."
        ),
    ] = None,
) -> None:
    """Project a map's lane lines into each frame: six labels per frame, and a report of their quality."""
    from datagen.pipeline import label_map
    from lanenet.perception.edges.road import COLOUR_WEIGHT

    check_ending(out, ".parquet")
    check_not_source(map_folder, out, out.with_suffix(".json"), out.with_suffix(".png"))
    with console.progress_bar("label") as progress:
        weight = COLOUR_WEIGHT if colour_weight is None else colour_weight
        report = label_map(map_folder, out, progress, force=force, colour_weight=weight)
    console.show_lines(report.lines)
    console.wrote(out)
    console.next_command("val", "MODEL", out)
