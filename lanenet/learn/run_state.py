"""What a training run keeps on disk and starts from: its state, its end, and weights for fine-tuning."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lanenet.data.files import atomic_file
from lanenet.errors import CheckpointError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.config import LearnSettings
from lanenet.learn.export import WEIGHTS_NAME, read_network
from lanenet.learn.network import LaneNet, new_network
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.network.model_file import MODEL_NAME
from lanenet.samples.dataset import hash_files


def check_start(
    settings: LearnSettings, window: BirdseyeWindow, perceptions: Sequence[PerceptionSettings]
) -> None:
    """Refuse starting weights that the training would refuse, before its data is made.

    Args:
        settings: Of the training.
        window: Window of the rasters that the network will see.
        perceptions: How the edges of each drive will be found.

    Raises:
        CheckpointError: As :func:`load_start_weights`; or pretrained weights cannot be read.
    """
    network = new_network(settings.network, window.rows, window.columns, settings.seed)
    if settings.start_from is not None:
        for perception in perceptions:
            load_start_weights(network, settings.start_from, window, perception)


def load_start_weights(
    network: LaneNet, folder: Path, window: BirdseyeWindow, perception: PerceptionSettings
) -> None:
    """Load the weights of a checkpoint, with the mean and the scale of the labels that belong to them.

    Args:
        network: Network to change.
        folder: Checkpoint folder.
        window: Window of the rasters that the network will see.
        perception: How their edges were found.

    Raises:
        CheckpointError: If the checkpoint cannot be read, is of another network or was made for another
            window or other edges.
    """
    start, meta = read_network(folder)
    if meta.window != window:
        raise CheckpointError(
            f"learn.start_from {folder}: was trained on the window {meta.window}, but the labels have "
            f"{window}; set data.window to the checkpoint's"
        )
    unlike = perception.unlike(meta.perception)
    if unlike:
        raise CheckpointError(
            f"learn.start_from {folder}: was trained on edges with other settings than those of the labels "
            f"({unlike}); set data.colour_weight to the checkpoint's"
        )
    weights = start.state_dict()
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    for name in sorted(shapes.keys() | weights.keys()):
        found = tuple(weights[name].shape) if name in weights else None
        if found != shapes.get(name):
            raise CheckpointError(
                f"learn.start_from {folder}: found weights {name!r} of shape {found}, expected "
                f"{shapes.get(name)}; set learn.network as in the checkpoint's config.yaml"
            )
    network.load_state_dict(weights)


def hash_of_start(folder: Path | None) -> str:
    """Return a hash of the weights that a run starts from; empty for random weights.

    Raises:
        CheckpointError: If the folder has none.
    """
    if folder is None:
        return ""
    path = folder / WEIGHTS_NAME
    if not path.is_file():
        raise CheckpointError(f"learn.start_from {folder}: no {WEIGHTS_NAME}, expected a checkpoint")
    return hash_files([path])


STATE_NAME = "last.pt"
METRICS_NAME = "metrics.json"
METRICS_FORMAT = "lanenet-metrics/1"

_VERSION = 2  # of the training; raise it when the same settings and data give other weights
_ADVICE = "pick another name, or delete the folder to train anew"


@dataclass(frozen=True)
class EpochRecord:
    """One line of the training curve.

    Attributes:
        epoch: Counted from 1.
        train_rmse_cm: Over the augmented samples of the epoch, while the weights were changing.
        val_rmse_cm: Over the validation frames, with the running mean of the weights.
        learning_rate: At the end of the epoch.
        samples_per_s: Speed of the training part.
        val_trimmed_cm: As ``val_rmse_cm``, without the largest hundredth of the errors: some labels from maps
            are wrong by a lane, and the network that agrees with them is not the best one.
    """

    epoch: int
    train_rmse_cm: float
    val_rmse_cm: float
    learning_rate: float
    samples_per_s: float
    val_trimmed_cm: float


@dataclass
class RunState:
    """All that a stopped run needs to resume as if it had not stopped.

    Random numbers follow from the seed and the epoch, so no generator is kept.

    Attributes:
        network: Weights after the last epoch.
        ema: Running mean of the weights.
        optimizer: State of the optimiser.
        step: Steps taken.
        history: One record per finished epoch.
        best: Running mean of the weights at the best epoch; None before the first.
    """

    network: dict[str, Tensor]
    ema: dict[str, Tensor]
    optimizer: dict[str, Any]
    step: int
    history: list[EpochRecord]
    best: dict[str, Tensor] | None


def best_record(history: Sequence[EpochRecord]) -> EpochRecord:
    """Return the epoch of the lowest trimmed validation error; the first of equals."""
    return min(history, key=lambda r: math.inf if math.isnan(r.val_trimmed_cm) else r.val_trimmed_cm)


def hash_run(settings: LearnSettings, train_paths: Sequence[Path], val_paths: Sequence[Path]) -> str:
    """Return a hash of all that decides a run: version, settings, contents of the files, starting weights.

    Raises:
        LabelFormatError: If a file cannot be read.
        CheckpointError: If there are no weights to start from.
    """
    weights = [] if settings.network.weights is None else [settings.network.weights]
    text = (
        f"{_VERSION} {settings.hash} {hash_files(train_paths)} {hash_files(val_paths)} {hash_files(weights)}"
    )
    text += hash_of_start(settings.start_from)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_state(path: Path, state: RunState, run_hash: str) -> None:
    """Write the state; a kill while writing leaves the previous one."""
    history = [list(vars(record).values()) for record in state.history]
    data = {"run_hash": run_hash, **vars(state), "history": history}
    with atomic_file(path) as temporary:
        torch.save(data, temporary)


def read_state(path: Path, run_hash: str) -> RunState | None:
    """Read the state that an earlier run with the same settings and data left; None if there is none.

    Raises:
        CheckpointError: If the file is of another run or cannot be read.
    """
    if not path.is_file():
        return None
    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
        found = data.pop("run_hash")
        state = RunState(**data | {"history": [EpochRecord(*values) for values in data["history"]]})
    except Exception as error:  # the unpickler raises whatever damaged bytes lead it to
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise CheckpointError(
            f"{path}: cannot be read as the state of a run ({reason}); delete it to start over"
        ) from None
    if found != run_hash:
        raise CheckpointError(
            f"{path}: left by a run with other settings or data ({found}, now {run_hash}); {_ADVICE}"
        )
    return state


def read_finished(folder: Path, run_hash: str) -> dict[str, Any] | None:
    """Return the metrics of a finished run with the same settings and data; None if it is not finished.

    Raises:
        CheckpointError: If the folder holds a finished run with other settings or data.
    """
    path = folder / METRICS_NAME
    if not path.is_file():
        return None
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
        found, form = metrics["run_hash"], metrics["format"]
        best = float(metrics["val_rmse_cm"])
    except (OSError, ValueError, KeyError, TypeError):
        raise CheckpointError(f"{path}: not the metrics of a training run; {_ADVICE}") from None
    if form != METRICS_FORMAT:
        raise CheckpointError(f"{path}: format {form!r}, expected {METRICS_FORMAT!r}; {_ADVICE}")
    if found != run_hash:
        raise CheckpointError(
            f"{folder}: holds a model trained with other settings or data ({found}, now {run_hash}); "
            f"{_ADVICE}"
        )
    complete = (folder / MODEL_NAME).is_file() and (folder / WEIGHTS_NAME).is_file() and math.isfinite(best)
    return metrics if complete else None
