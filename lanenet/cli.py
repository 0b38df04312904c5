"""The command line: one verb per thing people do, each a thin shell over a Python function.

Only this file and :mod:`lanenet.evaluation` know both ``datagen`` and ``lanenet.learn``. They are imported
inside the commands, since the car has neither torch nor numba.
"""

from __future__ import annotations

import functools
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import Field
from typer.core import TyperGroup

from lanenet import (
    calibrate_cli,
    console,
    drive_cli,
    export_cli,
    judge_cli,
    localise_cli,
    onboard_cli,
    reality_cli,
    val_cli,
    world_cli,
)
from lanenet.config import Settings, dump_settings, load_settings
from lanenet.errors import LanenetError
from lanenet.onboard_cli import MarkingOption
from lanenet.outputs import check_ending, check_not_source

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


@functools.cache
def run_settings_schema() -> type[Settings]:
    """Return the schema of ``lanenet train CONFIG``; built here because its parts need the workstation."""
    from datagen.dataset_settings import DataSettings
    from lanenet.learn.config import LearnSettings

    class RunSettings(Settings):
        """Everything that one training run needs.

        Attributes:
            name: Names the checkpoint.
            data: Where the label sets come from.
            learn: How the network is trained.
            work_dir: Drives, maps and label sets; None stands for ``runs/<name>``.
            checkpoints_dir: Parent of the checkpoint's folder.
        """

        name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
        data: DataSettings = Field(default_factory=DataSettings)
        learn: LearnSettings = Field(default_factory=LearnSettings)
        work_dir: Path | None = None
        checkpoints_dir: Path = Path("checkpoints")

        @property
        def work_folder(self) -> Path:
            """Folder of the drives, maps and label sets."""
            return Path("runs") / self.name if self.work_dir is None else self.work_dir

    return RunSettings


def __getattr__(name: str) -> Any:
    if name == "RunSettings":
        return run_settings_schema()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


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


@app.command(epilog="Example: lanenet train configs/small.yaml learn.epochs=5")
def train(
    config: _Config,
    overrides: _Overrides = None,
    marking: MarkingOption = None,
) -> None:
    """Make what CONFIG needs and is not there yet (drives, maps, labels), then train, evaluate and export."""
    from datagen.datasets import prepare
    from lanenet.data.label_set import read_labels
    from lanenet.evaluation import default_names, evaluate, open_tests
    from lanenet.learn.publish import publish
    from lanenet.learn.run_state import hash_run
    from lanenet.learn.train import train as train_network

    settings: Any = load_settings(run_settings_schema(), config, overrides)
    checkpoint = settings.checkpoints_dir / settings.name
    with console.progress_bar("data") as progress:
        data = prepare(settings.data, settings.work_folder, progress)
    if data.left_out:
        console.show_problems([f"{len(data.left_out)} synthetic drives are left out", *data.left_out[:5]])
    # A folder per settings and data: a stopped run finds its own state again, and no other.
    run_hash = hash_run(settings.learn, data.train, data.validation)
    run_folder = settings.work_folder / f"train-{run_hash}"
    with console.training_bar() as progress:
        train_network(settings.learn, data.train, data.validation, run_folder, progress)
    if not data.test:
        console.show_problems(["the data has no test part: the table is over the validation labels"])
    sources = open_tests(data.test or data.validation, data.test_frames or data.validation_frames)
    with console.progress_bar("test") as progress:
        evaluation = evaluate(
            sources,
            default_names(sources, with_model=True),
            run_folder / "model.onnx",
            training=[read_labels(path) for path in dict.fromkeys(data.train)],
            marking_cm=marking,
            # Which camera made which test drive is settled by the config.
            any_camera=True,
            progress=progress,
        )
    val_cli.show(evaluation.comparison)
    files: dict[str, str | bytes] = {"run.yaml": dump_settings(settings)}
    files |= {f"results{ending}": content for ending, content in evaluation.files.items()}
    if data.camera is not None:
        files["camera.yaml"] = data.camera.read_bytes()
    if data.example is not None:
        files[f"example{data.example.suffix}"] = data.example.read_bytes()
    publish(run_folder, checkpoint, settings.name, files, evaluation.comparison.as_dict())
    model = checkpoint / "model.onnx"
    console.wrote(checkpoint)
    words = ["detect", "SOURCE", "--detector", "network", "--model", model]
    words += ["--camera", checkpoint / "camera.yaml"] if data.camera is not None else []
    console.next_command(*words, "--out", "lanes.csv")


@app.command(epilog="Example: lanenet sweep configs/small.yaml learn.epochs=10 --minutes 60")
def sweep(
    config: _Config,
    overrides: _Overrides = None,
    minutes: Annotated[
        float, typer.Option(min=0.0, help="No longer than this; goes on when called again.")
    ] = 60.0,
    trials: Annotated[int, typer.Option(min=1, help="No more finished trials than this, in all.")] = 100,
) -> None:
    """Try windows, sizes, losses and learning rates on CONFIG's validation drives, and keep the table."""
    from datagen.datasets import prepare
    from lanenet.learn.sweep import sweep as sweep_networks

    settings: Any = load_settings(run_settings_schema(), config, overrides)
    with console.progress_bar("data") as progress:
        data = prepare(settings.data, settings.work_folder, progress)
    out = settings.work_folder / "sweep"
    with console.progress_bar("trials") as progress:
        table = sweep_networks(
            settings.learn, data.train, data.validation, out, minutes * 60.0, trials, progress
        )
    console.show_lines(table.splitlines()[:14])
    console.wrote(out / "sweep.md", out / "trials.csv")


@app.command(epilog="Example: lanenet simulate configs/drive.yaml seed=3 --out drives/three")
def simulate(
    config: _Config,
    out: Annotated[Path, typer.Option(help="Folder for the drive.", show_default=False)],
    overrides: _Overrides = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that draw the frames.")] = 1,
    detector: Annotated[
        str | None, typer.Option(help="Who steers instead of the scripted driver.", show_default=False)
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Model or checkpoint folder of the network.")] = None,
) -> None:
    """Make a synthetic drive with ground truth, by a scripted driver or in closed loop by a detector."""
    from datagen.world.simulate import SimulationSettings, simulate_drive

    settings = load_settings(SimulationSettings, config, overrides)
    pilot = None if detector is None else judge_cli.pilot_builder(detector, model)
    with console.progress_bar("simulate") as progress:
        drive = simulate_drive(settings, out, progress, workers=workers, pilot=pilot)
    console.wrote(drive)
    console.next_command("map", drive, "--lane-width", f"{settings.track.lane_width_cm:g}", "--out", "MAP")


@app.command("map", epilog="Example: lanenet map data/tub --lane-width 40 --out maps/tub")
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
) -> None:
    """Find the poses of a drive and one map of its lane lines; without a camera it is calibrated too."""
    from datagen.pipeline import MapSettings, map_drive

    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    with console.progress_bar("map") as progress:
        report = map_drive(drive, lane_width, camera, settings, out, progress, refine_camera)
    console.show_lines(report.lines)
    console.wrote(out, out / "report.html")
    if report.figures["verdict"]["grade"] == "reject":
        raise LanenetError(f"{out}: the map was rejected; it is kept to be looked at, and gives no labels")
    console.next_command("label", out, "--out", out.with_suffix(".parquet"))


@app.command(epilog="Example: lanenet label maps/tub --out labels/tub.parquet")
def label(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="Folder of a map.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Label set to write (.parquet).", show_default=False)],
    force: Annotated[bool, typer.Option("--force", help="Label a rejected map, too.")] = False,
) -> None:
    """Project a map's lane lines into each frame: six labels per frame, and a report of their quality."""
    from datagen.pipeline import label_map

    check_ending(out, ".parquet")
    check_not_source(map_folder, out, out.with_suffix(".json"), out.with_suffix(".png"))
    with console.progress_bar("label") as progress:
        report = label_map(map_folder, out, progress, force=force)
    console.show_lines(report.lines)
    console.wrote(out)
    console.next_command("val", "MODEL", out)
