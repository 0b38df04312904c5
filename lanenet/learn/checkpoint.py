"""The folder of a training run: its state, its results, its starting weights, and its publication."""

from __future__ import annotations

import hashlib
import importlib.metadata
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from jaxtyping import UInt8
from torch import Tensor

from lanenet.config import dump_settings
from lanenet.data.files import atomic_file, atomic_folder, write_bytes, write_json, write_text
from lanenet.errors import CheckpointError
from lanenet.evaluation.errors import presence_stats
from lanenet.evaluation.report import new_figure, png_bytes
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.config import LearnSettings
from lanenet.learn.export import (
    CALIBRATION_NAME,
    CHECKPOINT_FORMAT,
    CONFIG_NAME,
    RASTERS_NAME,
    WEIGHTS_NAME,
    export_onnx,
    read_network,
    write_rasters,
    write_weights,
)
from lanenet.learn.network import LaneNet, new_network
from lanenet.learn.predict import predict
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.network.model_file import MARKER_NAME, MODEL_NAME, ModelMeta, open_model
from lanenet.reading import MEBIBYTE, read_json
from lanenet.samples.dataset import Samples, hash_files
from lanenet.samples.shards import Shards, read_shards

STATE_NAME = "last.pt"
CURVE_NAME = "curve"
METRICS_NAME = "metrics.json"
METRICS_FORMAT = "lanenet-metrics/1"

_VERSION = 2  # of the training; raise it when the same settings and data give other weights
_ADVICE = "pick another name, or delete the folder to train anew"
#: Rasters that are kept: to check later exports, and to find the value ranges of an INT8 model. Chosen:
#: enough of both in files below 100 kB.
_N_CHECK_RASTERS, _N_CALIBRATION_RASTERS = 48, 96
#: Files that unpack to less than the memory even so need no look at their footers. Chosen: label sets unpack
#: to 1.1 times their size, those of a still car to more.
_MOST_UNPACKED = 20
#: Whose versions the metrics name.
_PACKAGES = ("lanenet", "numpy", "torch", "onnx", "onnxruntime", "opencv-python-headless")


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


def hash_run(
    settings: LearnSettings,
    train_paths: Sequence[Path],
    val_paths: Sequence[Path],
    set_weights: Sequence[float] = (),
) -> str:
    """Return a hash of all that decides a run: version, settings, contents of the files, starting weights.

    Args:
        settings: How to train.
        train_paths: Label sets to learn from.
        val_paths: Label sets that choose the best epoch.
        set_weights: How often each set to learn from is shown; none, or all alike, is another word for the
            same.

    Raises:
        LabelFormatError: If a file cannot be read.
        CheckpointError: If there are no weights to start from.
    """
    weights = [] if settings.network.weights is None else [settings.network.weights]
    shards = choose_stream(settings, train_paths, val_paths)
    if shards is None:
        data = f"{hash_files(train_paths)} {hash_files(val_paths)}"
    else:
        # By their footers: to read all of what does not fit into memory takes minutes.
        data = " ".join(index.hash for part in shards for index in part.indices)
        data += f" {len(train_paths)} {settings.memory_mb} MB"
    text = f"{_VERSION} {settings.hash} {data} {hash_files(weights)}"
    text += hash_of_start(settings.start_from)
    if len(set(set_weights)) > 1:
        text += f" {list(set_weights)}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def choose_stream(
    settings: LearnSettings, train_paths: Sequence[Path], val_paths: Sequence[Path]
) -> tuple[Shards, Shards] | None:
    """Return the row groups of the training and the validation, if they do not fit into memory; else None.

    Raises:
        LabelFormatError: If a label set is missing or has another format.
    """
    # A file that cannot be read is told of where it is read as a whole.
    sizes = [path.stat().st_size for path in (*train_paths, *val_paths) if path.is_file()]
    if sum(sizes) * _MOST_UNPACKED <= settings.memory_mb * MEBIBYTE:
        return None
    train, val = read_shards(train_paths), read_shards(val_paths)
    fits = train.unpacked_bytes + val.unpacked_bytes <= settings.memory_mb * MEBIBYTE
    return None if fits else (train, val)


def write_state(path: Path, state: RunState, run_hash: str) -> None:
    """Write the state; a kill while writing leaves the previous one."""
    history = [list(vars(record).values()) for record in state.history]
    data = {"run_hash": run_hash, **vars(state), "history": history}
    with atomic_file(path) as temporary:
        try:
            torch.save(data, temporary)
        except RuntimeError as error:  # what torch makes of a full disk
            raise CheckpointError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from error


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
        metrics = read_json(path, CheckpointError)
        found, form = metrics["run_hash"], metrics["format"]
        best = float(metrics["val_rmse_cm"])
    except (CheckpointError, ValueError, KeyError, TypeError):
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


def write_checkpoint(
    folder: Path,
    settings: LearnSettings,
    network: LaneNet,
    samples: Samples,
    val: Samples,
    history: Sequence[EpochRecord],
    run_hash: str,
) -> float:
    """Write the results of a run; the metrics come last and mark it as finished.

    Args:
        folder: Where to write.
        settings: Of the training.
        network: Weights of its best epoch.
        samples: Training frames.
        val: Validation frames.
        history: Training curve.
        run_hash: Of settings and data.

    Returns:
        The RMSE of the network on the validation frames, [cm].

    Raises:
        CheckpointError: If the exported model does not answer as PyTorch does.
    """
    answers = predict(network, val)
    errors = answers.errors
    meta = ModelMeta(
        window=samples.window,
        camera_hashes=tuple(samples.camera_hashes),
        wheelbase_cm=samples.wheelbase_cm,
        lane_width_cm=samples.lane_width_cm,
        training_hash=run_hash,
        rmse_cm=errors.point_rmse_cm,
        reference=errors.reference,
        perception=samples.perception,
        lane_width_range_cm=samples.lane_widths_cm,
        takes_width=settings.network.takes_width,
        planes=network.planes,
    )
    rasters = _spread_rasters(val, _N_CHECK_RASTERS, network.planes)
    write_text(folder / CONFIG_NAME, dump_settings(settings))
    write_weights(folder / WEIGHTS_NAME, network, meta)
    write_rasters(folder / RASTERS_NAME, rasters)
    write_rasters(folder / CALIBRATION_NAME, _spread_rasters(samples, _N_CALIBRATION_RASTERS, network.planes))
    difference = export_onnx(network, meta, rasters, folder / MODEL_NAME)
    write_curve(folder, history)
    presence = presence_stats(answers.presence, answers.present)
    metrics: dict[str, Any] = {
        "format": METRICS_FORMAT,
        "run_hash": run_hash,
        "units": {"*_cm": "centimetres", "samples_per_s": "training samples per second"},
        "val_rmse_cm": errors.all.rmse_cm,
        "best_epoch": best_record(history).epoch,
        "epochs": len(history),
        "train_frames": len(samples),
        "val_frames": len(val),
        "parameters": network.n_parameters,
        "sigma_factors": network.sigma_factor.tolist(),
        "val_presence": None if presence is None else vars(presence),
        "onnx_difference_cm": difference,
        "median_samples_per_s": float(np.median([record.samples_per_s for record in history])),
        "seed": settings.seed,
        "versions": {name: _version(name) for name in _PACKAGES},
        "val": errors.as_dict(),
    }
    write_json(folder / METRICS_NAME, metrics)
    return errors.all.rmse_cm


def _spread_rasters(samples: Samples, count: int, planes: int) -> UInt8[np.ndarray, "_ p r c"]:
    """Return rasters of frames spread evenly over all."""
    chosen = np.unique(np.linspace(0, len(samples) - 1, count).astype(np.intp))
    return np.ascontiguousarray(samples.plain_batch(chosen).rasters[:, :planes])


@contextmanager
def tensorboard_curve(
    folder: Path, first_epoch: int, wanted: bool
) -> Iterator[Callable[[EpochRecord], None]]:
    """Yield a function that writes each epoch's record for TensorBoard.

    Args:
        folder: Checkpoint folder; the events go into its ``tensorboard``.
        first_epoch: Events of an earlier run from this epoch on are dropped.
        wanted: False yields a function that does nothing, and does not need the package.
    """
    if not wanted:
        yield lambda record: None
        return
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(folder / "tensorboard"), purge_step=first_epoch) as writer:

        def show(record: EpochRecord) -> None:
            for name, value in vars(record).items():
                if name != "epoch":
                    writer.add_scalar(name, value, record.epoch)
            writer.flush()

        yield show


def write_curve(folder: Path, history: Sequence[EpochRecord]) -> None:
    """Write the training curve as ``curve.csv`` and, where matplotlib is installed, as ``curve.png``."""
    names = list(vars(history[0]))
    lines = [",".join(f"{value:.9g}" for value in vars(record).values()) for record in history]
    write_text(folder / f"{CURVE_NAME}.csv", "\n".join([",".join(names), *lines]) + "\n")
    figure = new_figure(6.0, 4.0)
    if figure is None:
        return
    axes = figure.add_subplot()
    epochs = [record.epoch for record in history]
    axes.plot(epochs, [record.train_rmse_cm for record in history], label="training (augmented)")
    axes.plot(epochs, [record.val_rmse_cm for record in history], label="validation")
    axes.set(xlabel="epoch", ylabel="RMSE of the six points, cm", yscale="log")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    write_bytes(folder / f"{CURVE_NAME}.png", png_bytes(figure))


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def publish(
    run_folder: Path,
    out: Path,
    name: str,
    files: Mapping[str, str | bytes],
    results: Mapping[str, object] | None = None,
) -> None:
    """Copy a finished run, without the state of its optimiser, together with what was measured on it.

    An earlier checkpoint of that name is replaced as a whole, once the new one is complete.

    Args:
        run_folder: Folder of a finished training run.
        out: Checkpoint folder to write.
        name: Of the checkpoint.
        files: Other files by name: config, results, camera.
        results: Figures for ``results.json``.

    Raises:
        CheckpointError: If the run is not finished.
    """
    if not (run_folder / METRICS_NAME).is_file():
        raise CheckpointError(f"{run_folder}: no {METRICS_NAME}, the run is not finished")
    with atomic_folder(out, "checkpoint", _check_published) as folder:
        for path in sorted(run_folder.iterdir()):
            if path.is_file() and path.name != STATE_NAME:
                shutil.copyfile(path, folder / path.name)
        for file_name, content in files.items():
            data = content.encode() if isinstance(content, str) else content
            (folder / file_name).write_bytes(data)
        if results is not None:
            write_json(folder / "results.json", results)
        marker = {"format": CHECKPOINT_FORMAT, "name": name}
        write_text(folder / MARKER_NAME, yaml.safe_dump(marker, sort_keys=False))


def _check_published(folder: Path) -> None:
    """Refuse a checkpoint whose weights or model cannot be read."""
    read_network(folder)
    open_model(folder / MODEL_NAME)


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
