"""What files of settings can hold, from their schemas: for ``lanenet settings`` and the site's reference.

Texts are Markdown, with code between backticks.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from lanenet.config import models_in

#: One entry below ``Attributes:``, for one name or several.
_ATTRIBUTE = r"^    (\w[\w, ]*): (.*?)(?=^    \w[\w, ]*: |^\S|\Z)"
#: Units by the ends of keys, the longest first. Pixels and numbers without a unit need no word.
_UNITS = {
    "_cm_s_per_throttle": "cm/s per throttle",
    "_cm_per_px": "cm/px",
    "_rad_s": "rad/s",
    "_cm_s2": "cm/s²",
    "_cm_s": "cm/s",
    "_hz": "Hz",
    "_us": "µs",
    "_mb": "MiB",
    "_ms": "ms",
    "_cm": "cm",
    "_rad": "rad",
    "_deg": "degrees",
    "_px": "px",
    "_s": "s",
}


@dataclass(frozen=True)
class Setting:
    """One key of a section.

    Attributes:
        name: The key in its section.
        value: Type, unit and bounds.
        default: Its default; ``required`` if it has none, empty for null.
        meaning: What it does.
        nested: Whether it is a section itself.
    """

    name: str
    value: str
    default: str
    meaning: str
    nested: bool


@dataclass(frozen=True)
class Section:
    """A section of a file.

    Attributes:
        key: Its dotted key; empty for the file itself.
        schema: Its schema.
        kind: What its key ``kind`` has to be; empty where there is no choice.
        summary: What it is for.
        settings: Its keys.
    """

    key: str
    schema: type[BaseModel]
    kind: str
    summary: str
    settings: tuple[Setting, ...]


def files_on_the_car() -> dict[str, type[BaseModel]]:
    """Return the schemas of the files that the car takes, by the command."""
    from lanenet.data.drives.recording import DriveFile
    from lanenet.onboard.donkey import DonkeySettings
    from lanenet.onboard.drive import DriveSettings
    from lanenet.perception.registry import KINDS

    detectors = {f"detect --detector {name} --config": kind.settings for name, kind in KINDS.items()}
    known = {name: schema for name, schema in detectors.items() if schema is not None}
    return {
        "drive": DriveSettings,
        **known,
        "In a Donkeycar: lanenet.yaml": DonkeySettings,
        "In a recording: drive.yaml": DriveFile,
    }


def files_on_the_workstation() -> dict[str, type[BaseModel]]:
    """Return the schemas of the other files, by the command.

    Raises:
        ModuleNotFoundError: If the packages of the workstation are not installed, as on the car.
    """
    from datagen.judge.settings import JudgeSettings
    from datagen.settings import MapSettings
    from datagen.world.world import SimulationSettings
    from lanenet.cli.train import run_settings_schema

    return {
        "train": run_settings_schema(),
        "map --config": MapSettings,
        "simulate": SimulationSettings,
        "judge --config": JudgeSettings,
    }


def sections(
    schema: type[BaseModel], told: set[type[BaseModel]] | None = None, key: str = ""
) -> Iterator[Section]:
    """Yield a section of settings, then those below it; of one that stood before without its keys.

    Args:
        schema: Of the section.
        told: Schemas that stood before; those that are yielded are added. None repeats all.
        key: Of the section.
    """
    summary, meanings = _docstring(schema)
    if told is not None:
        if schema in told:
            yield Section(key, schema, _kind(schema), summary, ())
            return
        told.add(schema)
    settings, below = [], []
    for name, field in schema.model_fields.items():
        nested = list(models_in(field.annotation))
        below += [(f"{key}.{name}" if key else name, each) for each in nested]
        default = "required" if field.is_required() else ""
        if not nested and field.default is not PydanticUndefined:
            default = shown(field.default)
        value = "section" if nested else _type(field.annotation) + _unit(name) + _bounds(field.metadata)
        meaning = meanings.get(name) or (_docstring(nested[0])[0] if nested else "")
        settings.append(Setting(name, value, default, meaning, bool(nested)))
    yield Section(key, schema, _kind(schema), summary, tuple(settings))
    for inner, each in below:
        yield from sections(each, told, inner)


def _unit(name: str) -> str:
    return next((f", {unit}" for end, unit in _UNITS.items() if f"_{name}".endswith(end)), "")


def _docstring(schema: type[BaseModel]) -> tuple[str, dict[str, str]]:
    """The first paragraph, and the meaning of each attribute, also those of the base classes."""
    summary, meanings = "", dict[str, str]()
    for cls in reversed(schema.__mro__):
        if not issubclass(cls, BaseModel) or cls is BaseModel or not cls.__doc__:
            continue
        text, _, attributes = inspect.cleandoc(cls.__doc__).partition("\nAttributes:\n")
        summary = _plain(text.split("\n\n")[0])
        for names, meaning in re.findall(_ATTRIBUTE, attributes, re.MULTILINE | re.DOTALL):
            meanings |= {name.strip(): _plain(meaning) for name in names.split(",")}
    return summary, meanings


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
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [
        f"{sign} {getattr(m, key):g}" for m in metadata for key, sign in signs.items() if hasattr(m, key)
    ]
    return f", {' and '.join(found)}" if found else ""


def shown(value: Any) -> str:
    """Return a default as a file has it, in Markdown's code; empty for none."""
    if value is None or value is PydanticUndefined or value == "":
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
