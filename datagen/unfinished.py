"""What a killed run leaves beside its output, cleared away by the next one."""

from __future__ import annotations

import re
import shutil
from pathlib import Path


def clear_unfinished(out: Path) -> None:
    """Remove the temporary folders of killed runs beside an output folder.

    A run that was killed between setting the old folder aside and moving the new one into place leaves the
    old one under its temporary name: it comes back.

    Args:
        out: The folder as :func:`lanenet.data.files.atomic_folder` is to write it.
    """
    out = out.resolve()
    if not out.parent.is_dir():
        return
    # As atomic_folder names them; a name that only begins the same is another output's.
    pattern = re.compile(rf"\.{re.escape(out.name)}\.[0-9a-f]{{8}}(\.old)?\.tmp")
    for left in sorted(out.parent.iterdir()):
        found = pattern.fullmatch(left.name)
        if found is None or not left.is_dir():
            continue
        if found[1] and not out.exists():
            left.rename(out)
        else:
            shutil.rmtree(left, ignore_errors=True)
