"""Where results lie: a folder for each, under the hash of what it was made from, in any storage of fsspec.

A result is finished once its marker is there. On a file system a result is filled under a temporary name and
gets its own name in one step, marker and all. An object store has no such step: there the marker is written
last. Either way a result is there as a whole or not at all, and what a lost worker left of one is known by
its missing marker, see :meth:`Storage.sweep`.

Only what a run made is ever removed: a storage is marked before anything is written into it, while none of
the names that are used in it is taken, and below it only results and unfinished ones, known by their names,
are touched.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from lanenet.data.files import require, write_bytes
from lanenet.errors import LanenetError
from lanenet.outputs import make_folder, remove, sync_path

#: The marker of a finished result, and what is known of it.
RESULT_NAME = "result.json"
#: The marker of the storage itself, and what it says.
MARK_NAME = "fleet.yaml"
_MARK = "format: lanenet-fleet/1"
#: What a run writes into its storage; none of it may be there when the storage is marked.
OWN_NAMES = (
    *("maps", "labels", "cameras", "tracks", "drives.json", "index.html"),
    *("checksums.json", "alike.json", "label-all.log"),
)
#: Begins the name of a folder that is being filled.
_TEMPORARY = ".new-"
#: Names below a kind: results, unfinished ones, and the locks and temporary files of these.
_OWN = re.compile(r"[0-9a-f]{16}|\.{1,2}new-[0-9a-f]{16}-[0-9a-f]{8}(\..*)?")


def open_url(url: str) -> tuple[Any, str]:
    """Return the file system of a path or URL, and the path in it.

    Raises:
        LanenetError: If there is no such kind of storage, or its package is not installed.
        MissingExtraError: If fsspec is not installed.
    """
    try:
        system, path = require("fsspec.core", "cluster").url_to_fs(url)
    except (ValueError, ImportError) as error:
        raise LanenetError(f"{url}: cannot be used as storage ({error})") from None
    return system, str(path)


def local_path(url: str) -> Path | None:
    """Return the path of a URL on this machine's file system; None if it is elsewhere."""
    system, path = open_url(url)
    return Path(path) if "file" in _protocols(system) else None


class Storage:
    """Results of several kinds, by key.

    Args:
        url: Folder, or URL of a storage that fsspec knows, such as ``s3://bucket/labels``.

    Raises:
        LanenetError: As :func:`open_url`.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.folder = local_path(url)
        self._system, self._root = open_url(url)

    def finished(self, kind: str) -> set[str]:
        """Return the keys of the finished results of a kind."""
        self._system.invalidate_cache()
        if not self._system.exists(self._at(kind)):
            return set()
        files = [PurePosixPath(file) for file in self._system.find(self._at(kind), maxdepth=2)]
        keys = {file.parent.name for file in files if file.name == RESULT_NAME}
        return {key for key in keys if not key.startswith(".")}

    def result(self, kind: str, key: str) -> dict[str, Any] | None:
        """Return what the marker of a result says; None if it is not finished."""
        self._system.invalidate_cache()
        there = self._system.exists(self._at(kind, key, RESULT_NAME))
        return self.results(kind, [key]).get(key) if there else None

    def results(self, kind: str, keys: Iterable[str]) -> dict[str, dict[str, Any]]:
        """Return what the markers of finished results say; without those that a power cut tore."""
        paths = {self._at(kind, key, RESULT_NAME): key for key in keys}
        found = self._system.cat(list(paths)) if paths else {}
        known = {paths[path]: _parsed(data) for path, data in found.items()}
        return {key: marker for key, marker in known.items() if marker is not None}

    def read(self, *parts: str) -> bytes | None:
        """Return a file; None if it is not there."""
        try:
            return bytes(self._system.cat_file(self._at(*parts)))
        except FileNotFoundError:
            return None

    def read_known(self, name: str) -> dict[str, Any]:
        """Return what a JSON file beside the results says; nothing if it is not there, or torn."""
        return _parsed(self.read(name) or b"{}") or {}

    def read_all(self, kind: str, keys: Iterable[str], name: str) -> dict[str, bytes]:
        """Return a file of each of several finished results, at once; those that lack it are left out."""
        paths = {self._at(kind, key, name): key for key in keys}
        found = self._system.cat(list(paths), on_error="omit") if paths else {}
        return {paths[path]: data for path, data in found.items()}

    @property
    def is_marked(self) -> bool:
        """Whether the storage was marked by :meth:`claim`."""
        return (self.read(MARK_NAME) or b"").startswith(_MARK.encode())

    def claim(self) -> None:
        """Mark the storage, unless it is marked: from now on :data:`OWN_NAMES` in it are those of runs.

        Raises:
            LanenetError: If it is not marked and holds one of them.
        """
        if self.is_marked:
            return
        taken = [name for name in (*OWN_NAMES, MARK_NAME) if self._is_taken(name)]
        if taken:
            raise LanenetError(
                f"{self.url}: has {', '.join(taken)}, which label-all did not make (no {MARK_NAME} of "
                "lanenet), so nothing is written or removed there; choose another --out, or, if an earlier "
                f"version of lanenet made all of it, write the line {_MARK!r} into {MARK_NAME} there"
            )
        self._put(
            MARK_NAME, f"{_MARK}\n# Made by lanenet label-all, which clears up in this folder.\n".encode()
        )

    def _is_taken(self, name: str) -> bool:
        """Tell whether there is anything of a name but an empty folder; a link that leads nowhere counts."""
        if self.folder is None:
            return bool(self._system.exists(self._at(name)))
        path = self.folder / name
        return os.path.lexists(path) and not (path.is_dir() and not any(path.iterdir()))

    def write(self, name: str, data: bytes) -> None:
        """Write a file beside the results, as a whole.

        Raises:
            LanenetError: As :meth:`claim`.
        """
        self.claim()
        self._put(name, data)

    def _put(self, name: str, data: bytes) -> None:
        if self.folder is not None:
            write_bytes(self.folder / name, data)
            return
        self._system.makedirs(self._root, exist_ok=True)
        self._system.pipe_file(self._at(name), data)

    @contextmanager
    def new(self, kind: str, key: str) -> Iterator[Path]:
        """Yield a folder to be filled, with a marker; it becomes the result at the end of the block.

        If another worker has finished the same result meanwhile, that one stays.
        """
        if self.folder is None:
            with tempfile.TemporaryDirectory(prefix="lanenet-") as temporary:
                yield Path(temporary)
                self._upload(Path(temporary), kind, key)
            return
        kept = self.folder / kind / key
        make_folder(kept.parent)
        filled = kept.with_name(f"{_TEMPORARY}{key}-{secrets.token_hex(4)}")
        filled.mkdir()
        try:
            yield filled
            for inside in [*sorted(filled.rglob("*")), filled]:
                sync_path(inside)
            try:
                filled.rename(kept)
            except OSError:
                if not (kept / RESULT_NAME).is_file():
                    raise
            sync_path(kept.parent)
        finally:
            remove(filled)

    @contextmanager
    def fetched(self, kind: str, key: str) -> Iterator[Path]:
        """Yield the folder of a finished result on this machine."""
        if self.folder is not None:
            yield self.folder / kind / key
            return
        with tempfile.TemporaryDirectory(prefix="lanenet-") as temporary:
            self._system.get(f"{self._at(kind, key)}/", f"{temporary}/", recursive=True)
            yield Path(temporary)

    def sweep(self, kind: str, also: Iterable[str] = ()) -> None:
        """Remove what lost workers left of results that they had begun. Only while nobody writes there.

        What has another name than results have stays, and so do links, what lies behind one, and all of a
        storage without a mark.

        Args:
            kind: Of the results.
            also: Keys of finished results that are not wanted any more.
        """
        if self._is_link(kind) or not (self._system.exists(self._at(kind)) and self.is_marked):
            return
        names = {PurePosixPath(path).name for path in self._system.ls(self._at(kind), detail=False)}
        names = {name for name in names if _OWN.fullmatch(name) and not self._is_link(kind, name)}
        unwanted = names & set(also)
        for key in unwanted:
            self._system.rm(self._at(kind, key, RESULT_NAME))
        for name in names - self.results(kind, self.finished(kind) & names - unwanted).keys():
            if self.folder is not None:
                remove(self.folder / kind / name)
            elif self._system.exists(self._at(kind, name)):  # the folder went with its files
                self._system.rm(self._at(kind, name), recursive=True)

    def _is_link(self, *parts: str) -> bool:
        return self.folder is not None and self.folder.joinpath(*parts).is_symlink()

    def _upload(self, folder: Path, kind: str, key: str) -> None:
        """Write a result into an object store, its marker last.

        Two workers that write the same one write the same bytes, but for the times in the marker.
        """
        files = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
        self._system.makedirs(self._at(kind, key), exist_ok=True)
        for name in sorted(files, key=lambda name: name == RESULT_NAME):
            target = PurePosixPath(self._at(kind, key, name))
            self._system.makedirs(str(target.parent), exist_ok=True)
            self._system.put_file(str(folder / name), str(target))

    def _at(self, *parts: str) -> str:
        return "/".join([self._root.rstrip("/"), *parts])


def _parsed(data: bytes) -> dict[str, Any] | None:
    """Return what a JSON file says; None if it is torn, or holds something else."""
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _protocols(system: Any) -> tuple[str, ...]:
    return (system.protocol,) if isinstance(system.protocol, str) else tuple(system.protocol)
