"""Fills in the pages of docs/reference when mkdocs builds the site: options from verbs, settings from code.

A line ``<!-- all options -->`` or ``<!-- all settings -->`` of a page is replaced. The result is Markdown.
"""

from __future__ import annotations

import html
import inspect
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer
from pydantic import BaseModel

from lanenet.cli.app import app
from lanenet.cli.schemas import Section, files_on_the_car, files_on_the_workstation, sections, shown


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the marks of a page; mkdocs calls this."""
    for mark, text in (("all options", options_page), ("all settings", settings_page)):
        if f"<!-- {mark} -->" in markdown:
            markdown = markdown.replace(f"<!-- {mark} -->", text())
    return markdown


def commands(group: Any, prefix: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Walk through all verbs by their full names, such as ``calibrate ground``."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*prefix, name))
        else:
            yield " ".join((*prefix, name)), command


def options_page() -> str:
    """Every verb with its arguments, options and defaults, grouped as in ``lanenet --help``."""
    group = typer.main.get_command(app)
    panels: dict[str, list[str]] = {}
    for name, command in commands(group):
        top = group.commands[name.split()[0]]
        panels.setdefault(str(top.rich_help_panel), []).append(_verb(name, command))
    return "\n\n".join(f"## {panel}\n\n" + "\n\n".join(verbs) for panel, verbs in panels.items())


def _verb(name: str, command: Any) -> str:
    words = ["lanenet", name]
    rows = []
    hints = get_type_hints(inspect.unwrap(command.callback))
    for parameter in command.params:
        if getattr(parameter, "hidden", False):
            continue
        argument = parameter.param_type_name == "argument"
        word = str(parameter.metavar or parameter.name.upper())
        if argument:
            many = "..." if parameter.nargs == -1 else ""
            words.append(f"{word}{many}" if parameter.required else f"[{word}{many}]")
        flag = getattr(parameter, "is_flag", False)
        names = [word] if argument else [*parameter.opts, *parameter.secondary_opts]
        value = "" if argument or flag else f" {parameter.metavar or _value(hints[parameter.name])}"
        default = "required" if parameter.required else shown(parameter.default)
        if callable(parameter.default) or (flag and not parameter.default):
            default = ""
        code = ", ".join(f"`{option}{value}`" for option in names)
        rows.append((code, str(getattr(parameter, "help", "") or ""), default))
    words.append("[OPTIONS]")
    example = str(command.epilog or "").removeprefix("Example: ").strip()
    text = [f"### {name}", " ".join(inspect.cleandoc(command.help or "").split()), f"    {' '.join(words)}"]
    if rows:
        text.append(_table(("", "meaning", "default"), rows))
    if example:
        text.append(f"Example: `{example}`")
    return "\n\n".join(text)


def _value(hint: Any) -> str:
    """What an option without a name for its value takes."""
    hint = next((part for part in get_args(hint) if part is not type(None)), hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return "|".join(str(each.value) for each in hint)
    return {Path: "PATH", float: "NUMBER", int: "NUMBER"}.get(hint, "TEXT")


def settings_page() -> str:
    """Every file of settings, section by section, with keys, types, defaults and meanings."""
    there, car = files_on_the_workstation(), files_on_the_car()
    told: set[type[BaseModel]] = set()
    page = []
    for name, schema in {**there, **car}.items():
        page.append(f"## {name}")
        for section in sections(schema, told):
            page.extend(_section(section))
    return "\n\n".join(page)


def _section(section: Section) -> Iterator[str]:
    """A section of settings; one that stood before is not repeated."""
    if section.key:
        # Only the first level stands in the table of contents.
        level = "####" if "." in section.key else "###"
        yield f"{level} {section.key}" + (f" (`kind: {section.kind}`)" if section.kind else "")
    if not section.settings:
        yield f"{section.summary} The keys are those of `{section.schema.__name__}` above."
        return
    yield section.summary
    rows = [
        (f"`{each.name}`", html.escape(each.value), each.default, each.meaning) for each in section.settings
    ]
    yield _table(("key", "value", "default", "meaning"), rows)


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    # A bar would end the cell, and an escaped one keeps its backslash within code.
    cells = [[cell.replace("|", " or ") for cell in line] for line in lines]
    table = "\n".join(f"| {' | '.join(line)} |" for line in cells)
    return f'<div class="reference" markdown>\n\n{table}\n\n</div>'
