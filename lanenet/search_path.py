"""Where modules are imported from: never from the working folder, where anything may lie."""

from __future__ import annotations

import os
import site
from collections.abc import Sequence
from pathlib import Path


def without_working_folder(entries: Sequence[str]) -> list[str]:
    """Return a module search path without the working folder.

    ``python -m`` and an empty element of ``PYTHONPATH`` put it there, and a ``serial.py`` in it would be run
    in place of the package. If lanenet itself lies there (a checkout), it comes last.

    Args:
        entries: As ``sys.path``.
    """
    try:
        here = Path.cwd().resolve()
    except OSError:
        # It was deleted, and holds nothing.
        return [entry for entry in entries if entry]
    installed = [os.__file__, *(f"{folder}/x" for folder in site.getsitepackages())]
    if here in (Path(file).resolve().parent for file in installed):
        return [entry for entry in entries if entry]
    kept = [entry for entry in entries if entry and Path(entry).resolve() != here]
    own = Path(__file__).resolve().parents[1]
    return [*kept, str(own)] if own == here else kept
