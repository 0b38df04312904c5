"""The bytes of a drive: where they lie, what they hash to, and how a worker gets at them.

A drive is read where it lies if that is a path, which then has to be the same on every machine. A URL of an
object store is fetched to the machine that works on it.
"""

from __future__ import annotations

import hashlib
import json
import platform
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from datagen.fleet.storage import local_path, open_url
from lanenet.data.drives import FORMATS
from lanenet.errors import DriveFormatError, LanenetError

#: Read at a time, [bytes]; chosen.
_BLOCK = 1 << 20


def drive_files(source: str) -> dict[str, str]:
    """Return the files of a drive with what changes when they do: size, and time or hash of the storage.

    Pipes, devices and links that lead nowhere are no files: reading them may never end.

    Args:
        source: Path or URL of a folder, or of a file with those beside it that belong to it.

    Raises:
        DriveFormatError: If there is no such drive.
    """
    system, path = open_url(source)
    if not system.exists(path):
        raise DriveFormatError(f"{source}: no such drive")
    if system.isdir(path):
        found = system.find(path, detail=True)
    else:
        stem = PurePosixPath(path).stem
        beside = [
            f"{system._parent(path)}/{name.format(stem=stem)}"
            for known in FORMATS
            for name in known.files
            if "{stem}" in name
        ]
        found = {file: system.info(file) for file in [path, *filter(system.exists, dict.fromkeys(beside))]}
    found = {name: info for name, info in found.items() if info["type"] == "file"}
    if not found:
        raise DriveFormatError(f"{source}: holds no file that can be read, expected a drive")
    return {
        name: json.dumps([info["size"], str(info.get("ETag") or info.get("mtime") or info.get("created"))])
        for name, info in sorted(found.items())
    }


def checksum(source: str) -> str:
    """Hash the content of a drive: the names of its files, below its own, and their bytes.

    Raises:
        DriveFormatError: If there is no such drive.
    """
    system, path = open_url(source)
    whole = hashlib.sha256()
    for file in drive_files(source):
        digest = hashlib.sha256()
        with system.open(file, "rb") as opened:
            while block := opened.read(_BLOCK):
                digest.update(block)
        # A drive that consists of files named like it is the same under another name.
        inside = (
            file.removeprefix(f"{path}/")
            if system.isdir(path)
            else PurePosixPath(file).name.partition(".")[2]
        )
        # Names of other systems need not be UTF-8.
        whole.update(f"{inside}\0{digest.hexdigest()}\n".encode(errors="surrogatepass"))
    return whole.hexdigest()


@contextmanager
def on_this_machine(source: str) -> Iterator[Path]:
    """Yield the drive as a path of this machine.

    Raises:
        LanenetError: If it is not there.
    """
    here = local_path(source)
    if here is not None:
        if not here.exists():
            raise LanenetError(
                f"{here}: is not there on {platform.node()}: drives have to lie on storage that all machines "
                "share, under the same path"
            )
        yield here
        return
    system, path = open_url(source)
    with tempfile.TemporaryDirectory(prefix="lanenet-") as folder:
        for file in drive_files(source):
            inside = PurePosixPath(file).relative_to(system._parent(path))
            fetched = Path(folder) / inside
            fetched.parent.mkdir(parents=True, exist_ok=True)
            system.get_file(file, str(fetched))
        yield Path(folder) / PurePosixPath(path).name
