"""``lanenet judge``: detectors drive synthetic roads in closed loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lanenet.cli.research.entrants import SHIPPED_MODEL, named_entrant, warn_of_widths
from lanenet.cli.shared import console
from lanenet.cli.shared.options import AnyCameraOption
from lanenet.config import apply_overrides, check_settings, read_yaml
from lanenet.perception.registry import KINDS, detector_names, listed

if TYPE_CHECKING:
    from datagen.judge.run import Entrant, RunResult
    from datagen.judge.settings import JudgeSettings

app = typer.Typer()

_DETECTORS = ",".join(("truth", *KINDS))
_WITH_SETTINGS = listed(detector_names(lambda kind: kind.settings is not None))
_BESIDE = 5  # detectors in one table on the screen: a terminal is narrow


@app.command(
    epilog="Example: lanenet judge --detectors truth,network --model checkpoints/small --out runs/judge"
)
def judge(
    detectors: Annotated[
        str | None,
        typer.Option(
            help=f"Entrants, separated by commas; {_WITH_SETTINGS} also as NAME=SETTINGS.yaml; truth is the "
            f"scripted driver, true-points the steering law on the true lane. Default: {_DETECTORS}.",
            show_default=False,
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            help=f"Model (.onnx) or checkpoint folder of the network; default {SHIPPED_MODEL}.",
            show_default=False,
        ),
    ] = None,
    tracks: Annotated[
        str | None,
        typer.Option(help="random (loops), open, presets or track files (.yaml), separated by commas."),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Roads of each kind; default 20.")] = None,
    laps: Annotated[int | None, typer.Option(min=1, help="Laps of each run; default 2.")] = None,
    speed: Annotated[float | None, typer.Option(min=1.0, help="Speed, cm/s; default 60.")] = None,
    law: Annotated[
        str | None,
        typer.Option(help="proportional (default), pure-pursuit, or own: the detector's own steering."),
    ] = None,
    put_back: Annotated[
        bool | None,
        typer.Option(
            "--put-back/--no-put-back", help="Put a car that left the road back (default), or end its run."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of roads, looks and cars.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[Path, typer.Option(help="Folder for runs, tables and pictures.")] = Path("runs/judge"),
    any_camera: AnyCameraOption = False,
    config: Annotated[
        Path | None, typer.Option(help="YAML with the contest's settings; options replace its values.")
    ] = None,
) -> None:
    """Let detectors drive synthetic roads in closed loop and show how they do; finished runs are kept."""
    from datagen.judge.contest import judge as run_contest
    from datagen.judge.report import table_title, tables, write_report
    from datagen.judge.settings import JudgeSettings

    given: dict[str, Any] = {
        "tracks": None if tracks is None else [name.strip() for name in tracks.split(",")],
        "count": count,
        "laps": laps,
        "speed_cm_s": speed,
        "put_back": put_back,
        "seed": seed,
    }
    data = {} if config is None else read_yaml(config)
    data |= {key: value for key, value in given.items() if value is not None}
    data = apply_overrides(data, [] if law is None else [f"pilot.law={law}"])
    settings = check_settings(JudgeSettings, data, "judge" if config is None else str(config))
    if detectors is None:
        detectors = _DETECTORS
        if model is None and not SHIPPED_MODEL.exists():
            detectors = ",".join(("truth", *detector_names(lambda kind: not kind.needs_model)))
            console.show_problems([f"{SHIPPED_MODEL} is not there: without the network; --model names one"])
    names = [text.strip() for text in detectors.split(",")]
    entrants = [named_entrant(name, model, "--detectors", any_camera) for name in names]
    _try_out(settings, entrants)
    warn_of_widths(entrants, _lane_widths_cm(settings))
    with console.progress_bar("judge") as progress:
        results = run_contest(settings, entrants, out, workers, progress)
    for kind, (measures, *table) in tables(results).items():
        # Transposed, a few detectors at a time: there are more measures than detectors.
        for first in range(0, len(table), _BESIDE):
            headers, *rows = zip(measures, *table[first : first + _BESIDE], strict=True)
            console.show_table(table_title(settings, kind), headers, rows)
    paths = write_report(out, settings, results)
    console.wrote(*paths, _draw_pictures(settings, entrants, results, out))
    again = {
        "--detectors": detectors,
        "--model": model,
        "--tracks": tracks,
        "--count": count,
        "--laps": laps,
        "--speed": speed,
        "--law": "proportional" if settings.pilot.law == "own" else "own",
        "--no-put-back": put_back is False,
        "--put-back": put_back is True,
        "--seed": seed,
        "--any-camera": any_camera,
        "--config": config,
        "--out": "DIR",
    }
    console.next_command("judge", *console.given(again))


def _lane_widths_cm(settings: JudgeSettings) -> list[float]:
    """Return the lane width of one road of each kind."""
    from datagen.judge.settings import road_simulation

    kinds = range(len(settings.tracks))
    return [road_simulation(settings, kind * settings.count).track.lane_width_cm for kind in kinds]


def _try_out(settings: JudgeSettings, entrants: list[Entrant]) -> None:
    """Build each detector once, so that one that cannot be built is refused before the first run."""
    simulation = settings.simulation
    camera = simulation.camera.build(simulation.car.wheelbase_cm)
    for entrant in entrants:
        if entrant.build is not None:
            entrant.build(camera, simulation.track.lane_width_cm, simulation.track.line_width_cm)


def _draw_pictures(
    settings: JudgeSettings, entrants: list[Entrant], results: list[RunResult], out: Path
) -> Path:
    from datagen.judge.contest import contest_jobs, read_trajectory
    from datagen.judge.pictures import draw_top_view
    from datagen.world.world import draw_track
    from lanenet.data.files import write_bytes
    from lanenet.data.parquet import png_bytes

    jobs = contest_jobs(settings, entrants, out)
    folder = out / "pictures"
    for first in range(0, len(jobs), len(entrants)):
        chosen = slice(first, first + len(entrants))
        runs = [
            (result, read_trajectory(job.path))
            for job, result in zip(jobs[chosen], results[chosen], strict=True)
        ]
        road = runs[0][0].road
        title = f"{road}, seed {runs[0][0].seed}, {settings.laps} laps, {settings.speed_cm_s:g} cm/s"
        picture = draw_top_view(draw_track(jobs[first].simulation), runs, title)
        write_bytes(folder / f"{road}.png", png_bytes(picture))
    return folder
