"""What is made once: each output has a marker beside it, with a hash of everything it was made from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lanenet.config import Settings
from lanenet.data.drives import find_format, meant_instead
from lanenet.data.drives.content import content_key
from lanenet.data.files import write_json
from lanenet.errors import ConfigError, DriveFormatError
from lanenet.outputs import lock_output
from lanenet.reading import read_json

_VERSION = 16  # of drives, maps and label sets; raise it when the same settings give others


def key_of(*parts: object) -> str:
    """Hash what an output is made from: settings, dataclasses and plain values; the order of keys is free."""
    text = json.dumps([_VERSION, parts], sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    return value.model_dump(mode="json") if isinstance(value, Settings) else asdict(value)


def fingerprint(path: Path) -> str:
    """Hash what a recording, or another source of an output, is made of: cheap, and changes when that does.

    Of a drive its content counts (:func:`lanenet.data.drives.content.content_key`), with the files beside one
    that is a file; it may have been copied. Of anything else it is name, size and time of the files, by which
    too much may be made again, but never too little.

    Raises:
        DriveFormatError: If the recording does not exist.
    """
    if not path.exists():
        raise DriveFormatError(f"{path}: no such drive{meant_instead(path)}")
    known = find_format(path)
    if known is not None:
        beside = [path.with_name(name.format(stem=path.stem)) for name in known.files if "{stem}" in name]
        found = [path, *(file for file in beside if file.is_file() and path.is_file())]
        return key_of(*(content_key(file) for file in found))
    files = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.is_file())
    return key_of(*((p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files))


@dataclass(frozen=True)
class Output:
    """A file that is made from something, and the :func:`key_of` that something.

    A folder is represented by the file in it that is written last.

    Attributes:
        path: The file.
        key: What it is made from.
        moves: It lies in a folder that is replaced as a whole, and takes the marker with it: an old one stays
            known for what it is until then.
    """

    path: Path
    key: str
    moves: bool = False

    @property
    def _marker(self) -> Path:
        return self.path.with_name(f"{self.path.stem}.done.json")

    @property
    def done(self) -> bool:
        """Whether the file exists, is complete and was made from what the key stands for."""
        try:
            marked = read_json(self._marker, ConfigError) == {"key": self.key}
        except ConfigError:  # missing, not text, or not JSON
            return False
        return marked and self.path.is_file()

    def forget(self) -> None:
        """Remove the marker before the file is made again."""
        self._marker.unlink(missing_ok=True)

    def mark(self) -> None:
        """Mark the file as complete; a job that is killed before this is repeated."""
        write_json(self._marker, {"key": self.key})

    def make(self, make: Callable[[], object]) -> None:
        """Call ``make`` unless the file is done."""
        if not self.done:
            if not self.moves:
                self.forget()
            make()
            self.mark()

    def make_alone(self, make: Callable[[], object]) -> None:
        """As :meth:`make`, and keep other runs from making the file at the same time.

        Raises:
            LanenetError: If another run makes it.
        """
        if not self.done:
            with lock_output(self.path):
                self.make(make)
