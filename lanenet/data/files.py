"""Atomic files and folders, and packages that may be missing.

Everything is written under a temporary name beside its destination and moved into place at the end, so that a
crash, a full disk or Ctrl-C never leaves half a file under the final name.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from lanenet.config import read_yaml
from lanenet.errors import ConfigError, LanenetError, MissingExtraError

#: Kinds of folder that may be replaced; each holds ``<kind>.yaml`` with ``format: lanenet-<kind>/n``.
FOLDER_KINDS: tuple[str, ...] = ("drive", "map", "checkpoint")


def require(package: str, extra: str) -> ModuleType:
    """Import a package of an extra.

    Args:
        package: Dotted name, for example ``pyarrow.parquet``.
        extra: The extra of lanenet that installs it.

    Returns:
        The module.

    Raises:
        MissingExtraError: With the command that installs it.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise MissingExtraError(
            f"the package {package.partition('.')[0]} is needed here and cannot be imported ({error}); "
            f"install it with: pip install 'lanenet[{extra}]'"
        ) from None


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Write a file under a temporary name and move it to ``path`` when the block ends well.

    Args:
        path: Destination; missing parent folders are made, an existing file is replaced.

    Yields:
        A path in the same folder with the same ending, for the block to write. Removed on any error.

    Raises:
        LanenetError: If the destination is a folder, or cannot be written.
    """
    path = Path(path).resolve()
    if path.is_dir():
        raise LanenetError(f"{path}: is a folder, expected a file to write")
    _make_parent(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    try:
        yield temporary
        try:
            sync_path(temporary)
            temporary.replace(path)
            sync_path(path.parent)
        except OSError as error:
            raise LanenetError(f"{path}: cannot be written ({error})") from None
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path, kind: str | None = None) -> Iterator[Path]:
    """Fill a folder under a temporary name and move it to ``path`` when the block ends well.

    An existing folder is replaced only if it is empty or an earlier output: it must hold ``<kind>.yaml`` with
    ``format: lanenet-<kind>/...``. The block has to write that file, or a second run will refuse.

    Args:
        path: Destination; missing parent folders are made.
        kind: What the folder is, one of :data:`FOLDER_KINDS`; None accepts an earlier output of any kind.

    Yields:
        The temporary folder. Removed with all its contents on any error.

    Raises:
        LanenetError: If the destination is a file or a folder that lanenet did not write, or if it cannot be
            written.
    """
    path = Path(path).resolve()
    check_replaceable(path, kind)
    _make_parent(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        try:
            temporary.mkdir()
        except OSError as error:
            raise LanenetError(f"{path}: cannot be written ({error})") from None
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                sync_path(file)
        # The destination may have changed while the block ran.
        check_replaceable(path, kind)
        _move_folder(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_destination(path: Path) -> None:
    """Refuse a file that could not be written, before the work starts; creates nothing.

    Raises:
        LanenetError: If the destination is a folder, or lies below a file or a folder that cannot be
            written to.
    """
    path = Path(path).resolve()
    if path.is_dir():
        raise LanenetError(f"{path}: is a folder, expected a file to write")
    parent = next(folder for folder in path.parents if folder.exists())
    if not parent.is_dir():
        raise LanenetError(f"{path}: cannot be written, {parent} is a file, expected a folder")
    if not os.access(parent, os.W_OK):
        raise LanenetError(f"{path}: cannot be written, the folder {parent} is read-only")


def check_replaceable(path: Path, kind: str | None = None) -> None:
    """Refuse a folder that :func:`atomic_folder` would not replace, before the work starts.

    Args:
        path: Destination; may be missing.
        kind: What the folder will be, one of :data:`FOLDER_KINDS`; None accepts an earlier output of any.

    Raises:
        LanenetError: If the destination is a file or a folder that lanenet did not write.
    """
    path = Path(path).resolve()
    if not path.exists():
        return
    if not path.is_dir():
        raise LanenetError(f"{path}: is a file, expected a folder to write")
    if not any(path.iterdir()):
        return
    kinds = FOLDER_KINDS if kind is None else (kind,)
    if not any(_holds_marker(path, name) for name in kinds):
        markers = " or ".join(f"{name}.yaml" for name in kinds)
        raise LanenetError(
            f"{path}: the folder is not empty and holds no {markers} of lanenet, so it is not replaced; "
            "choose another name or remove it"
        )


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8) atomically."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_bytes(path: Path, data: bytes) -> None:
    """Write a binary file atomically."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)


def json_text(obj: Any) -> str:
    """Return indented JSON.

    Accepts NumPy arrays and numbers, paths, tuples and nested containers. Floats that are not finite become
    null: JSON has no value for them.
    """
    return json.dumps(_plain(obj), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_json(path: Path, obj: Any) -> None:
    """Write :func:`json_text` atomically."""
    write_text(path, json_text(obj))


def sync_path(path: Path) -> None:
    """Sync a file or folder to the disk, so that it survives a power cut."""
    if path.is_dir() and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _plain(obj: Any) -> Any:
    # Not above: what stops a car imports this module, and must not wait for NumPy.
    import numpy as np

    if isinstance(obj, np.ndarray):
        return _plain(obj.tolist())
    if isinstance(obj, np.generic):
        return _plain(obj.item())
    if isinstance(obj, dict):
        return {str(key): _plain(value) for key, value in obj.items()}
    if isinstance(obj, list | tuple):
        return [_plain(value) for value in obj]
    if isinstance(obj, float):
        return obj if math.isfinite(obj) else None
    if isinstance(obj, Path):
        return str(obj)
    return obj


def _make_parent(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LanenetError(f"{path.parent}: the folder cannot be made ({error})") from None


def _holds_marker(path: Path, kind: str) -> bool:
    try:
        found = read_yaml(path / f"{kind}.yaml").get("format")
    except ConfigError:
        return False
    return isinstance(found, str) and found.startswith(f"lanenet-{kind}/")


def _move_folder(temporary: Path, path: Path) -> None:
    """Move a folder into place; an old one is set aside first and restored if the move fails."""
    old = path.with_name(f".{path.name}.{secrets.token_hex(4)}.old.tmp") if path.exists() else None
    try:
        if old is not None:
            path.rename(old)
        try:
            temporary.rename(path)
        except OSError:
            if old is not None:
                old.rename(path)
            raise
        sync_path(path.parent)
    except OSError as error:
        raise LanenetError(f"{path}: cannot be written ({error})") from None
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)


def clear_unfinished(out: Path) -> None:
    """Remove the temporary folders of killed runs beside an output folder.

    A run that was killed between setting the old folder aside and moving the new one into place leaves the
    old one under a temporary name: it is restored.

    Args:
        out: The folder, as for :func:`atomic_folder`.
    """
    out = out.resolve()
    if not out.parent.is_dir():
        return
    # The names of atomic_folder; a name that only starts alike belongs to another output.
    pattern = re.compile(rf"\.{re.escape(out.name)}\.[0-9a-f]{{8}}(\.old)?\.tmp")
    for left in sorted(out.parent.iterdir()):
        found = pattern.fullmatch(left.name)
        if found is None or not left.is_dir():
            continue
        if found[1] and not out.exists():
            left.rename(out)
        else:
            shutil.rmtree(left, ignore_errors=True)
