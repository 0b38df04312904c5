"""How much memory the work on a drive takes."""

from __future__ import annotations

from collections.abc import Iterable

from datagen.fleet.source import drive_files
from datagen.fleet.storage import local_path
from datagen.prepare import MOST_IMAGE_BYTES
from lanenet.data.drives import open_drive
from lanenet.errors import LanenetError

#: Taken by the program, also while it compiles its loops; taken for each frame beside its image, [bytes].
#: Measured (docs/fleet.md): 360 MB, 120 MB more while compiling, and 0.31 MB a frame; the rest is reserve.
_FIXED, _PER_FRAME = 500_000_000, 360_000
#: Least number of frames that a drive in an object store is taken to have, since a video is one file. Chosen:
#: 150 s at 20 frames a second.
_UNSEEN_FRAMES = 3000


def memory_bytes(source: str) -> int:
    """Return how much memory the work on a drive is to be given, [bytes].

    Args:
        source: Path or URL of the drive.
    """
    path = local_path(source)
    if path is None:
        return stated_bytes(max(len(drive_files(source)), _UNSEEN_FRAMES), MOST_IMAGE_BYTES)
    try:
        drive = open_drive(path)
    except (LanenetError, OSError):  # it will be refused
        return _FIXED
    return stated_bytes(len(drive), drive.width * drive.height)


def memory_together(sources: Iterable[str]) -> int:
    """Return how much memory work on several drives at once is to be given, [bytes].

    Measured on two drives of 750 frames of 160 x 120, for which it states 1130 MB: 580 MB for their camera,
    820 MB to join their maps.

    Args:
        sources: Paths or URLs of the drives.
    """
    return _FIXED + sum(memory_bytes(source) - _FIXED for source in sources)


def stated_bytes(frames: int, pixels: int) -> int:
    """Return the memory for a drive of so many frames of so many pixels, [bytes].

    Its images are kept in memory up to a bound, see :mod:`datagen.prepare`.
    """
    return _FIXED + _PER_FRAME * frames + min(3 * pixels * frames, MOST_IMAGE_BYTES)
