"""``lanenet train``: from a config to a checkpoint with its tables and its model card.

Imports ``datagen`` and ``lanenet.learn`` inside the commands, since the car has neither torch nor numba.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from pydantic import Field

from lanenet.cli import val as val_cli
from lanenet.cli.shared import console
from lanenet.cli.shared.options import ConfigArgument, MarkingOption, OverridesArgument, lock_outputs
from lanenet.config import Settings, dump_settings, load_settings
from lanenet.errors import CheckpointError
from lanenet.reading import read_json

if TYPE_CHECKING:
    from collections.abc import Sequence

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


@app.command(epilog="Example: lanenet train configs/small.yaml learn.epochs=5")
def train(
    config: ConfigArgument,
    overrides: OverridesArgument = None,
    marking: MarkingOption = None,
) -> None:
    """Make the drives, maps and labels that CONFIG needs, then train, evaluate and export."""
    train_run(load_settings(run_settings_schema(), config, overrides), marking)


def train_run(settings: Any, marking: float | None = None) -> Path:
    """Do what the command does with the settings of its config, see :func:`run_settings_schema`.

    Returns:
        The checkpoint's folder.
    """
    from datagen.datasets.build import prepare
    from lanenet.data.files import json_text
    from lanenet.data.label_set import read_labels
    from lanenet.evaluation.answers import Compared
    from lanenet.evaluation.card import CARD_NAME, model_card
    from lanenet.evaluation.comparison import default_names, evaluate
    from lanenet.evaluation.model_page import model_page
    from lanenet.evaluation.report import report_files
    from lanenet.evaluation.robustness import as_dict
    from lanenet.evaluation.sources import open_tests
    from lanenet.learn.checkpoint import METRICS_NAME, check_start, hash_run, publish
    from lanenet.learn.train import train as train_network
    from lanenet.page import PAGE_NAME
    from lanenet.perception.network.model_file import read_model_meta
    from lanenet.samples.dataset import compile_kernels

    checkpoint = settings.checkpoints_dir / settings.name
    lock_outputs(checkpoint)
    check_start(settings.learn, settings.data.window, settings.data.perceptions)
    with console.progress_bar("data") as progress:
        data = prepare(settings.data, settings.work_folder, progress, last=compile_kernels)
    if data.left_out:
        console.show_problems([f"{len(data.left_out)} synthetic drives are left out", *data.left_out[:5]])
    # One folder per settings and data, so that a stopped run finds its own state.
    run_hash = hash_run(settings.learn, data.train, data.validation)
    run_folder = settings.work_folder / f"train-{run_hash}"
    with console.training_bar() as progress:
        model = train_network(settings.learn, data.train, data.validation, run_folder, progress).model_path
    judged = data.of("test")
    if not judged:
        console.show_problems(["the data has no test part: the tables use the validation labels"])
        judged = data.of("validation")
    sources = open_tests([part.labels for part in judged], [part.frames for part in judged])
    training = [read_labels(path) for path in dict.fromkeys(data.train)]
    with console.progress_bar("test") as progress:
        comparison, seen = evaluate(
            sources,
            # The config decides which camera made which test drive.
            Compared(default_names(sources, with_model=True), {"network": model}, marking, any_camera=True),
            training,
            settings.data.processes,
            progress,
        )
    val_cli.show(comparison, seen, "on the test drives", ["network"])
    robustness = _robustness(model, sources)
    card = model_card(
        settings.name,
        read_model_meta(model),
        read_json(run_folder / METRICS_NAME, CheckpointError),
        training,
        [source.labels for source in sources if source.labels is not None],
        comparison,
        robustness,
    )
    page = model_page(f"How good {settings.name} is", comparison, seen, "on the test drives")
    files: dict[str, str | bytes] = {"run.yaml": dump_settings(settings), CARD_NAME: card, PAGE_NAME: page}
    files |= {f"results{ending}": content for ending, content in report_files(comparison, seen).items()}
    if robustness:
        files["robustness.json"] = json_text(as_dict(robustness))
    if data.camera is not None:
        files["camera.yaml"] = data.camera.read_bytes()
    if data.example is not None:
        files[f"example{data.example.suffix}"] = data.example.read_bytes()
    publish(run_folder, checkpoint, settings.name, files, comparison.as_dict())
    console.wrote(checkpoint)
    options = {
        "--detector": "network",
        "--model": checkpoint,
        "--camera": checkpoint / "camera.yaml" if data.camera is not None else None,
        "--out": "runs/lanes.csv",
    }
    source = checkpoint / f"example{data.example.suffix}" if data.example is not None else "SOURCE"
    console.next_command("detect", source, *console.given(options))
    return checkpoint


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
