"""A recorded search for the window, the size, the loss and the learning rate, judged on validation drives."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lanenet.data.files import require, write_text
from lanenet.data.label_set import LabelSet, read_labels
from lanenet.errors import ConfigError, LanenetError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.checkpoint import best_record, hash_run
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.train import TrainingRun, torch_threads
from lanenet.learn.trunks import TRUNKS
from lanenet.outputs import make_folder
from lanenet.samples.dataset import LaneSamples, check_same

_BEST = 10
_NAMES = {
    "val_rmse_cm": "RMSE, cm",
    "cell_cm": "cell, cm",
    "far_cm": "far, cm",
    "half_width_cm": "half width, cm",
    "first_channels": "channels",
    "layers": "layers",
    "hidden": "hidden",
    "loss": "loss",
    "evenness": "evenness",
    "learning_rate": "rate",
    "parameters": "parameters",
    "epochs": "epochs",
    "cpu_s": "CPU, s",
}


def trials_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return trials as CSV, a row each, in their order."""
    text = io.StringIO()
    writer = csv.DictWriter(text, ["trial", "state", *_NAMES], lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def trials_table(rows: Sequence[Mapping[str, Any]], choices: Sequence[str]) -> str:
    """Return the best trials, and for each choice the errors of the trials that made it, as Markdown.

    Args:
        rows: Trials by the names of the CSV; ``state`` is ``complete``, or ``pruned`` for trials that were
            stopped early, which do not count.
        choices: Names of what takes one of a few values.
    """
    whole = sorted((row for row in rows if row["state"] == "complete"), key=lambda row: row["val_rmse_cm"])
    lines = [
        f"{len(whole)} complete trials, {len(rows) - len(whole)} stopped early. RMSE over the six points "
        "of the validation drives.",
        "",
        "| " + " | ".join(_NAMES.values()) + " |",
        "|" + "---|" * len(_NAMES),
    ]
    lines += ["| " + " | ".join(_shown(row[key]) for key in _NAMES) + " |" for row in whole[:_BEST]]
    lines += ["", "| choice | value | trials | best RMSE, cm | median RMSE, cm |", "|---|---|---|---|---|"]
    for key in choices:
        for value in sorted({row[key] for row in whole}, key=str):
            errors = [row["val_rmse_cm"] for row in whole if row[key] == value]
            figures = f"{len(errors)} | {min(errors):.3f} | {np.median(errors):.3f}"
            lines.append(f"| {_NAMES[key].removesuffix(', cm')} | {_shown(value)} | {figures} |")
    return "\n".join(lines) + "\n"


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


#: Called with (finished trials, trials).
Progress = Callable[[int, int], None]

DATABASE_NAME = "sweep.db"

#: What is tried. The first trial takes the first value of each: the small network as it is. The others are
#: about half and twice that value.
CHOICES: dict[str, tuple[Any, ...]] = {
    "cell_cm": (0.75, 0.5, 1.0, 1.5),
    "far_cm": (72.0, 48.0, 96.0),
    "half_width_cm": (48.0, 36.0, 60.0),
    "first_channels": (16, 8, 12, 24),
    "layers": (5, 4, 3),
    "hidden": (64, 32, 128),
    # Points as distributions, or as numbers with one of these distributions of their errors.
    "loss": ("bins", "student", "laplace", "gaussian"),
    "evenness": (0.5, 0.0, 1.0, 2.0),
}
#: Lowest and highest that is tried, about the default's factor of 5 and 3.
LEARNING_RATE = (5e-4, 1e-2)

#: Trials that run to their end before others are compared with them, and epochs that each trial gets. Chosen.
_UNPRUNED, _LEAST_EPOCHS = 5, 3
_OUT_OF_TIME = math.inf


def sweep(
    settings: LearnSettings,
    train_paths: Sequence[Path],
    val_paths: Sequence[Path],
    out: Path,
    seconds: float,
    trials: int,
    progress: Progress | None = None,
    set_weights: Sequence[float] = (),
) -> str:
    """Try networks until the time is up, and write the table of all trials.

    The trials are kept in an SQLite file. A later call with the same data and settings continues them; an
    interrupted trial starts again.

    Args:
        settings: Of each training, apart from what is tried.
        train_paths: Label sets to learn from.
        val_paths: Label sets that judge.
        out: Folder for ``sweep.db``, ``trials.csv`` and ``sweep.md``.
        seconds: No trial runs longer than this after the start.
        trials: Finished trials at most, those of earlier calls included.
        progress: Called after each trial.
        set_weights: How often each set to learn from is shown beside the others; none weighs all alike.

    Returns:
        The table, as Markdown.

    Raises:
        ConfigError: If the network's size cannot be set (AlexNet).
        MissingExtraError: If optuna is not installed.
        LabelFormatError: If the label sets cannot be read or learned together.
    """
    if "channels" not in TRUNKS[settings.network.kind].uses:
        raise ConfigError(
            f"learn.network.kind: found {settings.network.kind}, expected a network whose size can be set"
        )
    optuna: Any = require("optuna", "sweep")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    deadline = time.monotonic() + seconds
    sets = [read_labels(path) for path in train_paths]
    val_sets = [read_labels(path) for path in val_paths]
    check_same(sets[0].meta, val_sets[0].meta, str(train_paths[0]), str(val_paths[0]))
    make_folder(out)
    study = _open_study(
        optuna, out / DATABASE_NAME, hash_run(settings, train_paths, val_paths, set_weights), settings.seed
    )
    states = optuna.trial.TrialState
    finished = (states.COMPLETE, states.PRUNED)
    with torch_threads(settings.threads):
        while (done := len(study.get_trials(states=finished))) < trials and time.monotonic() < deadline:
            trial = study.ask()
            window, chosen = _draw(trial, settings)
            samples = LaneSamples(
                [_seen_in(s, window) for s in sets], [str(p) for p in train_paths], weights=set_weights
            )
            val = LaneSamples([_seen_in(s, window) for s in val_sets], [str(p) for p in val_paths])
            value = _try(trial, TrainingRun(chosen, samples), val, deadline)
            if value == _OUT_OF_TIME:
                study.tell(trial, state=states.FAIL)
                study.enqueue_trial(trial.params)
                break
            study.tell(trial, value, states.COMPLETE if value is not None else states.PRUNED)
            _write_tables(study, out)
            if progress is not None:
                progress(done + 1, trials)
    return _write_tables(study, out)


def _open_study(optuna: Any, path: Path, key: str, seed: int) -> Any:
    """Open the trials of the same data and settings; those that a kill left open are queued again."""
    name = hashlib.sha256(f"{key} {CHOICES} {LEARNING_RATE}".encode()).hexdigest()[:16]
    # Each call draws other trials, and the first call always the same.
    study = optuna.create_study(
        study_name=name,
        storage=f"sqlite:///{path.resolve()}",
        load_if_exists=True,
        pruner=optuna.pruners.MedianPruner(n_startup_trials=_UNPRUNED, n_warmup_steps=_LEAST_EPOCHS),
    )
    study.sampler = optuna.samplers.TPESampler(seed=seed + len(study.trials))
    state = optuna.trial.TrialState
    for trial in study.get_trials(states=(state.RUNNING,)):
        study.tell(trial.number, state=state.FAIL)
        study.enqueue_trial(trial.params)
    if not study.trials:
        first = {name: values[0] for name, values in CHOICES.items()}
        study.enqueue_trial(first | {"learning_rate": LearnSettings().learning_rate})
    return study


def _draw(trial: Any, settings: LearnSettings) -> tuple[BirdseyeWindow, LearnSettings]:
    """Draw what a trial tries."""
    drawn = {name: trial.suggest_categorical(name, values) for name, values in CHOICES.items()}
    cell_cm, half_cm = drawn["cell_cm"], drawn["half_width_cm"]
    window = BirdseyeWindow(
        left_cm=-half_cm,
        near_cm=0.0,
        cell_cm=cell_cm,
        rows=round(drawn["far_cm"] / cell_cm),
        columns=round(2.0 * half_cm / cell_cm),
    )
    # As in the compact trunks: layer k has k times the channels of the first.
    channels = tuple(drawn["first_channels"] * k for k in range(1, drawn["layers"] + 1))
    bins = (settings.network.bins or NetworkSettings().bins) if drawn["loss"] == "bins" else 0
    network = {"channels": channels, "hidden": drawn["hidden"], "bins": bins}
    network["takes_width"] = settings.network.takes_width
    loss = settings.loss.model_dump() | {"evenness": drawn["evenness"]}
    if not bins:
        loss["kind"] = drawn["loss"]
    rate = trial.suggest_float("learning_rate", *LEARNING_RATE, log=True)
    data = settings.model_dump() | {"network": network, "loss": loss, "learning_rate": rate}
    return window, LearnSettings.model_validate(data)


def _seen_in(labels: LabelSet, window: BirdseyeWindow) -> LabelSet:
    """Return labels with another window; all trials are judged on the same labels."""
    return replace(labels, meta=replace(labels.meta, window=window))


def _try(trial: Any, run: TrainingRun, val: LaneSamples, deadline: float) -> float | None:
    """Train; returns the best validation error, [cm], None if stopped early, or ``_OUT_OF_TIME``."""
    trial.set_user_attr("parameters", run.network.n_parameters)
    began = time.process_time()
    while not run.ended:
        try:
            record = run.run_epoch(val)
        except LanenetError:
            # The learning rate made the training diverge.
            return None
        trial.report(record.val_rmse_cm, record.epoch)
        trial.set_user_attr("epochs", record.epoch)
        trial.set_user_attr("cpu_s", time.process_time() - began)
        if not run.ended and time.monotonic() >= deadline:
            return _OUT_OF_TIME
        if not run.ended and trial.should_prune():
            return None
    return best_record(run.history).val_rmse_cm


def _write_tables(study: Any, out: Path) -> str:
    done = [trial for trial in study.trials if trial.state.name in ("COMPLETE", "PRUNED")]
    rows = [
        {
            "trial": trial.number,
            "state": trial.state.name.lower(),
            "val_rmse_cm": trial.value,
            **trial.params,
            **{key: trial.user_attrs.get(key) for key in ("parameters", "epochs", "cpu_s")},
        }
        for trial in done
    ]
    table = trials_table(rows, tuple(CHOICES))
    write_text(out / "trials.csv", trials_csv(rows))
    write_text(out / "sweep.md", table)
    return table
