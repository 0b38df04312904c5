"""``lanenet settings``: what can be set in a car's file and in a config, with units, ranges and defaults."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from lanenet.cli.schemas import Section, Setting, files_on_the_car, files_on_the_workstation, sections
from lanenet.cli.shared import console
from lanenet.errors import ConfigError, did_you_mean

app = typer.Typer()

#: Without a key these are shown; the others are found by their keys.
_FIRST = ("train", "drive")
_WIDTH = 100


@app.command(epilog="Example: lanenet settings control.speed")
def settings(
    key: Annotated[
        str | None,
        typer.Argument(
            metavar="[KEY]",
            help="A key, as control.speed.cruise_cm_s, a section, as learn, a word of one, or drive.yaml. "
            "Default: all keys of a car's file and of a training's config.",
        ),
    ] = None,
) -> None:
    """Show what can be set in a car's file, a training's config and other files, and on the command line."""
    files = files_on_the_car()
    try:
        files = {**files_on_the_workstation(), **files}
    except ModuleNotFoundError as error:  # the car
        console.show_problems([f"only the files of the car: {error.name} is not installed"])
    found, known = list[tuple[str, list[str]]](), set[str]()
    for name, schema in files.items():
        if key is None and name not in _FIRST:
            continue
        rows = list(_rows(schema, None if key else set()))
        known |= {word for full, *_ in rows for word in (full, *full.split("."))}
        levels = [lambda full: True] if name.endswith(f": {key}") else _levels(key)
        for level in levels:
            chosen = [row for row in rows if level(row[0])]
            if chosen:
                title = name if " " in name else f"lanenet {name} CONFIG [KEY=VALUE]..."
                found.append((title, [line for row in chosen for line in _lines(*row, full=key is not None)]))
                break
    if not found:
        raise ConfigError(f"{key}: no key of any file{did_you_mean(str(key), known)}; see lanenet settings")
    try:
        for title, lines in found:
            console.say(title)
            console.show_lines(lines)
    except BrokenPipeError:  # of `lanenet settings | head`, which has read all that it wants
        with console.told_or_lost():
            raise


def _levels(key: str | None) -> list[Any]:
    """Ways to know a key again, the closest first: itself or its section, the end of it, a part of it."""
    if key is None:
        return [lambda full: True]
    return [
        lambda full: full == key or full.startswith(f"{key}."),
        lambda full: f".{full}".endswith(f".{key}") or f".{key}." in f".{full}.",
        lambda full: key in full,
    ]


def _rows(schema: Any, told: set[Any] | None) -> Iterator[tuple[str, Section, Setting]]:
    """Yield every key of a file that holds a value, with its section."""
    for section in sections(schema, told):
        for setting in section.settings:
            if not setting.nested:
                yield f"{section.key}.{setting.name}" if section.key else setting.name, section, setting


def _lines(key: str, section: Section, setting: Setting, full: bool) -> list[str]:
    """Say a key in a line; in full with its meaning."""
    kind = f" (kind: {section.kind})" if section.kind and setting.name != "kind" else ""
    default = setting.default if setting.default in ("", "required") else f"default {setting.default}"
    line = "; ".join(filter(None, [f"{key}{kind}  {setting.value}", default])).replace("`", "")
    if not full:
        return [line]
    return [line, *(f"    {part}" for part in textwrap.wrap(setting.meaning.replace("`", ""), _WIDTH))]
