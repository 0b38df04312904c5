"""By what a recording is known again, whatever its name."""

from __future__ import annotations

import hashlib

from lanenet.data.drives.recording import COMMAND_NAMES, Drive, StoredImages
from lanenet.errors import DriveFormatError

#: Bytes of a video that are read at a time; chosen.
_CHUNK = 2**20


def checksum(drive: Drive) -> str:
    """Return the SHA-256 of a drive's images as they are stored and of its commands, in order.

    The same images and commands give the same, be they a tub or a drive folder; times do not count. The
    images of a video are its file. An image that cannot be read counts as an empty one.

    Raises:
        DriveFormatError: If the video cannot be read.
    """
    whole = hashlib.sha256()
    if isinstance(drive.images, StoredImages):
        for row in drive.rows.tolist():
            try:
                data = drive.images.data(row)
            except DriveFormatError:
                data = b""
            whole.update(hashlib.sha256(data).digest())
    else:
        try:
            with drive.path.open("rb") as stream:
                while chunk := stream.read(_CHUNK):
                    whole.update(chunk)
        except OSError as error:
            raise DriveFormatError(f"{drive.path}: cannot be read ({error})") from None
        whole.update(drive.rows.astype("<i8").tobytes())
    for name in COMMAND_NAMES:
        values = getattr(drive.commands, name)
        if values is not None:
            whole.update(name.encode() + values.astype("<f8").tobytes())
    return whole.hexdigest()
