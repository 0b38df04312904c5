"""A drive that was never recorded, for tests of what happens before an image is read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lanenet.data.drives.recording import Commands, Drive


class _NoImages:
    def read(self, row: int) -> np.ndarray:
        raise AssertionError("no image is needed here")


def made_up_drive(n: int, breaks: Sequence[int] = (), first_frame: int = 0) -> Drive:
    """Return a drive of n frames; those of ``breaks`` do not follow the one before them.

    Recordings do not always count from 0, hence ``first_frame``.
    """
    return Drive(
        name="made-up",
        path=Path("made-up"),
        frames=np.arange(n) + first_frame,
        t_s=0.05 * np.arange(n),
        times_trusted=True,
        commands=Commands(),
        deleted=np.zeros(n, dtype=bool),
        breaks=np.isin(np.arange(n), breaks),
        camera=None,
        lane_width_cm=None,
        problems=(),
        width=160,
        height=120,
        images=_NoImages(),
        rows=np.arange(n),
    )
