"""Train a network on label sets: one call from Parquet files to a checkpoint folder."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from lanenet.data.label_set import LabelMeta, read_labels
from lanenet.errors import CheckpointError, ConfigError, LabelFormatError, LanenetError
from lanenet.learn.checkpoint import (
    STATE_NAME,
    EpochRecord,
    RunState,
    best_record,
    choose_stream,
    hash_run,
    load_start_weights,
    read_finished,
    read_state,
    tensorboard_curve,
    write_checkpoint,
    write_state,
)
from lanenet.learn.config import LearnSettings
from lanenet.learn.loss import Known, count_known, lane_loss
from lanenet.learn.network import LaneNet, input_of_rasters, new_network
from lanenet.learn.parallel import ALONE, Processes, let_go, start_processes
from lanenet.learn.predict import calibrate_presence, calibrate_sigma, judge
from lanenet.learn.shared_layers import share_layers
from lanenet.outputs import lock_output, make_folder
from lanenet.perception.network.model_file import MODEL_NAME
from lanenet.reading import MEBIBYTE
from lanenet.samples.augment import Batch
from lanenet.samples.dataset import LaneSamples, Samples, check_same
from lanenet.samples.shards import Shards, StreamedSamples

#: Called after each epoch: epoch (from 1), epochs, training RMSE, validation RMSE, [cm], samples per second.
Progress = Callable[[int, int, float, float, float], None]

#: Key of a parameter group: its learning rate is this many times that of the others.
_FACTOR = "rate_factor"


@dataclass(frozen=True)
class TrainResult:
    """A finished run.

    Attributes:
        folder: The checkpoint folder.
        model_path: Its ONNX file.
        best_epoch: Epoch of the exported weights, from 1.
        val_rmse_cm: Their RMSE over all labelled points of the validation frames.
        computed: False if the folder already held this run.
    """

    folder: Path
    model_path: Path
    best_epoch: int
    val_rmse_cm: float
    computed: bool


@dataclass(frozen=True)
class _Job:
    """What the processes of a training are told."""

    settings: LearnSettings
    train_paths: tuple[Path, ...]
    val_paths: tuple[Path, ...]
    out: Path
    run_hash: str
    set_weights: tuple[float, ...] = ()


def train(
    settings: LearnSettings,
    train_paths: Sequence[Path],
    val_paths: Sequence[Path],
    out: Path,
    progress: Progress | None = None,
    set_weights: Sequence[float] = (),
) -> TrainResult:
    """Train, evaluate and export a network.

    A run that was stopped resumes after its last written epoch and ends with the same weights, bit for bit on
    the same machine and number of threads and processes. A finished run with the same settings and data is
    not repeated.

    Args:
        settings: How to train.
        train_paths: Label sets to learn from.
        val_paths: Label sets that choose the best epoch; other drives, or other laps.
        out: Checkpoint folder.
        progress: Called after each epoch.
        set_weights: How often each set to learn from is shown beside the others; none weighs all alike.

    Returns:
        The checkpoint folder and the error of its model.

    Raises:
        LabelFormatError: If the label sets cannot be read or learned together.
        CheckpointError: If the folder holds a run with other settings or data, or pretrained weights cannot
            be read.
        ConfigError: If a GPU is set and there is none, or not one for each process.
        LanenetError: If the training diverges, another run trains into the folder, or one of several
            processes ends before its time.
    """
    with lock_output(out):
        run_hash = hash_run(settings, train_paths, val_paths, set_weights)
        metrics = read_finished(out, run_hash)
        if metrics is not None:
            let_go()
            return TrainResult(out, out / MODEL_NAME, metrics["best_epoch"], metrics["val_rmse_cm"], False)
        uses_gpu = _device(settings).type == "cuda"
        train_paths, val_paths = (tuple(p.absolute() for p in paths) for paths in (train_paths, val_paths))
        job = _Job(settings, train_paths, val_paths, out.absolute(), run_hash, tuple(set_weights))
        with start_processes(settings.processes, uses_gpu, _take_part, job) as processes:
            return _train(job, out, processes, progress)


def _train(job: _Job, out: Path, processes: Processes, progress: Progress | None) -> TrainResult:
    """Do the first process's share: train, judge and write."""
    settings, run_hash = job.settings, job.run_hash
    with torch_threads(settings.threads):
        run, val = _open_run(job, processes)
        samples = run.samples
        make_folder(out)
        with tensorboard_curve(out, len(run.history) + 1, settings.tensorboard) as show:
            while not run.ended:
                record = run.run_epoch(val)
                if record.epoch % settings.checkpoint_every == 0 or run.ended:
                    write_state(out / STATE_NAME, run.state(), run_hash)
                show(record)
                if progress is not None:
                    errors_cm = record.train_rmse_cm, record.val_rmse_cm
                    progress(record.epoch, settings.epochs, *errors_cm, record.samples_per_s)
        network = run.best_network()
        calibrate_sigma(network, val)
        calibrate_presence(network, val)
        rmse_cm = write_checkpoint(out, settings, network, samples, val, run.history, run_hash)
    return TrainResult(out, out / MODEL_NAME, best_record(run.history).epoch, rmse_cm, True)


def _take_part(job: _Job, processes: Processes) -> None:
    """Do the share of a process that is not the first: its parts of the batches."""
    with torch_threads(job.settings.threads):
        run, val = _open_run(job, processes)
        while not run.ended:
            run.run_epoch(val)


def _open_run(job: _Job, processes: Processes) -> tuple[TrainingRun, Samples]:
    """Return a run at its beginning, or where it was stopped; and the validation samples."""
    saved = read_state(job.out / STATE_NAME, job.run_hash)
    samples, val = _read_both(job)
    return TrainingRun(job.settings, samples, saved, processes), val


class StepSums(NamedTuple):
    """What a step says of its batch: sums over all of its samples, as they were before the step.

    Attributes:
        squares: Of the errors of the points, [cm^2].
        known: How many labels are known.
        samples: How many there are.
    """

    squares: float
    known: Known
    samples: int


class TrainingRun:
    """Weights, optimiser and curve of a run.

    Several processes have a run each, with the same weights: all but the samples of its part of each batch,
    and the judgement, which the first one makes, is the same in all of them.

    Attributes:
        network: What is trained.
        history: One record per finished epoch.
    """

    def __init__(
        self,
        settings: LearnSettings,
        samples: Samples,
        saved: RunState | None = None,
        processes: Processes = ALONE,
    ) -> None:
        self.settings, self.samples, self.processes = settings, samples, processes
        self.device, window = _device(settings), samples.window
        self.network = new_network(settings.network, window.rows, window.columns, settings.seed)
        self.network.to(self.device)
        mean, scale = samples.normalisation(settings.augment.mirror > 0.0)
        self.network.mean_cm.copy_(torch.from_numpy(mean))
        self.network.scale_cm.copy_(torch.from_numpy(scale))
        self.network.spread_bins(window.left_cm, window.right_cm)
        if settings.start_from is not None:
            load_start_weights(self.network, settings.start_from, window, samples.perception)
        share_layers(self.network, processes)
        self.optimizer = new_optimizer(self.network, settings)
        self.step = 0
        self.history: list[EpochRecord] = []
        self.best: dict[str, Tensor] | None = None
        self.total = max(1, settings.epochs * samples.steps_per_epoch(settings.batch_size))
        self.mean = running_mean(self.network, settings.ema_decay)
        if saved is not None:
            self.network.load_state_dict(saved.network)
            self.averaged.load_state_dict(saved.ema)
            self.mean.n_averaged.fill_(saved.step + 1)
            self.optimizer.load_state_dict(saved.optimizer)
            self.step, self.history, self.best = saved.step, list(saved.history), saved.best
        if (first := processes.share(self.step)) != self.step:
            raise CheckpointError(
                f"{STATE_NAME}: found after {self.step} steps, but by the first process after {first}; "
                "expected a folder that all processes share"
            )

    @property
    def averaged(self) -> LaneNet:
        """The running mean of the weights."""
        network = self.mean.module
        assert isinstance(network, LaneNet)
        return network

    @property
    def ended(self) -> bool:
        """True after the last epoch, and when the validation error has not fallen for too long."""
        done, patience = len(self.history), self.settings.patience
        if done >= self.settings.epochs:
            return True
        return 0 < patience <= done and done - best_record(self.history).epoch >= patience

    def run_epoch(self, val: Samples) -> EpochRecord:
        """Train one epoch and evaluate it."""
        settings, epoch = self.settings, len(self.history)
        started = time.perf_counter()
        squares, count, n_samples, rate = 0.0, 0, 0, 0.0
        self.network.train()
        batches = self.samples.epoch(
            settings.augment,
            settings.seed,
            epoch,
            settings.batch_size,
            balance=settings.balance,
            cut=self.processes.cut,
        )
        # Torch's own draws (dropout) follow from seed and epoch; its global generators stay untouched.
        with torch.random.fork_rng([torch.cuda.current_device()] if self.device.type == "cuda" else []):
            torch.manual_seed(int(np.random.SeedSequence([settings.seed, epoch]).generate_state(1)[0]))
            for batch in batches:
                rate = learning_rate_at(self.step, self.total, settings)
                sums = self.learn_from(batch, rate)
                squares += sums.squares
                count += sums.known.points
                n_samples += sums.samples
                if not math.isfinite(squares):
                    raise LanenetError(
                        f"training diverged in epoch {epoch + 1}: the error is not finite; lower "
                        f"learning_rate (now {settings.learning_rate:g})"
                    )
        seconds = time.perf_counter() - started
        val_rmse_cm, val_trimmed_cm = self.processes.share(
            judge(self.averaged, val) if self.processes.first else (math.nan, math.nan)
        )
        record = EpochRecord(
            epoch=epoch + 1,
            train_rmse_cm=math.sqrt(squares / max(count, 1)),
            val_rmse_cm=val_rmse_cm,
            learning_rate=rate,
            samples_per_s=n_samples / seconds,
            val_trimmed_cm=val_trimmed_cm,
        )
        self.history.append(record)
        if best_record(self.history) is record:
            self.best = {name: value.clone() for name, value in self.averaged.state_dict().items()}
        return record

    def learn_from(self, batch: Batch, rate: float) -> StepSums:
        """Take one step at a learning rate, with the process's own part of a batch."""
        set_learning_rate(self.optimizer, rate)
        rasters, targets, present, lane_cm = (torch.from_numpy(part).to(self.device) for part in batch)
        output = self.network(input_of_rasters(rasters), lane_cm)
        self.optimizer.zero_grad(set_to_none=True)
        sums = self._sum_up(output.points_cm.detach(), targets, present)
        loss = lane_loss(output, targets, present, self.settings.loss, sums.known)
        loss.backward()  # type: ignore[no-untyped-call]
        self.processes.sum_gradients(self.network)
        self.optimizer.step()
        self.step += 1
        self.mean.update_parameters(self.network)
        return sums

    def _sum_up(self, points_cm: Tensor, targets: Tensor, present: Tensor) -> StepSums:
        """Add up what all processes have of a batch."""
        error = (points_cm - targets)[torch.isfinite(targets)]
        own = [float((error * error).sum()), *count_known(targets, present), len(targets)]
        # In double precision, which holds counts exactly.
        squares, *counts = self.processes.sum(torch.tensor(own, dtype=torch.float64)).tolist()
        n_points, n_lines, n_samples = map(int, counts)
        return StepSums(squares, Known(n_points, n_lines), n_samples)

    def state(self) -> RunState:
        """Return what :class:`RunState` keeps of this run."""
        return RunState(
            network=self.network.state_dict(),
            ema=self.averaged.state_dict(),
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


def new_optimizer(network: LaneNet, settings: LearnSettings) -> torch.optim.Optimizer:
    """Return AdamW over a network's weights; biases and norms do not decay.

    A new head on a pretrained trunk learns ``head_rate`` times as fast as the rest, as in the paper.
    """
    head_factor = settings.head_rate if network.trunk.head_learns_faster else 1.0
    groups = []
    # All children, so that every part of a network learns.
    for part in network.children():
        factor = head_factor if part is network.head else 1.0
        for decays in (True, False):
            chosen = [p for p in part.parameters() if (p.ndim > 1) == decays]
            decay = settings.weight_decay if decays else 0.0
            if chosen:
                groups.append({"params": chosen, "weight_decay": decay, _FACTOR: factor})
    return torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True)


def learning_rate_at(step: int, total: int, settings: LearnSettings) -> float:
    """Return the learning rate of a step (from 0): a straight rise, then a cosine down to zero."""
    rise = settings.warmup * total
    if step < rise:
        return settings.learning_rate * (step + 1) / (rise + 1)
    share = (step - rise) / max(total - rise, 1.0)
    return settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate; a group of parameters may have a multiple of it."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group[_FACTOR]


def running_mean(network: LaneNet, decay: float) -> AveragedModel:
    """Return a copy of a network at the running mean of its weights; a step keeps ``decay`` of the mean.

    Less is kept at first, so that the first epochs are not judged by their random beginning.
    """

    def move(means: Sequence[Tensor], values: Sequence[Tensor], step: Tensor | int) -> None:
        if means[0].is_floating_point():
            now = min(decay, (1.0 + int(step)) / (10.0 + int(step)))
            torch._foreach_lerp_(list(means), list(values), 1.0 - now)
        else:
            torch._foreach_copy_(list(means), list(values))

    mean = AveragedModel(network, multi_avg_fn=move, use_buffers=True)
    # The first step counts as 1: otherwise it would replace the mean.
    mean.n_averaged.fill_(1)
    return mean


def _read_both(job: _Job) -> tuple[Samples, Samples]:
    """Read training and validation samples, or what streams of them need if they do not fit into memory."""
    settings, train_paths, val_paths = job.settings, job.train_paths, job.val_paths
    shards = choose_stream(settings, train_paths, val_paths)
    if shards is not None:
        return _open_streams(settings, *shards, job.set_weights)
    train_sets = [read_labels(path) for path in train_paths]
    val_sets = [read_labels(path) for path in val_paths]
    _refuse_truth(train_paths, [labels.meta for labels in train_sets])
    names = [str(path) for path in train_paths]
    samples = LaneSamples(train_sets, names, settings.min_quality, job.set_weights)
    val = LaneSamples(val_sets, [str(p) for p in val_paths])
    check_same(train_sets[0].meta, val_sets[0].meta, str(train_paths[0]), str(val_paths[0]))
    return samples, val


def _open_streams(
    settings: LearnSettings, train: Shards, val: Shards, set_weights: Sequence[float]
) -> tuple[Samples, Samples]:
    """Open training samples as a stream, and validation samples too if a quarter of memory is too little."""
    _refuse_truth(train.paths, [index.meta for index in train.indices])
    memory = settings.memory_mb * MEBIBYTE
    if val.unpacked_bytes <= memory // 4:
        val_sets = [read_labels(path) for path in val.paths]
        chosen: Samples = LaneSamples(val_sets, [str(path) for path in val.paths])
        memory -= memory // 4
    else:
        # Not beside the training's windows: its epoch is over when the validation begins.
        chosen = StreamedSamples(val, memory)
    samples = StreamedSamples(train, memory, settings.min_quality, set_weights)
    check_same(train.indices[0].meta, val.indices[0].meta, str(train.paths[0]), str(val.paths[0]))
    return samples, chosen


def _refuse_truth(paths: Sequence[Path], metas: Sequence[LabelMeta]) -> None:
    for path, meta in zip(paths, metas, strict=True):
        if meta.source != "map":
            raise LabelFormatError(
                f"{path}: labels from the {meta.source}; a network learns from maps, the truth only scores it"
            )


def _device(settings: LearnSettings) -> torch.device:
    found = torch.cuda.is_available()
    if settings.device == "cuda" and not found:
        raise ConfigError("device: cuda, but PyTorch finds no GPU; expected cpu or auto")
    return torch.device("cuda" if found and settings.device != "cpu" else "cpu")


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set torch's number of threads for a while; the setting belongs to the whole process."""
    before = torch.get_num_threads()
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
