"""Strict, typed settings read from YAML.

Every schema derives from :class:`Settings`: frozen, and unknown keys are refused. A YAML file lists only what
differs from the defaults; ``key=value`` overrides come last.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from lanenet.errors import ConfigError, did_you_mean


class Settings(BaseModel):
    """Base of every settings schema."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)


SettingsT = TypeVar("SettingsT", bound=Settings)


def flat_settings(settings: Settings) -> dict[str, Any]:
    """Return all values by their dotted keys, such as ``edges.blur_px``."""
    flat: dict[str, Any] = {}
    for key, value in settings:
        if isinstance(value, Settings):
            flat |= {f"{key}.{inner}": v for inner, v in flat_settings(value).items()}
        else:
            flat[key] = value
    return flat


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    Raises:
        ConfigError: If the file is missing, is not YAML, or is not a mapping.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error})") from None
    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark is not None else ""
        raise ConfigError(f"{path}: not valid YAML{where}") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping of keys to values, found {type(data).__name__}")
    return data


def apply_overrides(data: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """Return ``data`` with ``a.b=value`` overrides applied; values are parsed as YAML.

    Raises:
        ConfigError: If an override has no ``=`` or goes through a key that is not a mapping.
    """
    result = dict(data)
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise ConfigError(f"override {override!r}: expected key=value")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ConfigError(f"override {override!r}: the value is not valid YAML") from None
        *parents, last = key.split(".")
        node = result
        for parent in parents:
            child = node.get(parent, {})
            if not isinstance(child, dict):
                raise ConfigError(f"override {override!r}: {parent} is not a section")
            node[parent] = dict(child)
            node = node[parent]
        node[last] = value
    return result


def load_settings(schema: type[SettingsT], path: Path, overrides: list[str] | None = None) -> SettingsT:
    """Read ``path``, apply overrides and check the result against ``schema``.

    Raises:
        ConfigError: Naming the file and the overrides, the key, what was found and what was expected.
    """
    where = " ".join([str(path), *(overrides or [])])
    return check_settings(schema, apply_overrides(read_yaml(path), overrides or []), where)


def check_settings(schema: type[SettingsT], data: dict[str, Any], where: str) -> SettingsT:
    """Check plain data against a schema; ``where`` is its origin, for the error.

    Raises:
        ConfigError: Naming the origin, the key, what was found and what was expected.
    """
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        raise ConfigError(
            f"{where}: " + "; ".join(_describe(schema, e) for e in error.errors()[:3])
        ) from None


def dump_settings(settings: Settings) -> str:
    """Return the settings as YAML, with every key."""
    return yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def _describe(schema: type[BaseModel], error: Any) -> str:
    location = [str(part) for part in error["loc"]]
    key = ".".join(location) or "(top level)"
    if error["type"] == "extra_forbidden":
        known = _known_keys(schema, location[:-1])
        hint = did_you_mean(location[-1], known) or f", known keys: {', '.join(sorted(known))}"
        return f"unknown key {key!r}{hint}"
    if error["type"] == "missing":
        return f"key {key!r} is missing"
    found = error.get("input")
    shown = "NaN" if isinstance(found, float) and math.isnan(found) else repr(found)
    message = error["msg"][:1].lower() + error["msg"][1:]
    return f"key {key!r}: {message}, found {shown[:80]}"


def _known_keys(schema: type[BaseModel], path: list[str]) -> list[str]:
    """Return the field names of the schema nested at ``path``; list indices and union tags are skipped."""
    for part in path:
        field = schema.model_fields.get(part)
        if field is None:
            continue
        candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
        nested = [c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)]
        if not nested:
            return []
        schema = nested[0]
    return list(schema.model_fields)
