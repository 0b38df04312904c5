"""Train a network on label sets: one call from Parquet files to a checkpoint folder."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lanenet.data.label_set import read_labels
from lanenet.errors import LabelFormatError, LanenetError
from lanenet.learn.config import LearnSettings
from lanenet.learn.dataset import LaneSamples, check_same
from lanenet.learn.evaluate import ErrorTable, point_errors
from lanenet.learn.export import MODEL_NAME
from lanenet.learn.network import LaneNet, input_of_rasters, new_network
from lanenet.learn.report import write_checkpoint
from lanenet.learn.run_state import (
    STATE_NAME,
    EpochRecord,
    RunState,
    hash_run,
    read_finished,
    read_state,
    write_state,
)
from lanenet.learn.start import load_start_weights

#: Called after each epoch: epoch (from 1), epochs, training RMSE, validation RMSE, [cm], samples per second.
Progress = Callable[[int, int, float, float, float], None]

_EVAL_BATCH = 256


@dataclass(frozen=True)
class TrainResult:
    """A finished run.

    Attributes:
        folder: The checkpoint folder.
        model_path: Its ONNX file.
        best_epoch: Epoch of the exported weights, from 1.
        val_rmse_cm: Their RMSE over all labelled points of the validation frames.
        computed: False if the folder already held this run and nothing had to be done.
    """

    folder: Path
    model_path: Path
    best_epoch: int
    val_rmse_cm: float
    computed: bool


def train(
    settings: LearnSettings,
    train_paths: Sequence[Path],
    val_paths: Sequence[Path],
    out: Path,
    progress: Progress | None = None,
) -> TrainResult:
    """Train, evaluate and export a network.

    A run that was stopped goes on from its last written epoch and ends with the same weights, bit for bit on
    the same machine and number of threads. A finished run with the same settings and data is not repeated.

    Args:
        settings: How to train.
        train_paths: Label sets to learn from.
        val_paths: Label sets that choose the best epoch; other drives, or other laps.
        out: Checkpoint folder.
        progress: Called after each epoch.

    Returns:
        Where the model is and how good it is.

    Raises:
        LabelFormatError: If the label sets cannot be read or learned together.
        CheckpointError: If the folder holds a run with other settings or data.
        LanenetError: If the training diverges.
    """
    run_hash = hash_run(settings, train_paths, val_paths)
    metrics = read_finished(out, run_hash)
    if metrics is not None:
        return TrainResult(out, out / MODEL_NAME, metrics["best_epoch"], metrics["val_rmse_cm"], False)
    saved = read_state(out / STATE_NAME, run_hash)
    samples, val = _read_both(settings, train_paths, val_paths)
    out.mkdir(parents=True, exist_ok=True)
    with _threads(settings.threads):
        run = _Run(settings, samples, saved)
        while len(run.history) < settings.epochs:
            record = run.run_epoch(val)
            if record.epoch % settings.checkpoint_every == 0 or record.epoch == settings.epochs:
                write_state(out / STATE_NAME, run.state(), run_hash)
            if progress is not None:
                progress(
                    record.epoch,
                    settings.epochs,
                    record.train_rmse_cm,
                    record.val_rmse_cm,
                    record.samples_per_s,
                )
        network = run.best_network()
        errors = evaluate_network(network, val)
        best = run.state().best_record
        write_checkpoint(out, settings, network, samples, val, errors, run.history, run_hash)
    return TrainResult(out, out / MODEL_NAME, best.epoch, errors.all.rmse_cm, True)


def learning_rate_at(step: int, total: int, settings: LearnSettings) -> float:
    """Return the learning rate of a step (from 0): a straight rise, then a cosine down to zero."""
    rise = settings.warmup * total
    if step < rise:
        return settings.learning_rate * (step + 1) / (rise + 1)
    share = (step - rise) / max(total - rise, 1.0)
    return settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))


def masked_loss(
    points_cm: Float[Tensor, "n 6"], labels_cm: Float[Tensor, "n 6"], huber_cm: float
) -> Float[Tensor, ""]:
    """Return the mean smooth L1 loss over the labelled points, [cm]; masked labels are NaN."""
    known = torch.isfinite(labels_cm)
    # Index, not multiply: 0 * NaN is NaN, and so would be its gradient.
    return nn.functional.smooth_l1_loss(points_cm[known], labels_cm[known], beta=huber_cm)


def evaluate_network(network: LaneNet, samples: LaneSamples) -> ErrorTable:
    """Return the errors of a network on frames as they are."""
    was_training = network.training
    network.eval()
    predictions = []
    with torch.inference_mode():
        for start in range(0, len(samples), _EVAL_BATCH):
            rasters, _, _ = samples.plain_batch(np.arange(start, min(start + _EVAL_BATCH, len(samples))))
            predictions.append(network(input_of_rasters(torch.from_numpy(rasters))).numpy())
    network.train(was_training)
    return point_errors(np.concatenate(predictions).astype(np.float64), samples.points_cm, samples.reference)


class _Run:
    """Weights, optimiser and curve of a run in memory."""

    def __init__(self, settings: LearnSettings, samples: LaneSamples, saved: RunState | None) -> None:
        self.settings, self.samples = settings, samples
        rows, columns = samples.window.rows, samples.window.columns
        self.network = new_network(settings.network, rows, columns, settings.seed)
        mean, scale = samples.normalisation(settings.augment.mirror > 0.0)
        self.network.mean_cm.copy_(torch.from_numpy(mean))
        self.network.scale_cm.copy_(torch.from_numpy(scale))
        if settings.start_from is not None:
            load_start_weights(self.network, settings.start_from, samples.window)
        self.ema = LaneNet(settings.network, rows, columns)
        self.ema.load_state_dict(self.network.state_dict())
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        plain = [p for p in self.network.parameters() if p.ndim <= 1]
        self.optimizer = torch.optim.AdamW(
            [
                {"params": decayed, "weight_decay": settings.weight_decay},
                {"params": plain, "weight_decay": 0.0},
            ],
            lr=settings.learning_rate,
        )
        self.step = 0
        self.history: list[EpochRecord] = []
        self.best: dict[str, Tensor] | None = None
        self.total = max(1, settings.epochs * samples.steps_per_epoch(settings.batch_size))
        if saved is not None:
            self.network.load_state_dict(saved.network)
            self.ema.load_state_dict(saved.ema)
            self.optimizer.load_state_dict(saved.optimizer)
            self.step, self.history, self.best = saved.step, list(saved.history), saved.best

    def run_epoch(self, val: LaneSamples) -> EpochRecord:
        """Train one epoch and evaluate it."""
        settings, epoch = self.settings, len(self.history)
        started = time.perf_counter()
        squares, count, n_samples, rate = 0.0, 0, 0, 0.0
        self.network.train()
        for rasters, labels, _ in self.samples.epoch(
            settings.augment, settings.seed, epoch, settings.batch_size, balance=settings.balance
        ):
            rate = learning_rate_at(self.step, self.total, settings)
            targets = torch.from_numpy(labels)
            points = self._step(input_of_rasters(torch.from_numpy(rasters)), targets, rate)
            error = (points - targets)[torch.isfinite(targets)]
            squares += float((error * error).sum())
            count += error.numel()
            n_samples += len(rasters)
            if not math.isfinite(squares):
                raise LanenetError(
                    f"training diverged in epoch {epoch + 1}: the error is not finite; lower learning_rate "
                    f"(now {settings.learning_rate:g})"
                )
        seconds = time.perf_counter() - started
        val_rmse_cm = evaluate_network(self.ema, val).all.rmse_cm
        record = EpochRecord(
            epoch=epoch + 1,
            train_rmse_cm=math.sqrt(squares / max(count, 1)),
            val_rmse_cm=val_rmse_cm,
            learning_rate=rate,
            samples_per_s=n_samples / seconds,
        )
        if not self.history or val_rmse_cm < min(r.val_rmse_cm for r in self.history):
            self.best = {name: value.clone() for name, value in self.ema.state_dict().items()}
        self.history.append(record)
        return record

    def _step(self, inputs: Tensor, targets: Tensor, rate: float) -> Tensor:
        """Take one step; answers the points that it started from."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        points: Tensor = self.network(inputs)
        if bool(torch.isfinite(targets).any()):
            self.optimizer.zero_grad(set_to_none=True)
            loss = masked_loss(points, targets, self.settings.huber_cm)
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimizer.step()
        self.step += 1
        # Short at first, so that the first epochs are not judged by their random beginning.
        decay = min(self.settings.ema_decay, (1.0 + self.step) / (10.0 + self.step))
        with torch.no_grad():
            current = self.network.state_dict()
            for name, mean in self.ema.state_dict().items():
                if mean.is_floating_point():
                    mean.lerp_(current[name], 1.0 - decay)
                else:
                    mean.copy_(current[name])
        return points.detach()

    def state(self) -> RunState:
        """Return what :class:`RunState` keeps of this run."""
        return RunState(
            network=self.network.state_dict(),
            ema=self.ema.state_dict(),
            optimizer=self.optimizer.state_dict(),
            step=self.step,
            history=self.history,
            best=self.best,
        )

    def best_network(self) -> LaneNet:
        """Return the network of the best epoch, ready for use."""
        if self.best is None:
            raise LanenetError("training ended without an epoch, expected at least one")
        network = LaneNet(self.settings.network, self.samples.window.rows, self.samples.window.columns)
        network.load_state_dict(self.best)
        return network.eval()


def _read_both(
    settings: LearnSettings, train_paths: Sequence[Path], val_paths: Sequence[Path]
) -> tuple[LaneSamples, LaneSamples]:
    train_sets = [read_labels(path) for path in train_paths]
    val_sets = [read_labels(path) for path in val_paths]
    for path, labels in zip(train_paths, train_sets, strict=True):
        if labels.meta.source != "map":
            raise LabelFormatError(
                f"{path}: labels from the {labels.meta.source}; a network learns from maps, "
                "the truth only scores it"
            )
    samples = LaneSamples(train_sets, [str(p) for p in train_paths], settings.min_quality)
    val = LaneSamples(val_sets, [str(p) for p in val_paths])
    check_same(train_sets[0].meta, val_sets[0].meta, str(train_paths[0]), str(val_paths[0]))
    return samples, val


@contextmanager
def _threads(threads: int) -> Iterator[None]:
    """Set torch's threads for a while; the setting belongs to the whole process."""
    before = torch.get_num_threads()
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
