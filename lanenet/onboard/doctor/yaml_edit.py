"""Changes single values of a YAML file that people wrote, and no other byte of it.

Written here because ruamel.yaml keeps comments, but rewrites the indentation, and the spacing of lists and
comments, of files in another style than its own.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from typing import Any

import yaml

from lanenet.errors import ConfigError


def set_values(text: str, changes: Mapping[str, float], where: str) -> str:
    """Return a YAML text with some numbers changed or added.

    Args:
        text: Nested sections in block style, as in the configs that ship.
        changes: Numbers by their dotted key, as ``control.speed.throttle_at_rest``.
        where: The file, for the error.

    Raises:
        ConfigError: If the file is not in block style; it has to be changed by hand.
    """
    try:
        expected = copy.deepcopy(yaml.safe_load(text)) or {}
        lines = text.splitlines()
        for key, value in changes.items():
            path = key.split(".")
            _set_plain(expected, path, value)
            lines = _set_line(lines, path, f"{value:g}")
        changed = "\n".join(lines) + "\n"
        done = yaml.safe_load(changed) == expected
    except (yaml.YAMLError, TypeError, AttributeError):
        done = False
    if not done:
        values = ", ".join(f"{key}={value:g}" for key, value in changes.items())
        raise ConfigError(f"{where}: cannot be changed automatically; change these values yourself: {values}")
    return changed


def _set_plain(data: dict[str, Any], path: list[str], value: float) -> None:
    *parents, last = path
    for parent in parents:
        data = data.setdefault(parent, {})
    # As YAML will read it.
    data[last] = yaml.safe_load(f"{value:g}")


def _set_line(lines: list[str], path: list[str], value: str) -> list[str]:
    start, end, indent = 0, len(lines), 0
    for depth, name in enumerate(path):
        at = _find(lines, start, end, indent, name)
        if at is None:
            new = [
                f"{' ' * (indent + 2 * i)}{key}:{' ' + value if depth + i == len(path) - 1 else ''}"
                for i, key in enumerate(path[depth:])
            ]
            return [*lines[:end], *new, *lines[end:]]
        if depth == len(path) - 1:
            tail = re.search(r"\s+#.*$", lines[at])
            changed = f"{' ' * indent}{name}: {value}{tail.group() if tail else ''}"
            return [*lines[:at], changed, *lines[at + 1 :]]
        start, end = at + 1, _end_of_block(lines, at + 1, end, indent)
        indent = next((_indent(line) for line in lines[start:end] if _has_content(line)), indent + 2)
    raise AssertionError("a path has at least one part")


def _find(lines: list[str], start: int, end: int, indent: int, name: str) -> int | None:
    pattern = re.compile(rf" {{{indent}}}{re.escape(name)}\s*:(\s|$)")
    return next((i for i in range(start, end) if pattern.match(lines[i])), None)


def _end_of_block(lines: list[str], start: int, end: int, indent: int) -> int:
    """Return the line after the last one that is indented deeper; later comments belong to what follows."""
    last = start
    for i in range(start, end):
        if _has_content(lines[i]):
            if _indent(lines[i]) <= indent:
                break
            last = i + 1
    return last


def _has_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))
