"""The command line: one verb per thing people do, each a thin shell over a Python function.

The only file that knows both ``datagen`` and ``lanenet.learn``. They are imported inside the commands, since
the car has neither torch nor numba.
"""

from __future__ import annotations

import functools
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import Field
from typer.core import TyperGroup

from lanenet import calibrate_cli, console
from lanenet.config import Settings, dump_settings, load_settings
from lanenet.errors import CalibrationError, ConfigError, LanenetError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from lanenet.data.label_set import LabelSet
    from lanenet.learn.evaluate import Predictor

_Config = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="YAML file with the settings.", show_default=False)
]
_Overrides = Annotated[
    list[str] | None, typer.Argument(metavar="KEY=VALUE", help="Settings that replace those of CONFIG.")
]
_CameraOption = Annotated[Path | None, typer.Option("--camera", help="Camera YAML.", show_default=False)]
_MarkingOption = Annotated[
    float | None, typer.Option("--marking", help="Thickness of the tape for the lane filter, cm.")
]

#: Packages of the extras, for the message when one is missing.
_EXTRA_OF = {
    **dict.fromkeys(("torch", "torchvision", "onnx", "onnxscript", "safetensors", "tensorboard"), "train"),
    **dict.fromkeys(("scipy", "numba", "pyarrow"), "data"),
    "matplotlib": "viz",
    **dict.fromkeys(("smbus2", "serial"), "car"),
}


class DetectorName(StrEnum):
    """Detectors of ``lanenet detect``."""

    NETWORK = "network"
    LANE_FILTER = "lane-filter"
    HOUGH = "hough"
    PAINTER = "painter"


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


def main() -> None:
    """Run the command line; the entry point of the package."""
    app()


@functools.cache
def run_settings_schema() -> type[Settings]:
    """Return the schema of ``lanenet train CONFIG``; built here because its parts need the workstation."""
    from datagen.datasets import DataSettings
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
    marking: _MarkingOption = None,
) -> None:
    """Make what CONFIG needs and is not there yet (drives, maps, labels), then train, evaluate and export."""
    from datagen.datasets import prepare
    from lanenet.learn.evaluate import network_predictor
    from lanenet.learn.publish import publish
    from lanenet.learn.run_state import hash_run
    from lanenet.learn.train import train as train_network

    settings: Any = load_settings(run_settings_schema(), config, overrides)
    checkpoint = settings.checkpoints_dir / settings.name
    with console.progress_bar("data") as progress:
        data = prepare(settings.data, settings.work_folder, progress)
    # A folder per settings and data: a stopped run finds its own state again, and no other.
    run_hash = hash_run(settings.learn, data.train, data.validation)
    run_folder = settings.work_folder / f"train-{run_hash}"
    with console.training_bar() as progress:
        train_network(settings.learn, data.train, data.validation, run_folder, progress)
    if not data.test:
        console.show_problems(["the data has no test part: the table is over the validation labels"])
    predictors = {"network": network_predictor(run_folder / "model.onnx")}
    markdown, results = _evaluate(data.test or data.validation, predictors, marking)
    files: dict[str, str | bytes] = {"run.yaml": dump_settings(settings), "results.md": markdown}
    if data.camera is not None:
        files["camera.yaml"] = data.camera.read_bytes()
    if data.example is not None:
        files[f"example{data.example.suffix}"] = data.example.read_bytes()
    publish(run_folder, checkpoint, settings.name, files, results)
    model = checkpoint / "model.onnx"
    console.wrote(checkpoint)
    words = ["detect", "SOURCE", "--detector", "network", "--model", model]
    words += ["--camera", checkpoint / "camera.yaml"] if data.camera is not None else []
    console.next_command(*words, "--out", "lanes.csv")


@app.command(epilog="Example: lanenet simulate configs/drive.yaml seed=3 --out drives/three")
def simulate(
    config: _Config,
    out: Annotated[Path, typer.Option(help="Folder for the drive.", show_default=False)],
    overrides: _Overrides = None,
) -> None:
    """Make a synthetic drive with ground truth."""
    from datagen.world.simulate import SimulationSettings, simulate_drive

    settings = load_settings(SimulationSettings, config, overrides)
    with console.progress_bar("simulate") as progress:
        drive = simulate_drive(settings, out, progress)
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
) -> None:
    """Find the poses of a drive and one map of its lane lines; without a camera it is calibrated too."""
    from datagen.pipeline import MapSettings, map_drive

    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    with console.progress_bar("map") as progress:
        report = map_drive(drive, lane_width, camera, settings, out, progress)
    console.show_lines(report.lines)
    console.wrote(out)
    console.next_command("label", out, "--out", out.with_suffix(".parquet"))


@app.command(epilog="Example: lanenet label maps/tub --out labels/tub.parquet")
def label(
    map_folder: Annotated[Path, typer.Argument(metavar="MAP", help="Folder of a map.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Label set to write (.parquet).", show_default=False)],
) -> None:
    """Project a map's lane lines into each frame: six labels per frame, and a report of their quality."""
    from datagen.pipeline import label_map

    _check_ending(out, ".parquet")
    with console.progress_bar("label") as progress:
        report = label_map(map_folder, out, progress)
    console.show_lines(report.lines)
    console.wrote(out)
    console.next_command("val", "MODEL", out)


@app.command(epilog="Example: lanenet val checkpoints/small labels/tub.parquet")
def val(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Model (.onnx) or checkpoint folder.", show_default=False)
    ],
    labels: Annotated[list[Path], typer.Argument(metavar="LABELS", help="Label sets.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option(help="Also write the table as .json and .md under this name.")
    ] = None,
    marking: _MarkingOption = None,
) -> None:
    """Show a model's errors in cm on label sets, beside the baselines on the same frames."""
    from lanenet.data.files import write_json, write_text
    from lanenet.learn.evaluate import network_predictor

    path = model / "model.onnx" if model.is_dir() else model
    markdown, results = _evaluate(labels, {"network": network_predictor(path)}, marking)
    if out is not None:
        write_json(Path(f"{out}.json"), results)
        write_text(Path(f"{out}.md"), markdown)
        console.wrote(Path(f"{out}.json"), Path(f"{out}.md"))
    console.next_command("detect", "SOURCE", "--detector", "network", "--model", path, "--out", "lanes.csv")


@app.command(epilog="Example: lanenet export checkpoints/small --out small.onnx")
def export(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="CHECKPOINT", help="Checkpoint folder.", show_default=False)
    ],
    out: Annotated[Path | None, typer.Option(help="Model to write; default CHECKPOINT/model.onnx.")] = None,
) -> None:
    """Write a checkpoint as one ONNX file, checked against PyTorch."""
    from lanenet.learn.export import export_checkpoint

    path = export_checkpoint(checkpoint, out)
    console.wrote(path)
    console.next_command("bench", "--model", path)


@app.command(
    epilog="Example: lanenet detect data/tub --detector lane-filter --camera camera.yaml --out l.csv"
)
def detect(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE", help="Photo, folder of photos, video, drive or tub.", show_default=False
        ),
    ],
    detector: Annotated[DetectorName, typer.Option(help="Which detector.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Table to write (.parquet or .csv).", show_default=False)],
    model: Annotated[Path | None, typer.Option(help="ONNX model, for --detector network.")] = None,
    camera: _CameraOption = None,
    video: Annotated[Path | None, typer.Option(help="Annotated video to write (.mp4).")] = None,
    lane_width: Annotated[
        float | None, typer.Option(min=1.0, help="Lane width for the lane filter, cm; default: the drive's.")
    ] = None,
    marking: _MarkingOption = None,
    any_camera: Annotated[
        bool, typer.Option("--any-camera", help="Use a model with another camera than it was trained with.")
    ] = False,
    frames: Annotated[
        str | None, typer.Option(help="Only these frame numbers, FIRST:LAST.", metavar="FIRST:LAST")
    ] = None,
    skip_unreadable: Annotated[
        bool, typer.Option("--skip-unreadable", help="Give unreadable frames an empty row and go on.")
    ] = False,
    config: Annotated[
        Path | None, typer.Option(help="YAML with the settings of hough or painter.", show_default=False)
    ] = None,
) -> None:
    """Run a detector over a photo, a video, a drive or a tub; hough and painter need no camera."""
    from lanenet.data.camera_file import read_camera
    from lanenet.onboard.detect import run_detector
    from lanenet.onboard.detectors import WITHOUT_CAMERA, build_detector
    from lanenet.onboard.sources import open_source

    _check_ending(out, ".parquet", ".csv")
    opened = open_source(source)
    if frames is not None:
        opened = opened.numbered(*_frame_range(frames))
    used_camera = read_camera(camera) if camera is not None else opened.camera
    if used_camera is None and detector.value not in WITHOUT_CAMERA:
        raise CalibrationError(f"{source}: comes without a camera, expected --camera camera.yaml")
    chosen = build_detector(
        detector.value,
        used_camera,
        model=model,
        lane_width_cm=lane_width if lane_width is not None else opened.lane_width_cm,
        marking_cm=marking,
        any_camera=any_camera,
        config=config,
    )
    with console.progress_bar(f"detect ({detector.value})") as progress:
        report = run_detector(
            opened, chosen, used_camera, out, video, progress, skip_unreadable=skip_unreadable
        )
    console.show_problems(report.problems)
    typer.echo(
        f"{report.frames} frames, {report.complete} with all six points, {report.steered} with a steering "
        f"target; {report.median_ms:.2f} ms per frame (median), {report.p99_ms:.2f} ms (p99)"
    )
    console.wrote(report.out, report.video)
    if report.video is None:
        options = {"--model": model, "--camera": camera, "--lane-width": lane_width, "--marking": marking}
        options["--config"] = config
        given = [str(word) for pair in options.items() if pair[1] is not None for word in pair]
        given += ["--any-camera"] if any_camera else []
        again = ("detect", source, "--detector", detector.value, *given, "--out", out)
        console.next_command(*again, "--video", out.with_suffix(".mp4"))
    else:
        console.next_command("bench")


@app.command(epilog="Example: lanenet bench --model checkpoints/small/model.onnx --out bench.json")
def bench(
    model: Annotated[Path | None, typer.Option(help="ONNX model to time as well.")] = None,
    camera: _CameraOption = None,
    rounds: Annotated[int, typer.Option(min=10, help="Frames to time.")] = 300,
    threads: Annotated[int, typer.Option(min=1, help="Threads of OpenCV and onnxruntime.")] = 1,
    out: Annotated[Path | None, typer.Option(help="JSON file to write.")] = None,
) -> None:
    """Time the onboard stages on this machine: median and 99th percentile."""
    from lanenet.data.camera_file import read_camera
    from lanenet.data.files import write_json
    from lanenet.onboard.bench import example_camera, time_stages

    used_camera = example_camera() if camera is None else read_camera(camera)
    with console.progress_bar("bench") as progress:
        report = time_stages(used_camera, model, rounds, threads, progress)
    rows = [
        [stage, *(f"{v[key]:.3f}" for key in ("median_ms", "p99_ms")), f"{v['ratio_to_canny']:.2f}"]
        for stage, v in report["stages"].items()
    ]
    machine = report["machine"]
    title = f"{machine['processor']}, {threads} thread(s), {report['image']} px, {rounds} frames"
    console.show_table(title, ("stage", "median ms", "p99 ms", "x canny"), rows)
    if out is not None:
        write_json(out, report)
        console.wrote(out)
    console.next_command("doctor")


@app.command(epilog="Example: lanenet analyse camera.yaml --out density.png")
def analyse(
    camera: Annotated[Path, typer.Argument(metavar="CAMERA", help="Camera YAML.", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="Picture of pixels per ground cell (.png).")] = None,
) -> None:
    """Tell how exactly a camera sees the road: cm per pixel and the worst steering error."""
    from lanenet.data.camera_file import read_camera
    from lanenet.data.files import atomic_file
    from lanenet.data.png import png_bytes
    from lanenet.perception.analysis_picture import draw_analysis
    from lanenet.perception.error_analysis import analyse_errors, figures

    if out is not None:
        _check_ending(out, ".png")
    analysis = analyse_errors(read_camera(camera))
    console.show_table(str(camera), ("", "found", "paper"), figures(analysis))
    if out is not None:
        with atomic_file(out) as temporary:
            temporary.write_bytes(png_bytes(draw_analysis(analysis)))
        console.wrote(out)
    console.next_command("doctor", "--camera", camera)


@app.command(epilog="Example: lanenet doctor --camera camera.yaml")
def doctor(camera: _CameraOption = None) -> None:
    """Check the installation, and a camera file if one is given."""
    from lanenet.onboard.doctor import run_checks

    checks = run_checks(camera)
    for check in checks:
        typer.echo(f"{check.state:8s}{check.name}: {check.text}")
    problems = sum(check.state == "problem" for check in checks)
    if problems:
        raise LanenetError(f"{problems} problem(s) found, see above")
    console.next_command("train", "configs/small.yaml")


def _evaluate(
    labels: list[Path], predictors: dict[str, Predictor], marking_cm: float | None
) -> tuple[str, dict[str, Any]]:
    """Compare detectors with the lane filter and show the table; returned as Markdown and as data."""
    from rich.console import Console

    from lanenet.data.label_set import read_labels
    from lanenet.learn.evaluate import evaluate_detectors, format_table
    from lanenet.onboard.detectors import filter_settings, lane_filter_points_cm

    def lane_filter(labels: LabelSet) -> Float[np.ndarray, "n 6"]:
        width_cm = labels.meta.marking_cm if marking_cm is None else marking_cm
        return lane_filter_points_cm(labels, filter_settings(labels.meta.lane_width_cm, width_cm))

    beside = {**predictors, "lane filter": lane_filter}
    tables = evaluate_detectors([read_labels(path) for path in labels], beside)
    table, markdown = format_table(tables)
    Console().print(table)
    sets = [path.name for path in labels]
    return markdown, {"label_sets": sets, "detectors": {k: t.as_dict() for k, t in tables.items()}}


def _frame_range(text: str) -> tuple[int, int]:
    first, colon, last = text.partition(":")
    if not (colon and first.strip().isdigit() and last.strip().isdigit()):
        raise ConfigError(f"--frames {text!r}: expected FIRST:LAST, as in 700:999")
    return int(first), int(last)


def _check_ending(path: Path, *endings: str) -> None:
    """Refuse an output before the work starts, not after it."""
    if path.suffix.lower() not in endings:
        raise ConfigError(f"{path}: expected a name that ends in {' or '.join(endings)}")
