"""Where commands may write: refused before the work starts, not after it."""

from __future__ import annotations

from pathlib import Path

from lanenet.errors import ConfigError


def check_ending(path: Path, *endings: str) -> None:
    """Refuse an output whose name does not end as its format does.

    Raises:
        ConfigError: Names the endings.
    """
    if path.suffix.lower() not in endings:
        raise ConfigError(f"{path}: expected a name that ends in {' or '.join(endings)}")
