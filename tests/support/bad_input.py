"""A table of bad input: what is done, which error it has to raise, and what the error has to name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from lanenet.errors import LanenetError


@dataclass(frozen=True)
class Bad:
    """One row of a table.

    Attributes:
        what: What is wrong, for the name of the test.
        act: Makes the bad input in an empty folder and reads it.
        error: Type of the error.
        named: File, key, line, number or the like, all of which the message has to contain.
    """

    what: str
    act: Callable[[Path], Any]
    error: type[LanenetError]
    named: tuple[str, ...]

    def check(self, folder: Path) -> None:
        with pytest.raises(self.error) as caught:
            self.act(folder)
        assert type(caught.value) is self.error
        for word in self.named:
            assert word in str(caught.value), f"{word!r} is not named in: {caught.value}"


def each(table: list[Bad]) -> Any:
    """Run a test once for every row, as its argument ``bad``."""
    assert len({bad.what for bad in table}) == len(table), "two rows have one name"
    return pytest.mark.parametrize("bad", table, ids=[bad.what.replace(" ", "-") for bad in table])
