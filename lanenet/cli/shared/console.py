"""What the command line shows: progress, tables, warnings, and the next command.

All of it goes through :func:`say`, :func:`show_rich` or :func:`_write_stderr`: names from files may hold what
a terminal, or Rich, takes for a command.
"""

from __future__ import annotations

import io
import logging
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from lanenet.errors import printable

#: Reports progress: ``(done, total)``, or ``(stage, done, total)`` where work has stages.
ProgressCall = Callable[..., None]


#: A log file gets one line per stage this often, and one at the stage's end; chosen: three a minute.
_LOG_EVERY_S = 20.0
#: Columns of a log file; chosen.
_LOG_WIDTH = 100
#: Where :func:`log_file` writes.
_log_path: ContextVar[Path | None] = ContextVar("_log_path", default=None)


@contextmanager
def log_file(path: Path) -> Iterator[None]:
    """Also write what is shown in the block into a file, with the time, after what it holds already.

    Args:
        path: In a folder that exists; a file that cannot be written is done without.
    """
    token = _log_path.set(path)
    try:
        yield
    except Exception as error:
        _log(f"error: {error}")
        raise
    except KeyboardInterrupt:
        _log("interrupted")
        raise
    finally:
        _log_path.reset(token)


def _log(text: str) -> None:
    path = _log_path.get()
    if path is not None:
        now = time.strftime("%Y-%m-%d %H:%M:%S")
        with suppress(OSError), path.open("a", encoding="utf-8") as file:
            file.writelines(f"{now} {printable(line)}\n" for line in text.splitlines())


@dataclass
class _Pass:
    """One pass of a stage over what it has to do; a stage may pass over its frames several times."""

    number: int
    began_s: float
    first: int
    done: int
    total: int


class _LineLog:
    """Lines of progress now and then, with what is left of the pass at its speed so far."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._due_s: dict[str, float] = {}
        self._passes: dict[str, _Pass] = {}

    def show(self, key: str, text: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        at = self._passes.get(key)
        if at is None or at.total != total or done < at.done:
            at = self._passes[key] = _Pass(1 if at is None else at.number + 1, now_s, done, done, total)
        at.done = done
        if done == total or now_s >= self._due_s.get(key, 0.0):
            self._due_s[key] = now_s + _LOG_EVERY_S
            which = f", pass {at.number}" if at.number > 1 else ""
            left = ""
            if at.first < done < total:
                left_s = (now_s - at.began_s) * (total - done) / (done - at.first)
                left = f", about {duration(left_s)} left{' of it' if which else ''}"
            self._write(f"{text}{which}: {done} of {total}{left}")


def duration(seconds: float) -> str:
    """Return a duration for people, as ``40 s`` or ``2 min 05 s``."""
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else f"{whole // 60} min {whole % 60:02d} s"


@contextmanager
def _bars() -> Iterator[Callable[[str, str, int, int], None]]:
    """Show stages on stderr: bars in a terminal, lines now and then in a file or a pipe.

    Yields:
        A function of the stage's key, its text, the number done and the total.
    """
    console = Console(stderr=True, markup=False, emoji=False)
    if not console.is_terminal:

        def write(line: str) -> None:
            _write_stderr(f"{printable(line)}\n")
            _log(line)

        yield _LineLog(write).show
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    lines = _LineLog(_log)
    with Progress(*columns, console=console) as progress:
        tasks: dict[str, Any] = {}

        def show(key: str, text: str, done: int, total: int) -> None:
            lines.show(key, text, done, total)
            text = printable(text)
            if key not in tasks:
                tasks[key] = progress.add_task(text, total=total)
            progress.update(tasks[key], description=text, completed=done, total=total)

        yield show


@contextmanager
def progress_bar(title: str) -> Iterator[ProgressCall]:
    """Show the progress of the body on stderr; a new stage starts a new bar.

    Args:
        title: What is being done; the stage's name follows it, if there is one.
    """
    with _bars() as show:

        def report(*args: Any) -> None:
            stage = str(args[0]) if args and isinstance(args[0], str) else ""
            show(stage, f"{title}: {stage}" if stage else title, *args[-2:])

        yield report


@contextmanager
def training_bar() -> Iterator[ProgressCall]:
    """Show epochs with their errors and the training speed."""
    with _bars() as show:

        def report(*args: Any) -> None:
            epoch, epochs, train_cm, validation_cm, samples_per_s = args
            errors = f"RMSE {train_cm:.2f} cm, validation {validation_cm:.2f} cm"
            show("train", f"train: {errors}, {samples_per_s:.0f} samples/s, epoch", epoch, epochs)

        yield report


@contextmanager
def fleet_bar() -> Iterator[ProgressCall]:
    """Show how many drives are done, refused, failed and left: a function of the first three and of all."""
    with _bars() as show:

        def report(done: int, refused: int, failed: int, total: int) -> None:
            left = total - done - refused - failed
            text = f"label-all: {done} done, {refused} refused, {failed} failed, {left} left"
            show("label-all", text, total - left, total)

        yield report


class _LiveLog(logging.Handler):
    """Prints log lines above the live line."""

    def __init__(self, clear: str) -> None:
        super().__init__()
        self._clear = clear
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S"))

    def emit(self, record: logging.LogRecord) -> None:
        _write_stderr(f"{self._clear}{printable(self.format(record))}\n")


@contextmanager
def live_line() -> Iterator[Callable[[Callable[[], str]], None]]:
    """Show one line on stderr that is overwritten, with log lines above it, while the body runs.

    Yields:
        A function that takes a function of no arguments which returns the text. It is called only when the
        line is due: five times a second on a terminal, else every five seconds. A closed terminal is ignored.
    """
    terminal = sys.stderr.isatty()
    clear, end, every_s = ("\r\033[K", "", 0.2) if terminal else ("", "\n", 5.0)
    handler = _LiveLog(clear)
    log = logging.getLogger("lanenet")
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    due_s = time.monotonic()

    def show(text: Callable[[], str]) -> None:
        nonlocal due_s
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + every_s
            _write_stderr(f"{clear}{printable(text())}{end}")

    try:
        yield show
    finally:
        _write_stderr(clear)
        log.removeHandler(handler)
        log.setLevel(level)


def _write_stderr(text: str) -> None:
    with suppress(OSError, ValueError):
        sys.stderr.write(text)
        sys.stderr.flush()


@contextmanager
def told_or_lost() -> Iterator[None]:
    """Go on where a text cannot be written, as into a file on a full disk: a car does not stop for it."""
    try:
        yield
    except OSError:
        # Python would end with an error of its own for what is left in the buffer.
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def say(text: str, err: bool = False) -> None:
    """Print a text on stdout, or on stderr."""
    typer.echo(printable(text), err=err)
    _log(text)


def show_rich(table: Table) -> None:
    """Print a table of printable cells."""
    Console(markup=False, emoji=False).print(table)
    text = io.StringIO()
    Console(file=text, width=_LOG_WIDTH, markup=False, emoji=False).print(table)
    _log(text.getvalue())


def show_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1
) -> None:
    """Print a table whose first columns are text, whole at any width, and whose others are figures."""
    table = Table(title=printable(title), title_justify="left")
    for index, column in enumerate(columns):
        is_text = index < text_columns
        table.add_column(
            column, justify="left" if is_text else "right", overflow="fold" if is_text else "ellipsis"
        )
    for row in rows:
        table.add_row(*(printable(cell) for cell in row))
    show_rich(table)


def show_lines(lines: Sequence[str]) -> None:
    """Print the results of a stage, indented below its progress bar."""
    for line in lines:
        say(f"  {line}")


def show_problems(problems: Sequence[str], limit: int = 10) -> None:
    """Print problems that did not stop the work, on stderr."""
    for problem in problems[:limit]:
        say(f"warning: {problem}", err=True)
    if len(problems) > limit:
        say(f"warning: and {len(problems) - limit} more", err=True)


def wrote(*paths: Path | None) -> None:
    """Say which files or folders were written."""
    for path in paths:
        if path is not None:
            say(f"wrote {path}")


def given(options: Mapping[str, Path | float | str | None]) -> list[str]:
    """Return options as words of a command, without those that are None or False."""
    words: list[str] = []
    for name, value in options.items():
        if value is not None and value is not False:
            words += [name] if value is True else [name, str(value)]
    return words


def next_command(*words: str | Path) -> None:
    """Say what to run next, quoted so that it can be pasted; words in capitals are to be filled in."""
    say("next: " + shlex.join(["lanenet", *(str(word) for word in words)]))
