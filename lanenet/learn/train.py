"""Train a network on label sets: one call from Parquet files to a checkpoint folder.

What is set right after the training, on frames that the network did not learn from: doubt and presence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lanenet.data.label_set import read_labels
from lanenet.errors import ConfigError, LabelFormatError, LanenetError
from lanenet.learn.checkpoint import tensorboard_curve, write_checkpoint
from lanenet.learn.config import LearnSettings
from lanenet.learn.loss import lane_loss, sigma_factors
from lanenet.learn.network import LaneNet, input_of_rasters, new_network
from lanenet.learn.optimiser import RunningMean, learning_rate_at, new_optimizer, set_learning_rate
from lanenet.learn.predict import answer_rasters, predict, trimmed_rmse_cm
from lanenet.learn.run_state import (
    STATE_NAME,
    EpochRecord,
    RunState,
    best_record,
    hash_run,
    load_start_weights,
    read_finished,
    read_state,
    write_state,
)
from lanenet.perception.network.model_file import MODEL_NAME
from lanenet.samples.augment import Batch
from lanenet.samples.dataset import LaneSamples, check_same
from lanenet.samples.settings import AugmentSettings

#: Share of the missing lines that are to be called absent, with a margin to the 95 % that are asked for.
_ABSENT_FOUND = 0.96
#: A network that needs more has not learned to tell lines, and would call most of them absent.
_MOST_SHIFT = 2.0


def calibrate_sigma(network: LaneNet, val: LaneSamples) -> None:
    """Scale a network's spread so that 68 % of its errors on frames it did not learn from lie within it."""
    answers = predict(network, val)
    factors = sigma_factors(answers.points_cm - answers.truth_cm, answers.sigma_cm)
    network.sigma_factor *= torch.from_numpy(factors).to(network.sigma_factor)


def calibrate_presence(network: LaneNet, val: LaneSamples) -> None:
    """Shift what a network says of lines so that it calls those absent that are.

    How often lines are missing in the training is no more than a setting, and with it where a probability of
    one half lies. It is put where 96 % of the lines that are taken out of frames it did not learn from are
    called absent, if it does not lie there already.
    """
    gone = AugmentSettings.only(missing_line=0.8, missing_both=0.2)
    batch = val.augmented_batch(np.arange(len(val)), gone, seed=0, epoch=0)
    odds = answer_rasters(network, batch.rasters, batch.lane_cm).presence_logit.double().cpu().numpy()
    absent = odds[batch.present == 0.0]
    if absent.size:
        network.lower_presence(min(max(float(np.quantile(absent, _ABSENT_FOUND)), 0.0), _MOST_SHIFT))


#: Called after each epoch: epoch (from 1), epochs, training RMSE, validation RMSE, [cm], samples per second.
Progress = Callable[[int, int, float, float, float], None]


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
        CheckpointError: If the folder holds a run with other settings or data, or pretrained weights cannot
            be read.
        ConfigError: If a GPU is asked for and there is none.
        LanenetError: If the training diverges.
    """
    run_hash = hash_run(settings, train_paths, val_paths)
    metrics = read_finished(out, run_hash)
    if metrics is not None:
        return TrainResult(out, out / MODEL_NAME, metrics["best_epoch"], metrics["val_rmse_cm"], False)
    saved = read_state(out / STATE_NAME, run_hash)
    samples, val = _read_both(settings, train_paths, val_paths)
    out.mkdir(parents=True, exist_ok=True)
    with torch_threads(settings.threads):
        run = TrainingRun(settings, samples, saved)
        with tensorboard_curve(out, len(run.history) + 1, settings.tensorboard) as show:
            while not run.ended:
                record = run.run_epoch(val)
                if record.epoch % settings.checkpoint_every == 0 or run.ended:
                    write_state(out / STATE_NAME, run.state(), run_hash)
                show(record)
                if progress is not None:
                    progress(
                        record.epoch,
                        settings.epochs,
                        record.train_rmse_cm,
                        record.val_rmse_cm,
                        record.samples_per_s,
                    )
        network = run.best_network()
        calibrate_sigma(network, val)
        calibrate_presence(network, val)
        answers = predict(network, val)
        best = best_record(run.history)
        write_checkpoint(out, settings, network, samples, val, answers, run.history, run_hash)
    return TrainResult(out, out / MODEL_NAME, best.epoch, answers.errors.all.rmse_cm, True)


class TrainingRun:
    """Weights, optimiser and curve of a run in memory.

    Attributes:
        network: What is trained.
        history: One record per finished epoch.
    """

    def __init__(self, settings: LearnSettings, samples: LaneSamples, saved: RunState | None = None) -> None:
        self.settings, self.samples = settings, samples
        self.device = _device(settings)
        self.network = self._new_network()
        mean, scale = samples.normalisation(settings.augment.mirror > 0.0)
        self.network.mean_cm.copy_(torch.from_numpy(mean))
        self.network.scale_cm.copy_(torch.from_numpy(scale))
        self.network.spread_bins(samples.window.left_cm, samples.window.right_cm)
        if settings.start_from is not None:
            load_start_weights(self.network, settings.start_from, samples.window, samples.perception)
        self.optimizer = new_optimizer(self.network, settings)
        self.step = 0
        self.history: list[EpochRecord] = []
        self.best: dict[str, Tensor] | None = None
        self.total = max(1, settings.epochs * samples.steps_per_epoch(settings.batch_size))
        self.mean = RunningMean(self._new_network(), self.network, settings.ema_decay)
        if saved is not None:
            self.network.load_state_dict(saved.network)
            self.mean.network.load_state_dict(saved.ema)
            self.optimizer.load_state_dict(saved.optimizer)
            self.step, self.history, self.best = saved.step, list(saved.history), saved.best

    def _new_network(self) -> LaneNet:
        window, settings = self.samples.window, self.settings
        return new_network(settings.network, window.rows, window.columns, settings.seed).to(self.device)

    @property
    def ended(self) -> bool:
        """True after the last epoch, and once the validation error has long not sunk."""
        done, patience = len(self.history), self.settings.patience
        if done >= self.settings.epochs:
            return True
        return 0 < patience <= done and done - best_record(self.history).epoch >= patience

    def run_epoch(self, val: LaneSamples) -> EpochRecord:
        """Train one epoch and evaluate it."""
        settings, epoch = self.settings, len(self.history)
        started = time.perf_counter()
        squares, count, n_samples, rate = 0.0, 0, 0, 0.0
        self.network.train()
        batches = self.samples.epoch(
            settings.augment, settings.seed, epoch, settings.batch_size, balance=settings.balance
        )
        with _random_numbers(settings.seed, epoch, self.device):
            for batch in batches:
                rate = learning_rate_at(self.step, self.total, settings)
                targets = torch.from_numpy(batch.points_cm).to(self.device)
                points = self.learn_from(batch, targets, rate)
                error = (points - targets)[torch.isfinite(targets)]
                squares += float((error * error).sum())
                count += error.numel()
                n_samples += len(targets)
                if not math.isfinite(squares):
                    raise LanenetError(
                        f"training diverged in epoch {epoch + 1}: the error is not finite; lower "
                        f"learning_rate (now {settings.learning_rate:g})"
                    )
        seconds = time.perf_counter() - started
        answers = predict(self.mean.network, val)
        record = EpochRecord(
            epoch=epoch + 1,
            train_rmse_cm=math.sqrt(squares / max(count, 1)),
            val_rmse_cm=answers.errors.all.rmse_cm,
            learning_rate=rate,
            samples_per_s=n_samples / seconds,
            val_trimmed_cm=trimmed_rmse_cm(answers.points_cm - answers.truth_cm),
        )
        self.history.append(record)
        if best_record(self.history) is record:
            self.best = {name: value.clone() for name, value in self.mean.network.state_dict().items()}
        return record

    def learn_from(self, batch: Batch, targets: Tensor, rate: float) -> Tensor:
        """Take one step at a learning rate; answers the points that it started from."""
        set_learning_rate(self.optimizer, rate)
        rasters, present, lane_cm = (
            torch.from_numpy(part).to(self.device) for part in (batch.rasters, batch.present, batch.lane_cm)
        )
        output = self.network(input_of_rasters(rasters), lane_cm)
        self.optimizer.zero_grad(set_to_none=True)
        loss = lane_loss(output, targets, present, self.settings.loss)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        self.step += 1
        self.mean.update(self.step)
        points: Tensor = output.points_cm.detach()
        return points

    def state(self) -> RunState:
        """Return what :class:`RunState` keeps of this run."""
        return RunState(
            network=self.network.state_dict(),
            ema=self.mean.network.state_dict(),
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


def _device(settings: LearnSettings) -> torch.device:
    found = torch.cuda.is_available()
    if settings.device == "cuda" and not found:
        raise ConfigError("device: cuda, but PyTorch finds no GPU here; expected cpu or auto")
    return torch.device("cuda" if found and settings.device != "cpu" else "cpu")


@contextmanager
def _random_numbers(seed: int, epoch: int, device: torch.device) -> Iterator[None]:
    """Let torch's own draws (dropout) follow from the seed and the epoch, and leave its generators alone."""
    with torch.random.fork_rng(devices=[torch.cuda.current_device()] if device.type == "cuda" else []):
        torch.manual_seed(int(np.random.SeedSequence([seed, epoch]).generate_state(1)[0]))
        yield


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set torch's threads for a while; the setting belongs to the whole process."""
    before = torch.get_num_threads()
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
