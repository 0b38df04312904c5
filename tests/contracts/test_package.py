from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from documents import VERBS as COMMANDS
from documents import commands_of
from typer.testing import CliRunner

import lanenet
from lanenet import __main__
from lanenet.cli.app import app

REPO = Path(__file__).resolve().parents[2]
VERBS = (
    *("train", "simulate", "judge", "map", "label", "val", "export", "detect", "drive"),
    *("track", "sheets", "reality", "bench", "doctor"),
)
#: Wide enough that help texts are not wrapped inside an option's name.
TERMINAL = {"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}


#: Documents whose command lines are checked.
DOCUMENTS = (REPO / "README.md", REPO / "docs" / "commands.md")


def documents_text() -> str:
    return "\n".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)


def readme_lines() -> list[str]:
    """The command lines ``lanenet ...`` in the code blocks of the README and of the page of commands."""
    found = [command.line for document in DOCUMENTS for command in commands_of(document)]
    return [line for line in found if line.startswith("lanenet ")]


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("3", "3")])
def test_small_systems_are_solved_by_one_thread_unless_given(monkeypatch, given, expected) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", given or "")
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "argv", ["lanenet", "--version"])
    with pytest.raises(SystemExit):
        __main__.main()
    assert os.environ["OPENBLAS_NUM_THREADS"] == expected


def test_the_version_stands_once() -> None:
    project = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
    assert lanenet.__version__ == version("lanenet") and "version" in project["dynamic"]


def test_a_release_says_what_changed_and_how_to_cite_it() -> None:
    """The newest change is this version; the keys are those that Citation File Format 1.2.0 asks for."""
    changes = re.findall(r"^## (\S+)$", (REPO / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert changes[0] == lanenet.__version__
    citation = yaml.safe_load((REPO / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert all({"type", "title", "authors"} <= set(reference) for reference in citation["references"])


def test_the_installed_command_answers() -> None:
    program = Path(sys.executable).parent / "lanenet"
    result = subprocess.run([program, "--help"], capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    for verb in VERBS:
        assert verb in result.stdout


def test_a_folder_of_the_clones_name_beside_a_script_does_not_hide_the_package(tmp_path: Path) -> None:
    # An editable installation of it is a line in a .pth file: tested here if this is one.
    assert tomllib.loads((REPO / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"] == {
        "": "."
    }
    (tmp_path / "lanenet").mkdir()
    script = tmp_path / "script.py"
    script.write_text("import lanenet\nprint(lanenet.load.__module__)\n")
    run = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert run.stdout.startswith("lanenet")


def test_an_unknown_verb_is_refused() -> None:
    result = CliRunner().invoke(app, ["trian"], env=TERMINAL)
    assert result.exit_code == 2


@pytest.mark.parametrize("verb", VERBS)
def test_the_verb_exists(verb: str) -> None:
    assert (verb,) in COMMANDS


@pytest.mark.parametrize("names", COMMANDS, ids=" ".join)
def test_every_verb_has_help_with_an_example(names: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, [*names, "--help"], env=TERMINAL)
    assert result.exit_code == 0, result.output
    text = f"{COMMANDS[names].help} {COMMANDS[names].epilog}"
    assert f"lanenet {' '.join(names)} " in " ".join(text.split()) + " ", "help without an example"
    for parameter in COMMANDS[names].params:
        if parameter.param_type_name == "option" and not parameter.hidden:
            assert parameter.help, f"{parameter.opts[0]} is not explained"


def test_the_documents_show_every_verb() -> None:
    shown = {line.split()[1] for line in readme_lines()}
    assert {names[0] for names in COMMANDS} <= shown


def test_the_readme_fits_on_a_few_screens() -> None:
    assert len((REPO / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def outputs(line: str) -> list[str]:
    """What a command line says that it writes."""
    words = shlex.split(line, comments=True)
    return [value for option, value in pairwise(words) if option in ("--out", "--video")]


def examples() -> list[str]:
    """The command lines of the documents and of the help texts, those that do not run from the clone too."""
    shown = [line for line in documents_text().splitlines() if re.match(r"(lanenet-env/bin/)?lanenet ", line)]
    return [*shown, *(str(command.epilog) for command in COMMANDS.values())]


def test_what_the_examples_write_leaves_the_clone_clean() -> None:
    ignored = (REPO / ".gitignore").read_text().splitlines()
    written = [path for line in examples() for path in outputs(line)]
    assert len(written) > 30
    for path in written:
        assert f"{path.partition('/')[0]}/" in ignored, path
    # What the cars of configs/car record, and the environment of the README's car.
    assert {"/drives/", "/lanenet-env/"} <= set(ignored)


def test_constraints_pin_the_direct_dependencies_exactly() -> None:
    lines = (REPO / "constraints.txt").read_text().splitlines()
    pins = [re.fullmatch(r"([A-Za-z0-9_.-]+)==[0-9][0-9A-Za-z.]*", line) for line in lines]
    assert all(pins), [line for line, pin in zip(lines, pins, strict=True) if not pin]
    pinned = {pin[1].lower() for pin in pins if pin}
    project = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [
        *project["dependencies"],
        *(d for name in ("data", "train", "viz", "dev") for d in extras[name]),
    ]
    names = {re.match(r"[A-Za-z0-9_.-]+", requirement)[0].lower() for requirement in wanted}  # type: ignore[index]
    assert names - {"lanenet"} <= pinned


def test_no_document_has_a_figure_left_open():
    documents = [REPO / "README.md", REPO / "CONTRIBUTING.md", REPO / "checkpoints" / "README.md"]
    for document in [*documents, *(REPO / "docs").glob("*.md")]:
        text = document.read_text(encoding="utf-8")
        assert not re.search(r"@[A-Z]_|lead fills|TODO|(?m:^[A-Z]{4,}\.?$)", text), document
        for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
            assert (document.parent / picture).is_file(), f"{document}: {picture}"
