"""``lanenet train``: from a config to a checkpoint with its tables and its model card.

Imports ``datagen`` and ``lanenet.learn`` inside the commands, since the car has neither torch nor numba.
"""

from __future__ import annotations

import functools
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import Field, field_validator

from lanenet.cli import val as val_cli
from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    CameraHeightOption,
    CameraOption,
    FramesOption,
    MarkingOption,
    TapeWidthOption,
    WheelbaseOption,
    frame_range,
    lane_cm,
    lock_outputs,
)
from lanenet.cli.shared.own_drive import (
    TRAIN_SHARE,
    Measured,
    check_name,
    check_paths,
    is_config,
    own_config,
    parts_of,
    untrained_widths,
)
from lanenet.cli.shared.stages import Stages, stopped_in
from lanenet.cli.shared.standing import next_on_car
from lanenet.config import Settings, check_settings, dump_settings, load_settings, to_yaml
from lanenet.data.files import write_text
from lanenet.errors import CheckpointError, ConfigError, MapFormatError, counted
from lanenet.outputs import make_folder
from lanenet.reading import read_json

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from datagen.datasets.build import PreparedData
    from datagen.datasets.jobs import Part, RecordedJob
    from lanenet.data.label_set import LabelSet
    from lanenet.evaluation.comparison import SharedErrors
    from lanenet.evaluation.errors import ErrorStats
    from lanenet.evaluation.robustness import RobustRow
    from lanenet.evaluation.sources import Opened

app = typer.Typer()


@functools.cache
def run_settings_schema() -> type[Settings]:
    """Return the schema of ``lanenet train CONFIG``; built here because its parts need the workstation."""
    from datagen.datasets.settings import DataSettings
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

        name: str
        data: DataSettings = Field(default_factory=DataSettings)
        learn: LearnSettings = Field(default_factory=LearnSettings)
        work_dir: Path | None = None
        checkpoints_dir: Path = Path("checkpoints")

        @field_validator("name")
        @classmethod
        def _check_name(cls, name: str) -> str:
            # That of a folder, on any system.
            if not re.fullmatch("[A-Za-z0-9][A-Za-z0-9._-]*", name):
                raise ValueError("expected letters, digits, '.', '_' and '-', a letter or digit first")
            return name

        @property
        def work_folder(self) -> Path:
            """Folder of the drives, maps and label sets."""
            return Path("runs") / self.name if self.work_dir is None else self.work_dir

    return RunSettings


@app.command(epilog="Example: lanenet train my_tub --lane-width 40 --name mycar")
def train(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE... [KEY=VALUE]...",
            help="Drives, tubs or videos, a folder of them, maps, or label sets; or one config (.yaml). "
            "KEY=VALUE replaces a setting of the config, given or made.",
        ),
    ],
    lane_width: Annotated[
        float | None,
        typer.Option(
            parser=lane_cm,
            metavar="CM",
            help="Between the middles of the lane's two lines, cm, for a drive that is to be mapped.",
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Of the network: it is written to checkpoints/NAME.")
    ] = None,
    camera: CameraOption = None,
    wheelbase: WheelbaseOption = None,
    camera_height: CameraHeightOption = None,
    tape_width: TapeWidthOption = None,
    frames: FramesOption = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a network of that name that was trained on other drives.")
    ] = False,
    show_all: Annotated[
        bool, typer.Option("--all", help="Print all tables, with the other detectors.")
    ] = False,
    marking: MarkingOption = None,
) -> None:
    """Train a network on your own drives: map and label them, learn, test on what was held out, export.

    The training starts from checkpoints/general and is written down as a config, runs/NAME/NAME.yaml, which
    does the same again. Given a config, the command makes all that the config needs. What is there already is
    used; a run that was stopped resumes.
    """
    from lanenet.learn import parallel

    if parallel.follows():
        parallel.follow()
        return
    numbers = None if frames is None else frame_range(frames)
    measured = Measured(lane_width, camera, wheelbase, camera_height, tape_width, numbers)
    paths, overrides = parts_of(sources)
    if paths and is_config(paths[0]):
        for option in [*measured.options, *(["--name"] if name is not None else [])]:
            raise ConfigError(f"{option}: is for drives, but {paths[0]} is a config, which has a key for it")
        words = [*map(str, paths[1:]), *overrides]
        settings: Any = load_settings(run_settings_schema(), paths[0], words)
        data = settings.data
        files = [] if data.library is None else [data.library.file, data.library.labelled]
        check_paths(paths[0], [*(drive.path for drive in data.drives), *files, settings.learn.start_from])
        train_run(settings, marking, force, show_all)
        return
    if not paths:
        raise ConfigError(
            f"{sources[0]}: expected a drive, a map, a label set or a config before the settings"
        )
    if name is None:
        raise ConfigError(f"expected a name for the network, as in --name {paths[0].resolve().stem}")
    train_run(own_settings(name, paths, measured, overrides, force), marking, force, show_all)


def own_settings(
    name: str, paths: Sequence[Path], measured: Measured, overrides: Sequence[str], force: bool
) -> Any:
    """Choose the settings of a training on one's own drives, and write them down as a config.

    The arguments are those of :func:`lanenet.cli.shared.own_drive.own_config`; ``force`` replaces a network
    or a config of other drives.

    Raises:
        LanenetError: As :func:`own_config` and :func:`check_taken`.
    """
    plain = own_config(name, paths, measured, overrides, Path("runs"))
    words = shlex.join(["lanenet", "train", *map(str, paths), *overrides])
    settings = check_settings(run_settings_schema(), plain, words)
    check_taken(settings, force)
    _write_config(plain, settings)
    return settings


def _write_config(plain: dict[str, Any], settings: Any) -> None:
    """Write down what was chosen, so that it can be read, changed and run again from any folder."""
    config = _config_of(settings)
    folders = {key: str(getattr(settings, key).resolve()) for key in ("work_folder", "checkpoints_dir")}
    plain = {**plain, "work_dir": folders["work_folder"], "checkpoints_dir": folders["checkpoints_dir"]}
    again = shlex.join(["lanenet", "train", str(config)])
    lock_outputs(settings.checkpoints_dir / settings.name)
    make_folder(settings.work_folder)
    write_text(config, f"# Made by lanenet train; this does the same again: {again}\n{to_yaml(plain)}")
    console.wrote(config)


def check_taken(settings: Any, force: bool) -> None:
    """Refuse to replace a network or a config of other drives without force.

    Raises:
        LanenetError: Names the other drives.
    """
    if not force:
        drives = [drive.path for drive in settings.data.drives]
        check_name(settings.checkpoints_dir / settings.name, _config_of(settings), drives)


def _config_of(settings: Any) -> Path:
    """Where the config that a run writes itself stands."""
    return Path(settings.work_folder / f"{settings.name}.yaml")


def train_run(
    settings: Any, marking: float | None = None, force: bool = False, show_all: bool = False
) -> Path:
    """Do what the command does with the settings of its config, see :func:`run_settings_schema`.

    Returns:
        The checkpoint's folder.
    """
    from datagen.datasets.from_library import with_library
    from lanenet.learn.checkpoint import check_start

    # The run's config lists the drives: the library may be another one tomorrow.
    data, tracks = with_library(settings.data)
    settings = settings.model_copy(update={"data": data})
    check_taken(settings, force)
    lock_outputs(settings.checkpoints_dir / settings.name)
    check_start(settings.learn, settings.data.window, settings.data.perceptions)
    make_folder(settings.work_folder)
    log = settings.work_folder / "train.log"
    stopped = stopped_in(log)
    with console.log_file(log):
        console.show_lines(tracks)
        console.show_problems(untrained_widths(settings))
        if stopped is not None:
            console.say(
                f"resumes: the last run of this name stopped in the stage {stopped}; what it finished with "
                "the same drives and settings is used"
            )
        return _Run(settings, marking, show_all).run()


class _Run:
    """The stages of a training.

    Attributes:
        settings: Of the run.
        checkpoint: Its folder.
        jobs: The recorded drives.
    """

    def __init__(self, settings: Any, marking: float | None, show_all: bool) -> None:
        from datagen.datasets.build import recorded_jobs

        self.settings, self._marking, self._show_all = settings, marking, show_all
        self.checkpoint = settings.checkpoints_dir / settings.name
        self.jobs = recorded_jobs(settings.data, settings.work_folder)
        self._stages = Stages(expected_s(settings, self.jobs))

    def run(self) -> Path:
        """Do all stages; returns the checkpoint's folder."""
        begin = self._stages.begin
        self._check_leaks()
        for job in self.jobs:
            job.check_long_enough()
        if self.jobs:
            with begin("map"):
                for job in self.jobs:
                    self._map(job)
        with begin("label"):
            data = self._label()
        with begin("train"):
            run_folder = self._train(data)
        with begin("test"):
            files, results, judged = self._test(data, run_folder)
        with begin("export"):
            self._export(data, run_folder, files, results)
        if self.jobs:
            with begin("video"):
                self._video(judged)
        self._stages.finish()
        self._say_next(data)
        return self.checkpoint

    def _check_leaks(self) -> None:
        """Refuse drives that would leak between the parts, before anything is made of them."""
        from datagen.datasets.build import check_leaks

        with console.progress_bar("leaks") as progress:
            unknown = check_leaks(self.settings.data, self.settings.work_folder, progress)
        console.show_problems(unknown)

    def _map(self, job: RecordedJob) -> None:
        """Map a drive unless there is a map, and say what the map is worth.

        Raises:
            TrackingLostError: If the map was rejected; names the cause, the remedy and the report.
        """
        from datagen.labels.label_map import refuse_rejected
        from datagen.quality.verdict import folded, verdict_lines
        from lanenet.data.label_set import read_label_index
        from lanenet.data.maps.folder import read_map, verdict_of

        if job.is_labels:
            job.make_map()
            path = job.recording.path
            console.show_lines([f"{path}: has labels already, which are used"])
            lacks = [f"{path}: holds no images, so that there will be no video of what the network sees"]
            meta = read_label_index(path).meta
            if meta.verdict == "reject":
                lacks.append(
                    f"{path}: the map of these labels was rejected: its lines may be wrong, and so may what "
                    "the network learns and the errors of its test, which is against the same map"
                )
            if meta.camera is None:
                lacks.append(
                    f"{path}: holds no camera (it was written by an earlier version): the checkpoint will "
                    "have no camera.yaml, and the test will be of the network alone, frame by frame, which "
                    "reads larger errors than on the car; lanenet label MAP makes a label set with its camera"
                )
            console.show_problems(lacks)
            return
        finished = job.is_mapped
        with console.progress_bar("map") as progress:
            job.make_map(progress)
        if not finished and (said := read_json(job.frames / "report.json", MapFormatError).get("rescaled")):
            console.show_lines([said])
        if finished:
            console.show_lines([f"{job.frames}: a finished map, which is used"])
        refuse_rejected(job.frames, read_map(job.frames))
        verdict = verdict_of(job.frames)
        # Of a map that is not good, the sentence counts what it leaves to the lines below it.
        reasons = () if verdict.grade == "good" else verdict.reasons
        first = f"verdict: {verdict.grade}: {verdict.sentence}"
        lines = (first, *verdict_lines(reasons, verdict.remarks))
        console.show_lines(folded(lines, job.frames / "report.html"))
        console.show_lines([f"report: {job.frames / 'report.html'}"])

    def _label(self) -> PreparedData:
        from datagen.datasets.build import prepare
        from datagen.datasets.splits import chosen_split
        from lanenet.data.label_set import read_labels
        from lanenet.samples.dataset import compile_kernels

        settings = self.settings
        with console.progress_bar("label" if self.jobs else "data") as progress:
            data = prepare(settings.data, settings.work_folder, progress, last=compile_kernels)
        if data.left_out:
            console.show_problems([f"{len(data.left_out)} synthetic drives are left out", *data.left_out[:5]])
        for job in self.jobs:
            parts: dict[str, LabelSet] = {
                p.role: read_labels(p.labels) for p in data.parts if p.frames == job.frames
            }
            how = chosen_split(read_labels(job.whole), job.recording)
            console.show_lines(split_lines(parts, how, job.recording.split))
        return data

    def _train(self, data: PreparedData) -> Path:
        """Train, or go on with it; returns the folder of the finished run."""
        from lanenet.learn.checkpoint import STATE_NAME, hash_run, read_finished, read_state
        from lanenet.learn.train import train as train_network

        # One folder per settings and data, so that a stopped run finds its own state.
        learn = self.settings.learn
        run_hash = hash_run(learn, data.train, data.validation, data.weights)
        folder: Path = self.settings.work_folder / f"train-{run_hash}"
        if read_finished(folder, run_hash) is not None:
            console.show_lines(["the network was trained before with these labels and settings: it is used"])
        elif (state := read_state(folder / STATE_NAME, run_hash)) is not None:
            console.show_lines([f"goes on after epoch {len(state.history)} of {learn.epochs}"])
        with console.training_bar() as progress:
            train_network(learn, data.train, data.validation, folder, progress, data.weights)
        return folder

    def _test(
        self, data: PreparedData, run_folder: Path
    ) -> tuple[dict[str, str | bytes], dict[str, object], list[Part]]:
        """Measure the network on what was held out; returns the checkpoint's files, figures and the parts."""
        from lanenet.data.files import json_text
        from lanenet.data.label_set import read_places
        from lanenet.evaluation.answers import Compared
        from lanenet.evaluation.card import CARD_NAME, model_card, of_rejected_maps
        from lanenet.evaluation.comparison import default_names, evaluate
        from lanenet.evaluation.model_page import model_page
        from lanenet.evaluation.report import report_files
        from lanenet.evaluation.robustness import as_dict
        from lanenet.evaluation.sources import open_tests
        from lanenet.learn.checkpoint import METRICS_NAME
        from lanenet.page import PAGE_NAME
        from lanenet.perception.network.model_file import MODEL_NAME, read_model_meta

        settings, model = self.settings, run_folder / MODEL_NAME
        start = self._start_model()
        judged = data.of("test")
        if not judged:
            console.show_problems(["the data has no test part: the tables use the validation labels"])
            judged = data.of("validation")
        sources = open_tests([part.labels for part in judged], [part.frames for part in judged])
        # Without their edges and images: there may be more of them than fit into memory.
        training = [read_places(path) for path in dict.fromkeys(data.train)]
        with console.progress_bar("test") as progress:
            comparison, seen = evaluate(
                sources,
                # The config decides which camera made which test drive.
                Compared(
                    default_names(sources, with_model=True),
                    {"network": model, **start},
                    self._marking,
                    any_camera=True,
                ),
                training,
                settings.data.processes,
                progress,
            )
        where = self._where(judged)
        val_cli.show(comparison, seen, where, ["network", *start], self._show_all)
        console.show_lines([gain_line(name, comparison.shared[name]) for name in start])
        robustness = _robustness(model, sources)
        tests = [source.labels for source in sources if source.labels is not None]
        card = model_card(
            settings.name,
            read_model_meta(model),
            read_json(run_folder / METRICS_NAME, CheckpointError),
            training,
            tests,
            comparison,
            robustness,
        )
        page = model_page(
            f"How good {settings.name} is", comparison, seen, where, of_rejected_maps([*training, *tests])
        )
        files: dict[str, str | bytes] = {
            "run.yaml": dump_settings(settings),
            CARD_NAME: card,
            PAGE_NAME: page,
        }
        files |= {f"results{ending}": content for ending, content in report_files(comparison, seen).items()}
        if robustness:
            files["robustness.json"] = json_text(as_dict(robustness))
        return files, comparison.as_dict(), judged

    def _start_model(self) -> dict[str, Path]:
        """Return the model that the training started from, by its name, if it has one."""
        from lanenet.perception.network.model_file import MODEL_NAME
        from lanenet.perception.registry import compared_names

        folder = self.settings.learn.start_from
        if folder is None or not (folder / MODEL_NAME).is_file():
            return {}
        name = folder.resolve().name
        return {f"{name} (start)" if name in compared_names() else name: folder / MODEL_NAME}

    def _where(self, judged: Sequence[Part]) -> str:
        """Say on what the network is measured."""
        from datagen.datasets.splits import chosen_split
        from lanenet.data.label_set import read_labels

        frames = {part.frames for part in judged}
        jobs = [job for job in self.jobs if job.frames in frames]
        if len(jobs) < len(judged) or any(part.role != "test" for part in judged):
            return "on the test drives" if judged[0].role == "test" else "on the validation drives"
        splits = {chosen_split(read_labels(job.whole), job.recording) for job in jobs}
        if splits == {"test"}:
            return f"on {counted(len(jobs), 'drive')} that it had not seen"
        each = "" if len(jobs) == 1 else f" of each of the {len(jobs)} drives"
        what = "the last lap" if splits == {"lap"} else "the later part"
        return f"on {what}{each}, which it had not seen,"

    def _export(
        self,
        data: PreparedData,
        run_folder: Path,
        files: dict[str, str | bytes],
        results: dict[str, object],
    ) -> None:
        from datagen.datasets.sheet import data_sheet
        from datagen.datasets.sheet_text import sheet_files
        from lanenet.learn.checkpoint import publish
        from lanenet.page import PAGE_NAME

        settings = self.settings
        sheet = data_sheet(settings.name, settings.data, data, settings.work_folder, self.jobs)
        files |= sheet_files(sheet)
        if data.camera is not None:
            files["camera.yaml"] = data.camera.read_bytes()
        if data.example is not None:
            files[f"example{data.example.suffix}"] = data.example.read_bytes()
        publish(run_folder, self.checkpoint, self.settings.name, files, results)
        console.wrote(self.checkpoint, self.checkpoint / PAGE_NAME)

    def _video(self, judged: Sequence[Part]) -> None:
        """Draw what the network sees on the held-out part of each recording that has frames."""
        from lanenet.data.camera_file import read_camera
        from lanenet.data.drives.sources import open_source
        from lanenet.data.label_set import read_labels
        from lanenet.evaluation.detect import run_detector
        from lanenet.evaluation.sources import Opened
        from lanenet.perception.estimate import DetectorInputs
        from lanenet.perception.network.detector import KIND
        from lanenet.perception.registry import build_detector

        for job in self.jobs:
            part = next((part for part in judged if part.frames == job.frames), None)
            if part is None or job.is_labels:
                why = "no frame of it was held out" if part is None else "a label set holds no images"
                console.show_lines([f"{job.title}: no video, since {why}"])
                continue
            numbers = read_labels(part.labels).frame
            camera = read_camera(job.frames / "camera.yaml")
            inputs = DetectorInputs(
                camera=camera,
                model=self.checkpoint,
                any_camera=True,
                lane_width_cm=job.recording.lane_width_cm,
            )
            source = open_source(Opened(job.frames).drive).numbered(int(numbers[0]), int(numbers[-1]))
            each = "" if len(self.jobs) == 1 else f"-{job.name}"
            out = self.settings.work_folder / f"test{each}.csv"
            with console.progress_bar("video") as progress:
                report = run_detector(
                    source,
                    build_detector(KIND.name, inputs),
                    camera,
                    out,
                    out.with_suffix(".mp4"),
                    progress,
                    skip_unreadable=True,
                )
            console.wrote(report.out, report.video)

    def _say_next(self, data: PreparedData) -> None:
        if self.jobs or data.example is None:
            next_on_car(self.checkpoint)
            return
        camera = self.checkpoint / "camera.yaml" if data.camera is not None else None
        source = self.checkpoint / f"example{data.example.suffix}"
        options = {"--model": self.checkpoint, "--camera": camera}
        console.next_command("detect", source, *console.given(options), "--out", "runs/lanes.csv")


#: Seconds that the stages take, measured on donkey_circuit with two cores of 2.4 GHz: for each frame to map
#: (with the search for the camera), to label, to test and to draw, and for each sample of the training.
_MAP_S, _LABEL_S, _TEST_S, _DRAW_S, _SAMPLE_S = 0.06, 0.003, 0.01, 0.01, 1.0 / 1300.0
#: Of each stage before its first frame: processes start, and numba compiles.
_START_S = 5.0
#: Share of the frames that is tested on.
_TEST_SHARE = 0.25


def expected_s(settings: Any, jobs: Sequence[RecordedJob]) -> dict[str, float]:
    """Return the stages of a run, each with the seconds that it may take; 0 for all with simulated drives.

    Raises:
        LanenetError: If a drive cannot be read.
    """
    synthetic, names = settings.data.synthetic, ["label", "train", "test", "export"]
    if not jobs:
        return dict.fromkeys(names, 0.0)
    if synthetic.train or synthetic.validation or synthetic.test:
        return dict.fromkeys(["map", *names, "video"], 0.0)
    frames = sum(job.count_frames() for job in jobs)
    new = sum(job.count_frames() for job in jobs if not job.is_mapped)
    learned, tested = settings.learn.epochs * TRAIN_SHARE * frames, _TEST_SHARE * frames
    return {
        "map": _START_S + _MAP_S * new if new else 0.0,
        "label": _START_S + _LABEL_S * frames,
        "train": _START_S + _SAMPLE_S * learned,
        "test": _START_S + _TEST_S * tested,
        "export": _START_S,
        "video": _START_S + _DRAW_S * tested,
    }


def split_lines(parts: Mapping[str, LabelSet], how: str, wanted: str) -> list[str]:
    """Say how a drive's labels were split.

    Args:
        parts: Its label sets by their role.
        how: ``lap``, ``time``, or the part that holds all of it.
        wanted: The setting, which ``how`` stands for.
    """

    def said(role: str) -> str:
        labels = parts[role]
        first, last = int(labels.lap[0]) + 1, int(labels.lap[-1]) + 1
        laps = f"lap {first}" if first == last else f"laps {first} to {last}"
        numbers = f"{labels.frame[0]} to {labels.frame[-1]}"
        return f"{counted(len(labels), 'frame')} ({numbers}), {laps}"

    if len(parts) == 1:
        (role,) = parts
        does = {"train": "learns from", "validation": "picks the best training state on", "test": "tests on"}[
            role
        ]
        return [f"{does} all of it ({said(role)})"]
    lines = [
        f"learns from {said('train')}; picks the best training state on {said('validation')}; tests on "
        f"{said('test')}"
    ]
    if how != wanted and how == "time":
        lines.append("there are no three complete laps: the drive is split along its time instead of by laps")
    return lines


def gain_line(start: str, shared: SharedErrors) -> str:
    """Say whether the trained network is better than the one that it started from.

    Args:
        start: Name of the one before.
        shared: Its errors and those of the trained one, on the points that both answered.
    """

    def printed(stats: ErrorStats) -> tuple[float, float]:
        return round(stats.median_cm, 2), round(stats.rmse_cm, 2)

    (before_cm, before_rmse), (after_cm, after_rmse) = printed(shared.own), printed(shared.first)
    better = after_rmse < before_rmse and after_cm <= before_cm
    worse = after_rmse > before_rmse and after_cm >= before_cm
    verdict = "neither is better in both"
    if better or worse:
        verdict = "the training has made it better" if better else "the training has not made it better"
    return (
        f"on the points that both answer, {start}, which it started from, has a median error of "
        f"{before_cm:.2f} cm (RMSE {before_rmse:.2f}), the trained network {after_cm:.2f} cm "
        f"({after_rmse:.2f}): {verdict}"
    )


def _robustness(model: Path, sources: Sequence[Opened]) -> list[RobustRow]:
    """Errors of a model on changed test frames; none if a label set knows no lines to change."""
    from lanenet.evaluation.answers import RasterModel
    from lanenet.evaluation.robustness import can_measure, measure_robustness

    known = [(source.labels, str(source.path)) for source in sources if source.labels is not None]
    known = [(labels, name) for labels, name in known if can_measure(labels)]
    if not known:
        return []
    label_sets, names = zip(*known, strict=True)
    return measure_robustness({"network": RasterModel(model)}, label_sets, names)
