"""What a viewer is: it is shown drawings of frames, in a file or live."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from lanenet.viewers.drawing import Artist, Drawing


@runtime_checkable
class Viewer(Protocol):
    """Shows a drive, or stores it for a program that shows it."""

    def begin(self, artist: Artist) -> None:
        """Show what stays the same: ``artist.scene``."""
        ...

    def add(self, drawing: Drawing) -> None:
        """Show a frame."""
        ...

    def close(self) -> None:
        """Finish the file, or let go of the program."""
        ...


@dataclass(frozen=True)
class ViewerKind:
    """A viewer as :mod:`lanenet.viewers.registry` lists it; its module defines it.

    Attributes:
        name: Of its option: ``rerun`` for ``--rerun``.
        open: Opens a file to write, or an address; called with one of them.
        check: Raises MissingExtraError if its package is not installed.
        ending: Of its files.
        help: Of its option.
        to_look: How a person looks at a file of its, with ``{file}`` for the file.
        addresses: What targets begin with that are no files.
    """

    name: str
    open: Callable[[str], Viewer]
    check: Callable[[], object]
    ending: str
    help: str
    to_look: str
    addresses: tuple[str, ...] = ()

    @property
    def metavar(self) -> str:
        """What the option expects, for its help."""
        return "|".join([f"FILE{self.ending}", *self.addresses])

    def is_file(self, target: str) -> bool:
        """Tell whether a target is a file to write."""
        return not target.startswith(self.addresses)
