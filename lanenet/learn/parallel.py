"""Several processes that share a training: how they start, find each other, add up, and end together.

The first process does all that a lone one does. The others take part in its steps alone: each draws its own
part of every batch, and sums over the processes make the step that one process would have taken. They are
started here (``learn.processes``), or by ``torchrun``, which may also start them on several machines.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed import PrefixStore, Store, TCPStore  # type: ignore[attr-defined]

from lanenet.errors import ConfigError, LanenetError, counted
from lanenet.processes import one_thread_each, prepare_process
from lanenet.samples.dataset import Cut

JobT = TypeVar("JobT")
ValueT = TypeVar("ValueT")

_HERE = "127.0.0.1"
#: How long processes wait for each other. Chosen: under torchrun the others wait while the first one maps all
#: drives. A process that ends is noticed at once, since its connections close.
_PATIENCE = timedelta(days=7)
#: How often the first process looks whether all others have started. Chosen: their imports take seconds.
_LOOK_EVERY_S = 0.02
#: How long a process may take to end, [s]. Chosen.
_END_WITHIN_S = 10.0


class LostProcessError(LanenetError):
    """Another process of the training has ended before its time."""


@dataclass(frozen=True)
class Processes:
    """The processes that share a training, as one of them sees them.

    All of them call the same methods in the same order. Alone, each method returns what it was given.

    Attributes:
        rank: Its number, from 0.
        size: How many there are.
    """

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """True for the one that judges, tells and writes."""
        return self.rank == 0

    @property
    def cut(self) -> Cut:
        """The part of each batch that the process draws."""
        return Cut(self.size, self.rank)

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of a tensor over the processes; the same bits in each of them."""
        if self.size > 1:
            with _noticing():
                dist.all_reduce(values)
        return values

    def sum_gradients(self, network: nn.Module) -> None:
        """Replace the gradients of a network by their sum over the processes."""
        if self.size == 1:
            return
        # In one piece: a message costs more than its bytes.
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        total = self.sum(torch.cat([gradient.reshape(-1) for gradient in gradients]))
        parts = torch.split(total, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def share(self, value: ValueT) -> ValueT:
        """Return what the first process gives, whatever the others do."""
        if self.size == 1:
            return value
        values = [value]
        with _noticing():
            dist.broadcast_object_list(values, src=0)
        return values[0]

    def place(self, count: int) -> tuple[int, int]:
        """Return how many rows the processes before this one have, and how many all have.

        Args:
            count: Of this process.
        """
        counts = torch.zeros(self.size, dtype=torch.int64)
        counts[self.rank] = count
        counts = self.sum(counts)
        return int(counts[: self.rank].sum()), int(counts.sum())


ALONE = Processes()


def follows() -> bool:
    """Tell whether ``torchrun`` started this process beside the first one."""
    return _by_torchrun() and int(os.environ["RANK"]) > 0


def follow() -> None:
    """Take part in the training of the first process under ``torchrun``, once it comes to that.

    Raises:
        LanenetError: If the training fails here, or another process has ended.
    """
    with _joined_by_torchrun() as processes:
        _take_part(processes)


def let_go() -> None:
    """Under ``torchrun``, let the other processes end: there is nothing to train."""
    if _by_torchrun():
        with _joined_by_torchrun() as processes:
            processes.share(None)


@contextmanager
def start_processes(
    count: int, uses_gpu: bool, work: Callable[[JobT, Processes], object], job: JobT
) -> Iterator[Processes]:
    """Let other processes do a job together with the block, which is the first process's share of it.

    Args:
        count: Processes, this one included; under ``torchrun`` they are those that it started.
        uses_gpu: Whether they add up on GPUs, of which each process has its own.
        work: What the others do; a function of a module, since it is sent to them.
        job: What they do it with.

    Yields:
        The processes, as this one sees them.

    Raises:
        ConfigError: If there are fewer GPUs than processes.
        LanenetError: If a process ends before its time; names it and how it ended.
    """
    if _by_torchrun():
        with _joined_by_torchrun() as processes:
            processes.share((work, job))
            yield processes
    elif count == 1:
        yield ALONE
    else:
        with _started_here(count, uses_gpu) as processes:
            processes.share((work, job))
            yield processes


@contextmanager
def _started_here(count: int, uses_gpu: bool) -> Iterator[Processes]:
    """Start processes on this machine; they end with the block."""
    _check_gpus(count, uses_gpu)
    store = TCPStore(_HERE, 0, is_master=True, wait_for_workers=False, timeout=_PATIENCE)
    # Spawned, because forking a process that has started torch's threads can hang.
    context = multiprocessing.get_context("spawn")
    others: list[BaseProcess] = []
    try:
        with one_thread_each():
            for rank in range(1, count):
                others.append(
                    context.Process(target=_run_other, args=(rank, count, store.port, uses_gpu), daemon=True)
                )
                others[-1].start()
        try:
            _await_others(store, others)
            with _joined(store, 0, count, uses_gpu, local_rank=0) as processes:
                yield processes
        except LostProcessError:
            raise _lost(others) from None
        for other in others:
            other.join(_END_WITHIN_S)
    finally:
        for other in others:
            _end(other)


def _run_other(rank: int, size: int, port: int, uses_gpu: bool) -> None:
    """Be one of the processes that :func:`_started_here` starts."""
    prepare_process()
    try:
        store = TCPStore(_HERE, port, is_master=False, timeout=_PATIENCE)
        store.set(_name(rank), "started")
        with _joined(store, rank, size, uses_gpu, local_rank=rank) as processes:
            _take_part(processes)
    except LostProcessError:
        # The first process says what happened, or is gone itself.
        sys.exit(1)
    except LanenetError as error:
        sys.stderr.write(f"error: process {rank + 1} of {size}: {error}\n")
        sys.exit(1)


def _take_part(processes: Processes) -> None:
    """Do what the first process tells."""
    nothing: Any = None
    told = processes.share(nothing)
    if told is not None:
        work, job = told
        work(job, processes)


def _await_others(store: TCPStore, others: Sequence[BaseProcess]) -> None:
    """Wait until all have started; afterwards, closed connections tell of those that end."""
    for rank, other in enumerate(others, start=1):
        while not store.check([_name(rank)]):
            if not other.is_alive():
                raise LostProcessError(f"process {rank + 1} did not start")
            time.sleep(_LOOK_EVERY_S)


@contextmanager
def _joined_by_torchrun() -> Iterator[Processes]:
    rank, size, local_rank, local_size = (
        int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    )
    uses_gpu = torch.cuda.is_available() and torch.cuda.device_count() >= local_size
    try:
        store = None
        if _torchrun_keeps_a_store():
            if local_size != size:
                raise ConfigError(
                    "torchrun on several machines keeps the addresses of processes that have ended, and may "
                    "wait for one of them after a restart: set TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1 on all"
                )
            store = _store_of_this_start()
        with _joined(store, rank, size, uses_gpu, local_rank) as processes:
            yield processes
    except LostProcessError:
        raise LostProcessError(
            f"process {rank + 1} of {size}: another process of the training has ended; what is finished is "
            "kept: run the command again, or give torchrun --max-restarts"
        ) from None


def _store_of_this_start() -> Store:
    """Return a store that processes of an earlier start did not write to.

    torchrun keeps one store for all starts, where a process that is started again may find the address of
    one that has ended. On one machine; on several, their counts of starts may differ.
    """
    with _noticing():
        store = TCPStore(
            os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"]), is_master=False, timeout=_PATIENCE
        )
    return PrefixStore(f"start {os.environ['TORCHELASTIC_RESTART_COUNT']}", store)


@contextmanager
def _joined(
    store: Store | None, rank: int, size: int, uses_gpu: bool, local_rank: int
) -> Iterator[Processes]:
    """Join the group of the processes; without a store the environment says how they find each other."""
    if uses_gpu:
        torch.cuda.set_device(local_rank)
    with _noticing():
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if uses_gpu else "gloo",
            store=store,
            rank=rank,
            world_size=size,
            timeout=_PATIENCE,
        )
    try:
        yield Processes(rank, size)
    finally:
        with suppress(RuntimeError):
            dist.destroy_process_group()


@contextmanager
def _noticing() -> Iterator[None]:
    """Tell of a process that is gone, which torch tells of in errors of its connections."""
    try:
        yield
    except RuntimeError as error:
        raise LostProcessError(
            f"another process of the training does not answer ({str(error).splitlines()[0]})"
        ) from error


def _lost(others: Sequence[BaseProcess]) -> LostProcessError:
    """Say which process ended first, and how: the others end with code 1 when they notice."""
    for other in others:
        other.join(_END_WITHIN_S)
    codes = [other.exitcode or 0 for other in others]
    rank = 1 + codes.index(min(codes) if min(codes) < 0 else max(codes))
    code = codes[rank - 1]
    how = (
        f"was killed (signal {-code}), most often because memory ran out"
        if code < 0
        else f"ended with code {code}"
    )
    return LostProcessError(
        f"process {rank + 1} of {len(others) + 1} of the training {how}; what is finished is kept: run the "
        "command again, with fewer learn.processes if memory is short"
    )


def _end(process: BaseProcess) -> None:
    if process.is_alive():
        process.terminate()
        process.join(_END_WITHIN_S)
    if process.is_alive():
        process.kill()
        process.join()


def _check_gpus(count: int, uses_gpu: bool) -> None:
    found = torch.cuda.device_count() if uses_gpu else count
    if found < count:
        raise ConfigError(
            f"learn.processes: {count}, but PyTorch finds {counted(found, 'GPU')}; expected one each, or "
            "learn.device cpu"
        )


def _torchrun_keeps_a_store() -> bool:
    return os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"


def _by_torchrun() -> bool:
    return dist.is_torchelastic_launched() and int(os.environ.get("WORLD_SIZE", "1")) > 1


def _name(rank: int) -> str:
    return f"process {rank}"
