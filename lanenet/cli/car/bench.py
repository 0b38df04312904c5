"""``lanenet bench``: timings on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import CameraOption, ModelOption, lock_outputs

app = typer.Typer()


@app.command(epilog="Example: lanenet bench --model checkpoints/small --out runs/bench.json")
def bench(
    model: ModelOption = None,
    also: Annotated[
        list[Path] | None, typer.Option(help="More models to time from frame to steering.")
    ] = None,
    camera: CameraOption = None,
    rounds: Annotated[int, typer.Option(min=10, help="Frames to time.")] = 300,
    threads: Annotated[int, typer.Option(min=1, help="Threads of OpenCV and onnxruntime.")] = 1,
    out: Annotated[Path | None, typer.Option(help="JSON file to write.")] = None,
) -> None:
    """Time the onboard stages on this machine: median and 99th percentile."""
    from lanenet.data.camera_file import read_camera
    from lanenet.data.files import write_json
    from lanenet.onboard.bench import example_camera, time_paths, time_stages

    lock_outputs(out)
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
        [f"{size} {path}", *(f"{values[key]:.3f}" for key in keys), f"{values['ratio_to_canny']:.2f}"]
        for size, paths in report["paths"].items()
        for path, values in paths.items()
    ]
    columns = ("path", "median ms", "p99 ms", "CPU median", "CPU p99", "x canny")
    console.show_table("frame to steering", columns, rows)
    if out is not None:
        write_json(out, report)
        console.wrote(out)
    console.next_command("doctor")
