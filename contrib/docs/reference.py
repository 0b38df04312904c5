"""Fills in the pages of docs/reference when mkdocs builds the site: options from verbs, settings from code.

A line ``<!-- all options -->`` or ``<!-- all settings -->`` of a page is replaced. The result is Markdown.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_type_hints

import typer
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from lanenet.cli.app import app

#: One entry below ``Attributes:``, for one name or several.
_ATTRIBUTE = r"^    (\w[\w, ]*): (.*?)(?=^    \w[\w, ]*: |^\S|\Z)"


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
        shown = str(parameter.metavar or parameter.name.upper())
        if argument:
            many = "..." if parameter.nargs == -1 else ""
            words.append(f"{shown}{many}" if parameter.required else f"[{shown}{many}]")
        flag = getattr(parameter, "is_flag", False)
        names = [shown] if argument else [*parameter.opts, *parameter.secondary_opts]
        value = "" if argument or flag else f" {parameter.metavar or _value(hints[parameter.name])}"
        default = "required" if parameter.required else _shown(parameter.default)
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
    from datagen.judge.settings import JudgeSettings
    from datagen.settings import MapSettings
    from datagen.world.world import SimulationSettings
    from lanenet.cli.train import run_settings_schema
    from lanenet.onboard.donkey import DonkeySettings
    from lanenet.onboard.drive import DriveSettings
    from lanenet.perception.registry import KINDS

    detectors = [(f"detect --detector {name} --config", kind.settings) for name, kind in KINDS.items()]
    files: list[tuple[str, Any]] = [
        ("train", run_settings_schema()),
        ("map --config", MapSettings),
        ("drive", DriveSettings),
        ("simulate", SimulationSettings),
        ("judge --config", JudgeSettings),
        *((name, schema) for name, schema in detectors if schema is not None),
        ("In a Donkeycar: lanenet.yaml", DonkeySettings),
    ]
    told: set[type[BaseModel]] = set()
    sections = []
    for name, schema in files:
        sections.append(f"## {name}")
        sections.extend(_schema("", schema, told))
    return "\n\n".join(sections)


def _schema(key: str, schema: type[BaseModel], told: set[type[BaseModel]]) -> Iterator[str]:
    """A section of settings, then those below it; one that stood before is not repeated."""
    summary, meanings = _docstring(schema)
    if key:
        # Only the first level stands in the table of contents.
        yield f"{'####' if '.' in key else '###'} {key}" + (
            f" (`kind: {_kind(schema)}`)" if _kind(schema) else ""
        )
    if schema in told:
        yield f"{summary} The keys are those of `{schema.__name__}` above."
        return
    told.add(schema)
    yield summary
    rows, below = [], []
    for name, field in schema.model_fields.items():
        nested = list(_nested(field.annotation))
        below += [(f"{key}.{name}" if key else name, each) for each in nested]
        default = "required" if field.is_required() else ""
        if not nested and field.default is not PydanticUndefined:
            default = _shown(field.default)
        shown = "section" if nested else _type(field.annotation) + _bounds(field.metadata)
        meaning = meanings.get(name) or (_docstring(nested[0])[0] if nested else "")
        rows.append((f"`{name}`", shown, default, meaning))
    yield _table(("key", "value", "default", "meaning"), rows)
    for inner, each in below:
        yield from _schema(inner, each, told)


def _docstring(schema: type[BaseModel]) -> tuple[str, dict[str, str]]:
    """The first paragraph, and the meaning of each attribute, also those of the base classes."""
    summary, meanings = "", {}
    for cls in reversed(schema.__mro__):
        if not issubclass(cls, BaseModel) or cls is BaseModel or not cls.__doc__:
            continue
        text, _, attributes = inspect.cleandoc(cls.__doc__).partition("\nAttributes:\n")
        summary = _plain(text.split("\n\n")[0])
        for names, meaning in re.findall(_ATTRIBUTE, attributes, re.MULTILINE | re.DOTALL):
            meanings |= {name.strip(): _plain(meaning) for name in names.split(",")}
    return summary, meanings


def _nested(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _nested(part)


def _kind(schema: type[BaseModel]) -> str:
    """What ``kind`` has to be for this one of several schemas; empty where there is no choice."""
    field = schema.model_fields.get("kind")
    values = () if field is None else get_args(field.annotation)
    return str(values[0]) if len(values) == 1 and isinstance(values[0], str) else ""


def _type(annotation: Any) -> str:
    names = {"float": "number", "int": "whole number", "str": "text", "bool": "true or false", "Path": "path"}
    if annotation is type(None):
        return "null"
    arguments = get_args(annotation)
    origin = getattr(annotation, "__origin__", None)
    if "Annotated" in str(type(annotation)):
        return _type(arguments[0]) if arguments else _type(origin)
    if "Literal" in repr(annotation).partition("[")[0]:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (list, tuple):
        each = [_type(part) for part in arguments if part is not Ellipsis]
        return "list of " + (each[0] if len(set(each)) == 1 else ", ".join(each))
    if origin is dict or is_dataclass(annotation):
        return "mapping"
    if arguments:
        return " or ".join(dict.fromkeys(_type(part) for part in arguments))
    name = getattr(annotation, "__name__", str(annotation))
    return names.get(name, name)


def _bounds(metadata: list[Any]) -> str:
    """The bounds of a number, as ``> 0``; lengths of lists and patterns are left to the error message."""
    signs = {"gt": "&gt;", "ge": "≥", "lt": "&lt;", "le": "≤"}
    found = [
        f"{sign} {getattr(m, key):g}" for m in metadata for key, sign in signs.items() if hasattr(m, key)
    ]
    return f", {' and '.join(found)}" if found else ""


def _shown(value: Any) -> str:
    if value is None or value is PydanticUndefined:
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, Enum):
        value = value.value
    if is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in fields(value)}
    if isinstance(value, dict):
        value = f"{{{', '.join(f'{key}: {each}' for key, each in value.items())}}}"
    if isinstance(value, list | tuple):
        value = f"[{', '.join(str(each) for each in value)}]"
    return f"`{value.as_posix() if isinstance(value, Path) else value}`"


def _plain(text: str) -> str:
    """A docstring's text in one line of Markdown."""
    text = re.sub(r":[a-z]+:`~?([^`]*)`", r"`\1`", text).replace("``", "`")
    return " ".join(text.split())


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    # A bar would end the cell, and an escaped one keeps its backslash within code.
    cells = [[cell.replace("|", " or ") for cell in line] for line in lines]
    table = "\n".join(f"| {' | '.join(line)} |" for line in cells)
    return f'<div class="reference" markdown>\n\n{table}\n\n</div>'
