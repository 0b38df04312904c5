"""Progress where nobody looks at a terminal, in log files and pipes; names that hold its commands."""

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.cli.shared import console
from lanenet.evaluation.tables import TextTable


def test_a_log_gets_a_line_at_once_now_and_then_and_at_the_end(capsys, monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("lanenet.cli.shared.console.time.monotonic", lambda: now_s[0])
    with console.progress_bar("map") as progress:
        for done in range(1, 61):
            now_s[0] += 1.0
            progress("edges", done, 60)
        progress("lines", 1, 2)
        # Over the same frames once more.
        now_s[0] += 10.0
        progress("edges", 1, 60)
        now_s[0] += 20.0
        progress("edges", 31, 60)
    told = capsys.readouterr().err.splitlines()
    assert told == [
        "map: edges: 1 of 60",
        "map: edges: 21 of 60, about 39 s left",
        "map: edges: 41 of 60, about 19 s left",
        "map: edges: 60 of 60",
        "map: lines: 1 of 2",
        "map: edges, pass 2: 31 of 60, about 19 s left of it",
    ]


def test_a_log_of_a_training_has_its_errors(capsys):
    with console.training_bar() as progress:
        progress(1, 1, 2.5, 1.25, 1500.0)
    told = "train: RMSE 2.50 cm, validation 1.25 cm, 1500 samples/s, epoch: 1 of 1\n"
    assert capsys.readouterr().err == told


#: An escape that clears the screen, one of eight bits, a carriage return, a mark that turns the direction of
#: writing, and markup of Rich.
NAME = "[red]x[/]\x1b[2J\x9b2J\rok\u202eb"
SHOWN = r"[red]x[/]\x1b[2J\x9b2J\rok\u202eb"


def _progress(name: str) -> None:
    with console.progress_bar(name) as progress:
        progress(1, 1)


def _live(name: str) -> None:
    with console.live_line() as show:
        show(lambda: name)


@pytest.mark.parametrize(
    "show",
    [
        lambda name: console.wrote(Path(name)),
        lambda name: console.show_lines([name]),
        lambda name: console.show_problems([name]),
        lambda name: console.next_command("detect", name),
        lambda name: console.show_table(name, ["file"], [[name]]),
        lambda name: console.show_rich(TextTable(name, ["file"], [[name]], name).as_rich()),
        _progress,
        _live,
    ],
    ids=["wrote", "lines", "problems", "next", "table", "comparison", "progress", "live"],
)
def test_names_are_shown_and_not_obeyed(capsys, show):
    show(NAME)
    told = "".join(capsys.readouterr())
    assert SHOWN in told and not set(told) & set("\x1b\x9b\r\u202e")


def test_an_error_is_one_line_whatever_the_name(tmp_path):
    # The last byte is no UTF-8.
    name = os.fsdecode(b"a\n\x1b[2J[b]\xff.yaml")
    (tmp_path / name).write_text("epochs: [")
    result = CliRunner().invoke(app, ["drive", str(tmp_path / name)])
    assert result.exit_code == 1 and "Traceback" not in result.output
    (line,) = result.stderr.splitlines()
    assert r"a\n\x1b[2J[b]\udcff.yaml" in line and "\x1b" not in line
