"""Which outputs are there already: a mark beside each, with a hash of all that it follows from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lanenet.data.files import write_json
from lanenet.errors import DriveFormatError

_VERSION = 15  # of drives, maps and label sets; raise it when the same settings give others


def fingerprint(path: Path) -> str:
    """Hash name, size and time of a recording's files: cheap, and changes when the recording does.

    Raises:
        DriveFormatError: If there is no such recording.
    """
    if not path.exists():
        raise DriveFormatError(f"{path}: no such drive")
    files = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.is_file())
    return key_of([(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files])


def key_of(parts: list[Any]) -> str:
    """Hash of what an output follows from: plain values, in any order of their keys."""
    text = json.dumps([_VERSION, parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _marker(path: Path) -> Path:
    return path.with_name(f"{path.stem}.done.json")


def is_done(path: Path, key: str) -> bool:
    """Whether an output is there and complete, and was made of what ``key`` stands for."""
    try:
        return path.is_file() and json.loads(_marker(path).read_text(encoding="utf-8")) == {"key": key}
    except (OSError, ValueError):  # not there, not text, or not JSON
        return False


def forget_done(path: Path) -> None:
    """Take the mark away, before an output is made again."""
    _marker(path).unlink(missing_ok=True)


def mark_done(path: Path, key: str) -> None:
    """Mark an output as complete; a job that was killed before this is done again."""
    write_json(_marker(path), {"key": key})


def make_once(path: Path, key: str, make: Callable[[], object]) -> None:
    """Make an output that is not there yet, or was made of something else."""
    if not is_done(path, key):
        forget_done(path)
        make()
        mark_done(path, key)
