"""The paths in a car's file, which count from that file; of plain data, so that ``lanenet stop`` is quick."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

#: Keys of a car's file that hold a path, with their defaults; ``tests/unit/cli/test_drive_command.py`` holds
#: them to the schema.
PATHS: dict[str, str | None] = {
    "camera": None,
    "source.path": None,
    "detector.model": None,
    "detector.config": None,
    "detector.mask": None,
    "actuator.myconfig": None,
    "recording.folder": "drives",
}


def with_full_paths(data: dict[str, Any], file: Path) -> dict[str, Any]:
    """Return the content of a car's file with full paths: relative ones count from the file's folder.

    Values of a wrong type, which are refused later, stay as they are, and so do paths that start with ``/``
    or ``hf:``; ``~`` is the home folder.

    Args:
        data: Content of the file.
        file: The file.
    """
    result = dict(data)
    for key, default in PATHS.items():
        section, _, name = key.rpartition(".")
        node = result
        if section:
            if not isinstance(result.get(section), dict):
                continue
            node = result[section] = dict(result[section])
        value = node.get(name, default)
        if isinstance(value, str) and value and not value.startswith("hf:"):
            # Not resolve(): a file that is a link counts from where the link is.
            node[name] = os.path.abspath(file.parent / Path(value).expanduser())  # noqa: PTH100
    return result
