"""``lanenet judge``: detectors drive synthetic roads in closed loop; and who drives in a simulation."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import AnyCameraOption, lock_outputs
from lanenet.config import apply_overrides, check_settings, read_yaml
from lanenet.errors import ConfigError
from lanenet.perception.estimate import DetectorInputs
from lanenet.perception.network.model_file import find_model
from lanenet.perception.registry import (
    KINDS,
    build_detector,
    compared_names,
    detector_names,
    kind_of,
    listed,
    usual_names,
)

if TYPE_CHECKING:
    from datagen.judge.run import Entrant, RunResult
    from datagen.judge.settings import JudgeSettings, Road
    from lanenet.geometry.camera import Camera
    from lanenet.perception.estimate import Detector

app = typer.Typer()

#: Drives as the network unless ``--model`` names another.
SHIPPED_MODEL = Path("checkpoints/small")
_DETECTORS = ",".join(("truth", *usual_names()))
_WITH_SETTINGS = listed(detector_names(lambda kind: kind.settings is not None and not kind.needs_model))
_BESIDE = 5  # detectors in one table on the screen: a terminal is narrow


@app.command(
    epilog="Example: lanenet judge --detectors truth,network --model checkpoints/small --out runs/judge"
)
def judge(
    detectors: Annotated[
        str | None,
        typer.Option(
            help=f"Entrants, separated by commas; {_WITH_SETTINGS} also as NAME=SETTINGS.yaml, "
            "the network as network=MODEL; truth is the scripted driver, true-points the steering law on the "
            f"true lane. Default: {_DETECTORS}."
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(help=f"Model (.onnx) or checkpoint folder of the network; default {SHIPPED_MODEL}."),
    ] = None,
    tracks: Annotated[
        str | None,
        typer.Option(
            help="random (loops), open, varied, presets or track files (.yaml), separated by commas; default "
            "random."
        ),
    ] = None,
    count: Annotated[int | None, typer.Option(min=1, help="Roads of each kind; default 20.")] = None,
    laps: Annotated[int | None, typer.Option(min=1, help="Laps of each run; default 2.")] = None,
    speed: Annotated[float | None, typer.Option(min=1.0, help="Speed, cm/s; default 60.")] = None,
    across: Annotated[
        float | None,
        typer.Option(
            help="Degrees by which each car starts turned, to the left and right in turns; default 0."
        ),
    ] = None,
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
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of roads, looks and cars; default 0.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[Path, typer.Option(help="Folder for runs, tables and pictures.")] = Path("runs/judge"),
    any_camera: AnyCameraOption = False,
    config: Annotated[
        Path | None, typer.Option(help="YAML with the contest's settings; options replace its values.")
    ] = None,
) -> None:
    """Let detectors drive synthetic roads in closed loop and show how they do; finished runs are kept."""
    from datagen.judge.contest import judge as run_contest
    from datagen.judge.page import write_page
    from datagen.judge.report import table_title, tables, write_report
    from datagen.judge.settings import JudgeSettings, contest_roads

    lock_outputs(out)
    given: dict[str, Any] = {
        "tracks": None if tracks is None else [name.strip() for name in tracks.split(",")],
        "count": count,
        "laps": laps,
        "speed_cm_s": speed,
        "start_across_deg": across,
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
            detectors = ",".join(("truth", *compared_names(lambda kind: not kind.needs_model)))
            console.show_problems([f"{SHIPPED_MODEL} is not there: without the network; --model names one"])
    names = [text.strip() for text in detectors.split(",")]
    entrants = [named_entrant(name, model, "--detectors", any_camera) for name in names]
    # The narrowest and the widest road of each kind: varied ones have a hundred widths.
    by_width = sorted(contest_roads(settings), key=lambda road: road.simulation.track.lane_width_cm)
    ends = [*{road.kind: road for road in reversed(by_width)}.values()]
    ends += {road.kind: road for road in by_width}.values()
    for road in ends:
        _try_out(road, entrants)
    warn_of_widths(entrants, [road.simulation.track.lane_width_cm for road in ends])
    with console.progress_bar("judge") as progress:
        results = run_contest(settings, entrants, out, workers, progress)
    for kind, (measures, *table) in tables(results).items():
        # Transposed, a few detectors at a time: there are more measures than detectors.
        for first in range(0, len(table), _BESIDE):
            headers, *rows = zip(measures, *table[first : first + _BESIDE], strict=True)
            console.show_table(table_title(settings, kind), headers, rows)
    paths = [write_page(out, settings, entrants, results), *write_report(out, settings, results)]
    console.wrote(*paths, _draw_pictures(settings, entrants, results, out))
    again = {
        "--detectors": detectors,
        "--model": model,
        "--tracks": tracks,
        "--count": count,
        "--laps": laps,
        "--speed": speed,
        "--across": across,
        "--law": "proportional" if settings.pilot.law == "own" else "own",
        "--no-put-back": put_back is False,
        "--put-back": put_back is True,
        "--seed": seed,
        "--any-camera": any_camera,
        "--config": config,
        "--out": "DIR",
    }
    console.next_command("judge", *console.given(again))


def _try_out(road: Road, entrants: list[Entrant]) -> None:
    """Build each detector once, so that one that cannot be built is refused before the first run."""
    simulation = road.simulation
    camera = simulation.camera.build(simulation.car.wheelbase_cm)
    for entrant in entrants:
        if entrant.build is not None:
            entrant.build(camera, simulation.track.lane_width_cm, simulation.track.line_width_cm)


def _draw_pictures(
    settings: JudgeSettings, entrants: list[Entrant], results: list[RunResult], out: Path
) -> Path:
    from datagen.judge.contest import contest_jobs, read_trajectory
    from datagen.judge.report import draw_top_view
    from datagen.world.world import draw_track
    from lanenet.data.files import write_bytes
    from lanenet.data.tables import png_bytes

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
        picture = draw_top_view(draw_track(jobs[first].road.simulation), runs, title)
        write_bytes(folder / f"{road}.png", png_bytes(picture))
    return folder


@dataclass(frozen=True)
class NamedDetector:
    """Builds a detector by its name, in any process.

    Attributes:
        name: One of :mod:`lanenet.perception.registry`.
        model: ONNX file, for the network.
        config: YAML with its settings.
        any_camera: Accept a model that was trained with another camera.
    """

    name: str
    model: Path | None = None
    config: Path | None = None
    any_camera: bool = False

    def __call__(self, camera: Camera, lane_width_cm: float, marking_cm: float | None) -> Detector:
        """Build it for a camera and a lane."""
        inputs = DetectorInputs(
            camera=camera,
            model=self.model,
            any_camera=self.any_camera,
            lane_width_cm=lane_width_cm,
            marking_cm=marking_cm,
            config=self.config,
        )
        return build_detector(self.name, inputs)

    @property
    def identity(self) -> str:
        """Hash of the files it depends on."""
        files = [path for path in (self.model, self.config) if path is not None]
        return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def named_entrant(text: str, model: Path | None, option: str, any_camera: bool) -> Entrant:
    """Return the entrant that a text names.

    Args:
        text: ``truth``, ``true-points``, or a detector's name; ``NAME=SETTINGS.yaml`` if it takes settings,
            ``network=MODEL``.
        model: Model or checkpoint folder of a network that names none; None takes the shipped one, and says
            so.
        option: The option that holds the text, for error messages.
        any_camera: Accept a model that was trained with another camera.

    Raises:
        LanenetError: If there is no such detector or file.
    """
    from datagen.judge.run import TRUE_POINTS, TRUTH, Entrant

    name, equals, file = text.partition("=")
    if name in (TRUTH, TRUE_POINTS) and not equals:
        return Entrant(name)
    known = compared_names()
    if name not in known or (equals and name not in KINDS):
        raise ConfigError(f"{option} {text!r}: expected {', '.join((TRUTH, TRUE_POINTS, *known))}")
    shown = f"{name}-{Path(file).stem}" if equals else name
    if kind_of(name).needs_model:
        detector = NamedDetector(name, _network_model(Path(file) if equals else model), None, any_camera)
        return Entrant(shown, detector, detector.identity)
    if equals and not Path(file).is_file():
        raise ConfigError(f"{option} {text!r}: {file}: no such file")
    detector = NamedDetector(name, None, Path(file).resolve() if equals else None, any_camera)
    return Entrant(shown, detector, detector.identity)


def _network_model(given: Path | None) -> Path:
    """Return the network's file; the shipped one if none is given."""
    if given is None:
        if not SHIPPED_MODEL.exists():
            raise ConfigError(f"detector network: expected a model (--model), {SHIPPED_MODEL} is not there")
        console.say(f"network: {SHIPPED_MODEL}; --model names another one")
    return find_model(SHIPPED_MODEL if given is None else given).resolve()


def warn_of_widths(entrants: list[Entrant], lane_widths_cm: list[float]) -> None:
    """Print a warning for each network that was not trained on these lane widths."""
    from lanenet.perception.network.model_file import read_model_meta

    for entrant in entrants:
        if isinstance(entrant.build, NamedDetector) and entrant.build.model is not None:
            model = entrant.build.model
            console.show_problems(read_model_meta(model).untrained_widths(lane_widths_cm, str(model)))
