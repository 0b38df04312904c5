"""Every n-th call that can fail fails in turn: n = 1, 2, 3 and so on, until the operation gets through.

SQLite tests itself in this way (https://www.sqlite.org/testing.html, "I/O error testing", "OOM testing").

    for failure in every_failure(lambda: write_map(out), [DISK, MEMORY]):
        ...  # the operation has failed once, at failure.call: look at what it raised and left behind
    assert failure.n > 20
"""

from __future__ import annotations

import builtins
import errno
import io
import os
import shutil
import stat
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import yaml

from lanenet import outputs
from lanenet.data import files
from lanenet.errors import LanenetError

#: No operation of a test has more points; a run that does not end has a bug.
_MOST = 2000


@dataclass
class Failure:
    """One failure that was made to happen.

    Attributes:
        n: Which call failed, from 1.
        call: What was called, with the name of its file where it has one; empty if the operation ended before
            its n-th call.
        error: What the operation raised; None if it went on.
    """

    n: int
    call: str = ""
    error: BaseException | None = None

    def reach(self, call: str) -> bool:
        """Count a call; tell whether it has to fail."""
        self.n -= 1
        if self.n != 0:
            return False
        self.call = call
        return True


#: Puts a patch into a stack; its calls ask the failure whether they have to fail.
Kind = Callable[[ExitStack, Failure], None]


def every_failure(operate: Callable[[], object], kinds: list[Kind]) -> Iterator[Failure]:
    """Run an operation again and again, each time with the next call failing.

    Args:
        operate: The operation; it may be called any number of times.
        kinds: Which calls fail.

    Yields:
        What failed and what it led to, once for each point. The caller looks at what is left; the next run
        begins from there.
    """
    for n in range(1, _MOST):
        failure = Failure(n)
        with failing(failure, kinds):
            try:
                operate()
            except Exception as error:
                failure.error = error
        if not failure.call:
            if failure.error is not None:
                raise AssertionError("failed, though no call did") from failure.error
            return
        failure.n = n
        yield failure
    raise AssertionError(f"still failing after {_MOST} points")


@contextmanager
def failing(failure: Failure, kinds: list[Kind]) -> Iterator[None]:
    """Let the calls of these kinds fail as the failure says."""
    with ExitStack() as stack:
        for kind in kinds:
            kind(stack, failure)
        yield


def full(path: object) -> OSError:
    """Return the error of a disk without room."""
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def broken(path: object) -> OSError:
    """Return the error of a disk that does not answer."""
    return OSError(errno.EIO, os.strerror(errno.EIO), str(path))


def DISK(stack: ExitStack, failure: Failure) -> None:
    """Writes, syncs, renames and new folders; a write that fails has written half."""

    def patched(module: Any, name: str, error: Callable[[object], OSError]) -> None:
        real = getattr(module, name)

        def call(first: Any, *rest: Any, **named: Any) -> Any:
            if failure.reach(f"{name} {_shown(first)}"):
                raise error(first)
            return real(first, *rest, **named)

        stack.enter_context(mock.patch.object(module, name, call))

    for name in ("replace", "rename", "mkdir"):
        patched(os, name, broken)
    patched(os, "fsync", lambda _: OSError(errno.EIO, os.strerror(errno.EIO)))
    patched(outputs, "exchange", broken)
    real_write, real_open = os.write, io.open

    def write(handle: int, data: bytes) -> int:
        # A pipe between two threads is no disk.
        if stat.S_ISFIFO(os.fstat(handle).st_mode):
            return real_write(handle, data)
        if failure.reach(f"write {_shown(handle)}"):
            real_write(handle, data[: len(data) // 2])
            raise full(handle)
        return real_write(handle, data)

    def open_(file: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
        if not set(mode) & set("wax+") or "opener" in named or isinstance(file, int):
            return real_open(file, mode, *rest, **named)
        raw = _File(file, mode.replace("b", "").replace("t", ""), failure)
        buffered = io.BufferedWriter(raw)
        text = {name: value for name, value in named.items() if name in ("encoding", "errors", "newline")}
        return buffered if "b" in mode else io.TextIOWrapper(buffered, **text)

    for module, name, call in ((os, "write", write), (io, "open", open_), (builtins, "open", open_)):
        stack.enter_context(mock.patch.object(module, name, call))
    for module, name, at in _writers():
        half = _half_written(getattr(module, name), at, failure)
        stack.enter_context(mock.patch.object(module, name, half))


def MEMORY(stack: ExitStack, failure: Failure) -> None:
    """Allocations: those of images, texts and tables that are about to be written."""
    sites: list[tuple[Any, str]] = [(cv2, "imencode"), (yaml, "safe_dump"), (files, "json_text")]
    arrow = _module("pyarrow")
    sites += [] if arrow is None else [(arrow, "table")]
    for module, name in sites:
        real = getattr(module, name)

        def call(*values: Any, _real: Any = real, _name: str = name, **named: Any) -> Any:
            if failure.reach(f"allocation in {_name}"):
                raise MemoryError
            return _real(*values, **named)

        stack.enter_context(mock.patch.object(module, name, call))


class _File(io.FileIO):
    """A file whose writes may fail; half of the data has arrived then."""

    def __init__(self, file: Any, mode: str, failure: Failure) -> None:
        super().__init__(file, mode)
        self._failure, self._broken = failure, False

    def write(self, data: Any) -> int:
        # A buffer writes again when it is closed: that fails, too, as on a full disk.
        if self._broken or self._failure.reach(f"write {_shown(self.name)}"):
            if not self._broken:
                super().write(bytes(data)[: len(data) // 2])
            self._broken = True
            raise full(self.name)
        return super().write(data) or 0


def _writers() -> list[tuple[Any, str, int]]:
    """Return the writers that are not Python's: module, name, and which argument is the path."""
    found: list[tuple[Any, str, int]] = [(shutil, "copyfile", 1)]
    parquet, torch = _module("pyarrow.parquet"), _module("torch")
    found += [] if parquet is None else [(parquet, "write_table", 1)]
    found += [] if torch is None else [(torch, "save", 1)]
    return found


def _module(name: str) -> Any:
    """Return a module that the operation uses, thus has been imported; None otherwise."""
    return sys.modules.get(name)


def _half_written(real: Callable[..., Any], at: int, failure: Failure) -> Callable[..., Any]:
    def call(*values: Any, **named: Any) -> Any:
        if not failure.reach(f"{real.__name__} {_shown(values[at])}"):
            return real(*values, **named)
        real(*values, **named)
        os.truncate(values[at], os.path.getsize(values[at]) // 2)
        if real.__module__.startswith("torch"):
            # As PyTorch 2 answers on a full disk.
            raise RuntimeError("[enforce fail at inline_container.cc:671] . unexpected pos 46 vs 0")
        raise full(values[at])

    return call


def _shown(file: object) -> str:
    if isinstance(file, int):
        try:
            file = os.readlink(f"/proc/self/fd/{file}")
        except OSError:
            return ""
    return Path(os.fsdecode(file)).name if isinstance(file, str | bytes | os.PathLike) else ""


def check_each(
    operate: Callable[[int], object], read: Callable[[], int], folder: Path, kinds: list[Kind]
) -> list[str]:
    """Replace an output again and again with each call failing in turn, and look at it after each failure.

    The error has to be a LanenetError that names a file in the folder, or a MemoryError, which the command
    line turns into one line. The output has to be readable and that of this run, if it ended well, or else of
    this or of the one before it. The last run has to end well and to leave nothing but the output.

    Args:
        operate: Writes the output, with a number in it.
        read: Reads the whole output, and returns the number.
        folder: Holds the output and nothing else.
        kinds: Which calls fail.

    Returns:
        The calls that failed, in their order.
    """
    number, calls = 0, []

    def run() -> None:
        nonlocal number
        number += 1
        operate(number)

    run()
    before, names = read(), visible(folder)
    for failure in every_failure(run, kinds):
        calls.append(failure.call)
        shown = f"{failure.n}: {failure.call}: {failure.error!r}"
        assert failure.error is None or isinstance(failure.error, LanenetError | MemoryError), shown
        assert not isinstance(failure.error, LanenetError) or str(folder) in str(failure.error), shown
        found = read()
        assert found == number or (failure.error is not None and found == before), f"{shown}: holds {found}"
        assert visible(folder) == names, shown
        before = found
    assert read() == number
    assert sorted(os.listdir(folder)) == names, "left-overs"
    return calls


def visible(folder: Path) -> list[str]:
    """List a folder without hidden names, which are those of locks and of what is not complete."""
    return sorted(name for name in os.listdir(folder) if not name.startswith("."))


def report(what: str, calls: list[str]) -> None:
    """Write how many points failed, by kind; ``pytest -rP`` shows it."""
    kinds = Counter(call.partition(" ")[0] for call in calls)
    sys.stdout.write(
        f"{what}: {len(calls)} points: {', '.join(f'{n} {kind}' for kind, n in kinds.items())}\n"
    )
