"""Atomic files and folders, and packages that may be missing.

Everything is written under a temporary name beside its destination and moved into place at the end, so that a
crash, a full disk or Ctrl-C never leaves half a file under the final name. One run at a time writes an output
(:mod:`lanenet.outputs`).
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from lanenet.config import read_yaml
from lanenet.errors import ConfigError, LanenetError, MissingExtraError
from lanenet.outputs import is_unfinished, lock_output, put_in_place, sync_path, temporary_output

#: Kinds of folder that may be replaced, and the files without which none is complete. Each holds
#: ``<kind>.yaml`` with ``format: lanenet-<kind>/n``.
FOLDER_KINDS: dict[str, tuple[str, ...]] = {
    "drive": ("drive.yaml", "frames.csv"),
    "map": (
        *("map.yaml", "settings.yaml", "camera.yaml", "poses.csv", "trajectory.tum"),
        *("lanes.json", "edges.parquet", "report.json"),
    ),
    # Maps of several drives of one track.
    "joined": ("joined.yaml", "join.json"),
    # Of a drive that gave no map; a map replaces it.
    "refused": ("refused.yaml", "report.html"),
    "export": ("export.yaml", "README.md", "camera.yaml"),
    "checkpoint": ("checkpoint.yaml", "config.yaml", "metrics.json", "weights.safetensors", "model.onnx"),
}
#: What else lanenet writes into such folders. All other names in them are those of others, and stay when the
#: folder is replaced.
_ALSO_MADE: dict[str, tuple[str, ...]] = {
    "drive": ("camera.yaml", "images", "truth.csv", "track.json", "simulation.yaml"),
    "map": (
        *("open_loop.tum", "map.png", "frames.png", "report.html", "map.done.json"),
        *("refused.yaml", "report-refused.html", "result.json", "thumbnail.jpg"),
    ),
    "joined": ("map.png", "result.json", "thumbnail.jpg"),
    "refused": (),
    "export": ("images", "train", "labels.parquet", "annotations.json", "label_data.json"),
    "checkpoint": (
        *("run.yaml", "camera.yaml", "robustness.json", "report.html", "results.json", "results.md"),
        *("results.png", "results-breakdown.png", "results-worst.jpg", "results-plain.jpg", "curve.csv"),
        *("curve.png", "check_rasters.png", "calibration_rasters.png", "MODEL_CARD.md", "DATA_SHEET.md"),
        *("data_sheet.json", "example.jpg", "example.png"),
    ),
}


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
        path: Destination; missing parent folders are made, an existing file is replaced. A file of a folder
            that is itself temporary gets its name at once.

    Yields:
        A path in the same folder with the same ending, for the block to write. Removed on any error.

    Raises:
        LanenetError: If the destination is no regular file, cannot be written, or is being written by another
            run.
    """
    path = Path(path).resolve()
    _check_no_other_kind(path)
    if is_unfinished(path):
        yield path
        return
    with lock_output(path), temporary_output(path, path.suffix) as temporary:
        yield temporary
        sync_path(temporary)
        temporary.replace(path)
        sync_path(path.parent)


@contextmanager
def atomic_folder(path: Path, kind: str, check: Callable[[Path], object] | None = None) -> Iterator[Path]:
    """Fill a folder under a temporary name and move it to ``path`` when the block ends well.

    An existing folder is replaced only if it is empty or an earlier output: it must hold ``<kind>.yaml`` with
    ``format: lanenet-<kind>/...``. The new folder has to hold all files of :data:`FOLDER_KINDS`. What others
    put into the old folder lies in the new one, too.

    Args:
        path: Destination; missing parent folders are made.
        kind: What the folder is, one of :data:`FOLDER_KINDS`.
        check: Reads the filled folder, and raises a LanenetError if that is not possible.

    Yields:
        The temporary folder. Removed with all its contents on any error.

    Raises:
        LanenetError: If the destination is a file or a folder that lanenet did not write, cannot be written,
            or is being written by another run; or if the new folder is not complete.
    """
    path = Path(path).resolve()
    with lock_output(path):
        check_replaceable(path, kind)
        with temporary_output(path) as temporary:
            temporary.mkdir()
            yield temporary
            _check_complete(temporary, path, kind, check)
            # The destination may have changed while the block ran.
            check_replaceable(path, kind)
            _keep_others(path, temporary, kind)
            for inside in sorted(temporary.rglob("*")):
                if not inside.is_symlink() and (inside.is_file() or inside.is_dir()):
                    sync_path(inside)
            sync_path(temporary)
            put_in_place(temporary, path)


def check_destination(path: Path) -> None:
    """Refuse a file that could not be written, before the work starts; creates nothing.

    Raises:
        LanenetError: If the destination is no regular file, or lies below a file or a folder that cannot be
            written to.
    """
    path = Path(path).resolve()
    _check_no_other_kind(path)
    parent = next(folder for folder in path.parents if folder.exists())
    if not parent.is_dir():
        raise LanenetError(f"{path}: cannot be written, {parent} is a file, expected a folder")
    if not os.access(parent, os.W_OK):
        raise LanenetError(f"{path}: cannot be written, the folder {parent} is read-only")


def check_replaceable(path: Path, kind: str) -> None:
    """Refuse a folder that :func:`atomic_folder` would not replace, before the work starts.

    Args:
        path: Destination; may be missing.
        kind: What the folder will be, one of :data:`FOLDER_KINDS`.

    Raises:
        LanenetError: If the destination is a file, a mounted disk or a folder that lanenet did not write.
    """
    path = Path(path).resolve()
    if not path.exists():
        return
    if not path.is_dir():
        raise LanenetError(f"{path}: is a file, expected a folder to write")
    if path.is_mount():
        # Only the names of folders on one file system can be exchanged.
        raise LanenetError(
            f"{path}: a disk is mounted there, which cannot be replaced; choose a folder on it"
        )
    if not any(path.iterdir()):
        return
    if not _holds_marker(path, kind) and not (kind == "map" and _holds_marker(path, "refused")):
        raise LanenetError(
            f"{path}: the folder is not empty and holds no {kind}.yaml of lanenet, so it is not replaced; "
            "choose another name or remove it"
        )
    if kind == "drive" and not (path / "truth.csv").is_file():
        raise LanenetError(
            f"{path}: holds a drive without truth.csv, so one that was recorded and cannot be made again; it "
            "is not replaced, choose another name"
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
    null: JSON has no value for them. Halves of characters, as in names that are no UTF-8, are escaped.
    """
    text = json.dumps(_plain(obj), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    return re.sub("[\ud800-\udfff]", lambda half: f"\\u{ord(half[0]):04x}", text)


def write_json(path: Path, obj: Any) -> None:
    """Write :func:`json_text` atomically."""
    write_text(path, json_text(obj))


def _check_no_other_kind(path: Path) -> None:
    """Refuse to replace what is there and no file: a folder, but also a device (``/dev/null``) or a pipe."""
    if path.is_dir():
        raise LanenetError(f"{path}: is a folder, expected a file to write")
    if path.exists() and not path.is_file():
        raise LanenetError(f"{path}: is a device or a pipe, expected a file to write")


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


def _check_complete(folder: Path, path: Path, kind: str, check: Callable[[Path], object] | None) -> None:
    """Refuse to replace anything by a folder that lacks a file or cannot be read."""
    empty = [n for n in FOLDER_KINDS[kind] if not ((folder / n).is_file() and (folder / n).stat().st_size)]
    if empty or not _holds_marker(folder, kind):
        raise LanenetError(
            f"{path}: not written: of the new {kind} {', '.join(empty) or f'{kind}.yaml'} is missing or empty"
        )
    try:
        if check is not None:
            check(folder)
    except LanenetError as error:
        raise LanenetError(f"{path}: not written: the new {kind} cannot be read ({error})") from error


def _keep_others(path: Path, new: Path, kind: str) -> None:
    """Copy what others put into a folder into the one that replaces it, as hard links where possible."""
    if not path.is_dir():
        return
    made = [*FOLDER_KINDS[kind], *_ALSO_MADE[kind]]
    if kind == "joined" and _holds_marker(path, kind):
        members = read_yaml(path / "joined.yaml").get("drives")
        made += [str(one.get("map")) for one in members or () if isinstance(one, dict)]
    for own in path.iterdir():
        kept = new / own.name
        if kept.exists() or own.name in made:
            continue
        if own.is_dir() and not own.is_symlink():
            shutil.copytree(own, kept, symlinks=True, copy_function=_link_or_copy)
        else:
            _link_or_copy(str(own), str(kept))


def _link_or_copy(source: str, target: str) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:  # a file system without links
        shutil.copy2(source, target, follow_symlinks=False)


def _holds_marker(path: Path, kind: str) -> bool:
    try:
        found = read_yaml(path / f"{kind}.yaml").get("format")
    except ConfigError:
        return False
    return isinstance(found, str) and found.startswith(f"lanenet-{kind}/")
