"""The verbs that the base installation can run: detect, bench, analyse, doctor."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lanenet.cli import console
from lanenet.cli.outputs import check_ending, check_not_source
from lanenet.errors import CalibrationError, ConfigError, LanenetError

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import UInt8

    from lanenet.data.drives.sources import Source
    from lanenet.onboard.drive_settings import DriveSettings

app = typer.Typer()

_CameraOption = Annotated[Path | None, typer.Option("--camera", help="Camera YAML.", show_default=False)]
MarkingOption = Annotated[
    float | None, typer.Option("--marking", help="Thickness of the tape for the lane filter, cm.")
]
ModelOption = Annotated[
    Path | None,
    typer.Option("--model", help="Model (.onnx) or checkpoint folder of the network.", show_default=False),
]


class DetectorName(StrEnum):
    """Detectors of ``lanenet detect``."""

    NETWORK = "network"
    LANE_FILTER = "lane-filter"
    HOUGH = "hough"
    PAINTER = "painter"


@app.command(
    epilog="Example: lanenet detect tub --detector lane-filter --camera runs/camera.yaml --out runs/l.csv"
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
    model: ModelOption = None,
    camera: _CameraOption = None,
    video: Annotated[Path | None, typer.Option(help="Annotated video to write (.mp4).")] = None,
    lane_width: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            help="Lane width for lane-filter and network, cm; default: the settings file's or the drive's.",
        ),
    ] = None,
    marking: MarkingOption = None,
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
        Path | None,
        typer.Option(
            help="YAML with the settings of lane-filter (filter, perception), hough or painter.",
            show_default=False,
        ),
    ] = None,
    mask: Annotated[
        str | None,
        typer.Option(
            help="Leave out the car itself, for lane-filter and network: 'auto' finds what never moves, a "
            "PNG shows it (black elsewhere).",
            metavar="auto|FILE.png",
        ),
    ] = None,
) -> None:
    """Run a detector over a photo, a video, a drive or a tub; hough and painter need no camera."""
    from lanenet.data.camera_file import read_camera
    from lanenet.data.detections import check_table_path
    from lanenet.data.drives.sources import open_source
    from lanenet.evaluation.detect import run_detector
    from lanenet.perception.registry import WITHOUT_CAMERA, build_detector

    check_ending(out, ".parquet", ".csv")
    check_not_source(source, out, video)
    check_table_path(out)
    whole = open_source(source)
    opened = whole if frames is None else whole.numbered(*_frame_range(frames))
    used_camera = read_camera(camera) if camera is not None else opened.camera
    if used_camera is None and detector.value not in WITHOUT_CAMERA:
        raise CalibrationError(
            f"{source}: comes without a camera, expected --camera camera.yaml; "
            "the folder of its map has one (lanenet map)"
        )
    chosen = build_detector(
        detector.value,
        used_camera,
        model=model,
        lane_width_cm=lane_width,
        drive_lane_width_cm=opened.lane_width_cm,
        marking_cm=marking,
        any_camera=any_camera,
        config=config,
        mask=_mask_of(mask, whole, detector),
    )
    console.show_problems(getattr(chosen, "problems", ()))
    with console.progress_bar(f"detect ({detector.value})") as progress:
        report = run_detector(
            opened, chosen, used_camera, out, video, progress, skip_unreadable=skip_unreadable
        )
    console.show_problems(report.problems)
    typer.echo(
        f"{report.frames} frames, {report.complete} with all six points, {report.steered} with a steering "
        f"target; {report.median_ms:.2f} ms per frame (median), {report.p99_ms:.2f} ms (p99)"
    )
    if hint := getattr(chosen, "hint", ""):
        typer.echo(f"hint: {hint}")
    console.wrote(report.out, report.video)
    if report.video is None:
        again = {
            "--detector": detector.value,
            "--model": model,
            "--camera": camera,
            "--lane-width": lane_width,
            "--marking": marking,
            "--any-camera": any_camera,
            "--frames": frames,
            "--skip-unreadable": skip_unreadable,
            "--config": config,
            "--mask": mask,
            "--out": out,
            "--video": out.with_suffix(".mp4"),
        }
        console.next_command("detect", source, *console.given(again))
    else:
        console.next_command("bench", *console.given({"--model": model, "--camera": camera}))


@app.command(epilog="Example: lanenet bench --model checkpoints/small --out runs/bench.json")
def bench(
    model: ModelOption = None,
    also: Annotated[
        list[Path] | None, typer.Option(help="More models, for their time from frame to steering.")
    ] = None,
    camera: _CameraOption = None,
    rounds: Annotated[int, typer.Option(min=10, help="Frames to time.")] = 300,
    threads: Annotated[int, typer.Option(min=1, help="Threads of OpenCV and onnxruntime.")] = 1,
    out: Annotated[Path | None, typer.Option(help="JSON file to write.")] = None,
) -> None:
    """Time the onboard stages on this machine: median and 99th percentile."""
    from lanenet.data.camera_file import read_camera
    from lanenet.data.files import write_json
    from lanenet.onboard.bench import example_camera, time_paths, time_stages

    used_camera = example_camera() if camera is None else read_camera(camera)
    models = [path for path in (model, *(also or [])) if path is not None]
    with console.progress_bar("bench") as progress:
        report = time_stages(used_camera, model, rounds, threads, progress)
    with console.progress_bar("frame to steering") as progress:
        report["paths"] = time_paths(used_camera, models, rounds, threads, progress)
    rows = [
        [stage, *(f"{v[key]:.3f}" for key in ("median_ms", "p99_ms")), f"{v['ratio_to_canny']:.2f}"]
        for stage, v in report["stages"].items()
    ]
    machine = report["machine"]
    title = f"{machine['processor']}, {threads} thread(s), {report['image']} px, {rounds} frames"
    console.show_table(title, ("stage", "median ms", "p99 ms", "x canny"), rows)
    keys = ("median_ms", "p99_ms", "cpu_median_ms", "cpu_p99_ms")
    rows = [
        [f"{size} {path}", *(f"{values[key]:.3f}" for key in keys)]
        for size, paths in report["paths"].items()
        for path, values in paths.items()
    ]
    columns = ("path", "median ms", "p99 ms", "of it CPU, median", "of it CPU, p99")
    console.show_table("frame to steering", columns, rows)
    if out is not None:
        write_json(out, report)
        console.wrote(out)
    console.next_command("doctor")


@app.command(epilog="Example: lanenet analyse runs/camera.yaml --out runs/density.png")
def analyse(
    camera: Annotated[Path, typer.Argument(metavar="CAMERA", help="Camera YAML.", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="Picture of pixels per ground cell (.png).")] = None,
) -> None:
    """Tell how exactly a camera sees the road: cm per pixel and the worst steering error."""
    from lanenet.data.camera_file import read_camera
    from lanenet.data.files import atomic_file
    from lanenet.data.parquet import png_bytes
    from lanenet.perception.error_analysis import analyse_errors, draw_analysis, figures

    if out is not None:
        check_ending(out, ".png")
    analysis = analyse_errors(read_camera(camera))
    console.show_table(str(camera), ("", "found", "paper"), figures(analysis))
    ahead_cm = analysis.settings.lookahead_cm
    typer.echo(f"L and R: the middles of the lane's two lines, {ahead_cm:g} cm ahead; -: not seen")
    if out is not None:
        with atomic_file(out) as temporary:
            temporary.write_bytes(png_bytes(draw_analysis(analysis)))
        console.wrote(out)
    console.next_command("doctor", "--camera", camera)


@app.command(epilog="Example: lanenet doctor --config configs/car/picamera_pca9685.yaml")
def doctor(
    camera: _CameraOption = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML of a car, whose devices are tried.", show_default=False)
    ] = None,
    wheels_off_ground: Annotated[
        bool,
        typer.Option(
            "--wheels-off-ground",
            help="Turn wheels and motor, ask what they did, and write it into --config.",
        ),
    ] = False,
) -> None:
    """Check the installation, a camera file if one is given, and a whole car with --config."""
    from lanenet.onboard.doctor.installation import run_checks
    from lanenet.onboard.drive_settings import load_drive_settings

    settings = None if config is None else load_drive_settings(config)
    if wheels_off_ground:
        if config is None or settings is None:
            raise ConfigError("--wheels-off-ground: expected the car's file as well (--config car.yaml)")
        _try_wheels(config, settings)
        return
    checks = run_checks(camera)
    if settings is not None:
        from lanenet.onboard.doctor.car import check_car

        checks += check_car(settings)
    for check in checks:
        typer.echo(f"{check.state:8s}{check.name}: {check.text}")
    problems = sum(check.state == "problem" for check in checks)
    if problems:
        raise LanenetError(f"{problems} problem(s) found, see above")
    if settings is None or config is None:
        # A car has no more than the base installation.
        trains = any(check.name == "extra train" and check.state == "ok" for check in checks)
        words = ("train", "configs/small.yaml") if trains else ("doctor", "--config", "CAR.yaml")
        console.next_command(*words)
    elif settings.actuator is None:
        console.next_command("drive", config, "--dry-run")
    else:
        console.next_command("doctor", "--config", config, "--wheels-off-ground")


def _try_wheels(config: Path, settings: DriveSettings) -> None:
    """Ask about the wheels on the terminal, and write what was found into the car's file."""
    from lanenet.data.files import write_text
    from lanenet.onboard.doctor.wheel_trial import pulses_of, try_wheels
    from lanenet.onboard.doctor.yaml_edit import set_values
    from lanenet.onboard.drive import build_sink

    def ask(question: str, letters: str) -> str:
        while True:
            answer = typer.prompt(f"{question} [{'/'.join(letters)}]", type=str).strip().lower()[:1]
            if answer and answer in letters:
                return str(answer)

    pulses_of(settings)
    result = try_wheels(settings, build_sink(settings), ask)
    console.show_lines(result.lines)
    if result.changes:
        text = config.read_text(encoding="utf-8")
        write_text(config, set_values(text, result.changes, str(config)))
        console.wrote(config)
    console.next_command("drive", config, "--steering-only")


def _mask_of(mask: str | None, source: Source, detector: DetectorName) -> UInt8[np.ndarray, "h w"] | None:
    """Find or read the mask that was asked for, and say what became of it."""
    from lanenet.onboard.masks import find_mask, read_mask
    from lanenet.perception.registry import refuse_mask

    if mask is None:
        return None
    refuse_mask(detector.value)
    if mask != "auto":
        return read_mask(Path(mask))
    found, told = find_mask(source)
    typer.echo(told)
    return found


def _frame_range(text: str) -> tuple[int, int]:
    first, colon, last = text.partition(":")
    if not (colon and first.strip().isdecimal() and last.strip().isdecimal()):
        raise ConfigError(f"--frames {text!r}: expected FIRST:LAST, as in 700:999")
    if int(last) < int(first):
        raise ConfigError(
            f"--frames {text!r}: found a last frame before the first, expected FIRST:LAST, as in 700:999"
        )
    return int(first), int(last)
