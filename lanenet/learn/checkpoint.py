"""The checkpoint folder: what a finished run writes, and how it is published as ``checkpoints/<name>/``."""

from __future__ import annotations

import importlib.metadata
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import UInt8

from lanenet.config import dump_settings
from lanenet.data.files import atomic_file, atomic_folder, write_json, write_text
from lanenet.errors import CheckpointError
from lanenet.evaluation.breakdown import presence_stats
from lanenet.evaluation.pictures import new_figure, png_bytes
from lanenet.learn.config import LearnSettings
from lanenet.learn.export import (
    CALIBRATION_NAME,
    CHECKPOINT_FORMAT,
    CONFIG_NAME,
    RASTERS_NAME,
    WEIGHTS_NAME,
    export_onnx,
    write_rasters,
    write_weights,
)
from lanenet.learn.network import LaneNet
from lanenet.learn.predict import Answers
from lanenet.learn.run_state import METRICS_FORMAT, METRICS_NAME, STATE_NAME, EpochRecord, best_record
from lanenet.perception.network.model_file import MARKER_NAME, MODEL_NAME, ModelMeta
from lanenet.samples.dataset import LaneSamples

CURVE_NAME = "curve"

#: Rasters that are kept: to check later exports, and to find the value ranges of an INT8 model. Chosen:
#: enough of both in files below 100 kB.
_N_CHECK_RASTERS, _N_CALIBRATION_RASTERS = 48, 96
#: Whose versions the metrics name.
_PACKAGES = ("lanenet", "numpy", "torch", "onnx", "onnxruntime", "opencv-python-headless")


@dataclass(frozen=True)
class FinishedRun:
    """What a checkpoint is written from.

    Attributes:
        settings: Of the training.
        network: Weights of the best epoch.
        samples: Training frames.
        val: Validation frames.
        answers: Of the network on ``val``.
        history: Training curve.
        run_hash: Of settings and data.
    """

    settings: LearnSettings
    network: LaneNet
    samples: LaneSamples
    val: LaneSamples
    answers: Answers
    history: Sequence[EpochRecord]
    run_hash: str


def write_checkpoint(folder: Path, run: FinishedRun) -> None:
    """Write the results of a run; the metrics come last and mark it as finished.

    Raises:
        CheckpointError: If the exported model does not answer as PyTorch does.
    """
    settings, network, samples, answers = run.settings, run.network, run.samples, run.answers
    errors = answers.errors
    meta = ModelMeta(
        window=samples.window,
        camera_hashes=tuple(samples.camera_hashes),
        wheelbase_cm=samples.wheelbase_cm,
        lane_width_cm=samples.lane_width_cm,
        training_hash=run.run_hash,
        rmse_cm=errors.point_rmse_cm,
        reference=errors.reference,
        perception=samples.perception,
        lane_width_range_cm=samples.lane_widths_cm,
        takes_width=settings.network.takes_width,
    )
    rasters = _spread_rasters(run.val, _N_CHECK_RASTERS)
    write_text(folder / CONFIG_NAME, dump_settings(settings))
    write_weights(folder / WEIGHTS_NAME, network, meta)
    write_rasters(folder / RASTERS_NAME, rasters)
    write_rasters(folder / CALIBRATION_NAME, _spread_rasters(samples, _N_CALIBRATION_RASTERS))
    difference = export_onnx(network, meta, rasters, folder / MODEL_NAME)
    write_curve(folder, run.history)
    presence = presence_stats(answers.presence, answers.present)
    metrics: dict[str, Any] = {
        "format": METRICS_FORMAT,
        "run_hash": run.run_hash,
        "units": {"*_cm": "centimetres", "samples_per_s": "training samples per second"},
        "val_rmse_cm": errors.all.rmse_cm,
        "best_epoch": best_record(run.history).epoch,
        "epochs": len(run.history),
        "train_frames": len(samples),
        "val_frames": len(run.val),
        "parameters": network.n_parameters,
        "sigma_factors": network.sigma_factor.tolist(),
        "val_presence": None if presence is None else presence.as_dict(),
        "onnx_difference_cm": difference,
        "median_samples_per_s": float(np.median([record.samples_per_s for record in run.history])),
        "seed": settings.seed,
        "versions": {name: _version(name) for name in _PACKAGES},
        "val": errors.as_dict(),
    }
    write_json(folder / METRICS_NAME, metrics)


def _spread_rasters(samples: LaneSamples, count: int) -> UInt8[np.ndarray, "_ 1 r c"]:
    """Return rasters of frames spread evenly over all."""
    chosen = np.unique(np.linspace(0, len(samples) - 1, count).astype(np.intp))
    return samples.plain_batch(chosen).rasters


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

    writer = SummaryWriter(str(folder / "tensorboard"), purge_step=first_epoch)

    def show(record: EpochRecord) -> None:
        for name, value in vars(record).items():
            if name != "epoch":
                writer.add_scalar(name, value, record.epoch)
        writer.flush()

    try:
        yield show
    finally:
        writer.close()


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
    axes.set_xlabel("epoch")
    axes.set_ylabel("RMSE of the six points, cm")
    axes.set_yscale("log")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    with atomic_file(folder / f"{CURVE_NAME}.png") as temporary:
        temporary.write_bytes(png_bytes(figure))


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
    with atomic_folder(out, "checkpoint") as folder:
        for path in sorted(run_folder.iterdir()):
            if path.is_file() and path.name != STATE_NAME:
                shutil.copyfile(path, folder / path.name)
        for file_name, content in files.items():
            if isinstance(content, str):
                write_text(folder / file_name, content)
            else:
                (folder / file_name).write_bytes(content)
        if results is not None:
            write_json(folder / "results.json", results)
        marker = {"format": CHECKPOINT_FORMAT, "name": name}
        write_text(folder / MARKER_NAME, yaml.safe_dump(marker, sort_keys=False))
