"""MP4 files changed in their boxes (ISO/IEC 14496-12): what phones write and OpenCV's writer does not."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

#: Matrices of a track header that show it turned clockwise by these degrees, in 16.16 fixed point but the
#: last column, which is 2.30.
_ONE, _W = 0x10000, 0x40000000
TURNED = {
    0: (_ONE, 0, 0, 0, _ONE, 0, 0, 0, _W),
    90: (0, _ONE, 0, -_ONE, 0, 0, 0, 0, _W),
    180: (-_ONE, 0, 0, 0, -_ONE, 0, 0, 0, _W),
    270: (0, -_ONE, 0, _ONE, 0, 0, 0, 0, _W),
}
_PARENTS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts")
Change = Callable[[bytes], bytes]


def change_boxes(path: Path, changes: dict[bytes, Change]) -> None:
    """Change the contents of boxes; ``moov`` has to come last, so that no offset moves; OpenCV does that."""
    path.write_bytes(_changed(path.read_bytes(), changes))


def turned(degrees: int) -> dict[bytes, Change]:
    """The track is shown turned clockwise."""

    def change(content: bytes) -> bytes:
        at = 40 if content[0] == 0 else 52
        return content[:at] + struct.pack(">9i", *TURNED[degrees]) + content[at + 36 :]

    return {b"tkhd": change}


def timed(*runs: tuple[int, float]) -> dict[bytes, Change]:
    """The frames come in runs of so many, each so many times as long as the writer's frames are."""

    def change(content: bytes) -> bytes:
        delta = struct.unpack_from(">I", content, 12)[0]
        entries = [struct.pack(">II", count, round(delta * factor)) for count, factor in runs]
        return content[:4] + struct.pack(">I", len(entries)) + b"".join(entries)

    def whole(content: bytes) -> bytes:
        # The writer's edit list ends with the times that it knew.
        return content[:8] + struct.pack(">I", 2**30) + content[12:]

    return {b"stts": change, b"elst": whole}


def _changed(data: bytes, changes: dict[bytes, Change]) -> bytes:
    parts, at = [], 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        content = data[at + 8 : at + size]
        if kind in _PARENTS:
            content = _changed(content, changes)
        elif kind in changes:
            content = changes[kind](content)
        parts.append(struct.pack(">I4s", len(content) + 8, kind) + content)
        at += size
    return b"".join(parts)
