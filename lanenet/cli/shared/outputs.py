"""Checks of output paths, before the work starts."""

from __future__ import annotations

import fnmatch
from pathlib import Path

from lanenet.errors import ConfigError


def check_ending(path: Path, *endings: str) -> None:
    """Refuse an output whose ending is not one of its format.

    Raises:
        ConfigError: Names the endings.
    """
    if path.suffix.lower() not in endings:
        raise ConfigError(f"{path}: expected a name that ends in {' or '.join(endings)}")


def check_not_source(source: Path, *outs: Path | None) -> None:
    """Refuse an output that would replace a file of the source, or be read as part of it next time.

    Args:
        source: Photo, video, folder of photos, drive, tub, map or label set.
        outs: Files to write; None for none.

    Raises:
        ConfigError: Names the output and the source.
    """
    for out in outs:
        if out is not None and _belongs_to(source, source.resolve(), out.resolve()):
            raise ConfigError(
                f"{out}: is a file of {source}, which this command reads, or would be taken for one; choose "
                "another name"
            )


def _belongs_to(source: Path, resolved: Path, out: Path) -> bool:
    # Imported here: commands that read no drive need not wait for OpenCV.
    from lanenet.data.drives import FORMATS, find_format
    from lanenet.data.drives.sources import PHOTO_ENDINGS

    if not resolved.is_dir():
        # A link may lead elsewhere, but the files beside a source are found by the name that was given.
        files = [pattern for known in FORMATS for pattern in known.files if "{stem}" in pattern]
        ending = source.suffix.lower()
        files = ["{stem}.json", "{stem}.png"] if ending == ".parquet" else files
        files = [] if ending in PHOTO_ENDINGS else files
        folder = source.parent.resolve()
        return out == resolved or out in {folder / name.format(stem=source.stem) for name in files}
    if resolved not in out.parents:
        return False
    if (resolved / "map.yaml").is_file():
        return out.exists()
    files = [pattern for known in FORMATS for pattern in known.files]
    is_drive_file = any(fnmatch.fnmatch(out.name.lower(), pattern) for pattern in files)
    if is_drive_file and out.parent == resolved and find_format(resolved) is not None:
        return True
    return out.exists() and out.suffix.lower() in PHOTO_ENDINGS
