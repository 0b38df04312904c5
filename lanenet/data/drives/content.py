"""By what the source of a derived file is known again: the bytes of its images and files, wherever they lie.

A mark is the size and the digest of an image as it is stored, ``SIZE-DIGEST``; the digest is that of
:class:`lanenet.data.library.fingerprint.Fingerprint`. Times on disk change when a folder is copied, and
names are used again when it is recorded anew, as Donkeycar does: neither says what a drive is. Sizes are
compared for every image and digests for a sample, so that a drive of 20,000 frames takes less than a second.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from lanenet.data.drives import PHOTO_ENDINGS
from lanenet.data.drives.recording import Drive, ImageFiles, StoredImages
from lanenet.errors import DriveFormatError

#: Images of which the digest is taken, evenly over a drive, and pieces of a large file. Chosen: 64 images
#: take 10 ms, and of a part of a drive that was replaced, a sixty-fourth or more is seen.
_SAMPLE = 64
#: A file up to this size is read as a whole; of a larger one, pieces of the second size. Chosen: the tables
#: of 100,000 frames are smaller, videos are larger; 64 pieces take milliseconds.
_WHOLE, _PIECE = 2**25, 2**14
#: Bytes of a digest.
_DIGEST_BYTES = 8


def mark_of(data: bytes) -> str:
    """Return the mark of an image as it is stored."""
    return f"{len(data)}-{hashlib.sha256(data).digest()[:_DIGEST_BYTES].hex()}"


def file_mark(path: Path) -> str:
    """Return the mark of a file; of a large one its size and a sample of its bytes count.

    Raises:
        DriveFormatError: If it cannot be read.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            if size <= _WHOLE:
                return mark_of(stream.read())
            whole = hashlib.sha256()
            for start in np.linspace(0, size - _PIECE, _SAMPLE).astype(np.int64).tolist():
                stream.seek(start)
                whole.update(stream.read(_PIECE))
    except OSError as error:
        raise DriveFormatError(f"{path}: cannot be read ({error})") from None
    return f"{size}-{whole.digest()[:_DIGEST_BYTES].hex()}"


def image_marks(drive: Drive) -> list[str]:
    """Return the mark of each frame's image; of a video that of its file, "" where nothing can be read."""
    images = drive.images
    if not isinstance(images, StoredImages):
        return [file_mark(drive.path)] * len(drive)
    marks = []
    for row in drive.rows.tolist():
        try:
            marks.append(mark_of(images.data(row)))
        except DriveFormatError:  # said where the drive is used
            marks.append("")
    return marks


def other_images(drive: Drive, marks: Sequence[str], every: bool = False) -> Bool[np.ndarray, "n"]:
    """Find the frames whose image is another one than before.

    Sizes are compared for all frames, digests for a sample; for all if one is another one.

    Args:
        drive: As many frames as there are marks.
        marks: What :func:`image_marks` returned; frames with an empty mark are not compared.
        every: Compare all digests.

    Returns:
        True where the image is another one. An image that is not there any more is not another one.
    """
    images, known = drive.images, np.array([bool(mark) for mark in marks])
    if not isinstance(images, StoredImages):
        return known & (np.array(marks) != file_mark(drive.path))
    other = np.zeros(len(drive), dtype=bool)
    compared = np.flatnonzero(known)
    if isinstance(images, ImageFiles) and not every:
        for k in compared.tolist():
            size = _size(images.paths[int(drive.rows[k])])
            other[k] = size is not None and size != int(marks[k].partition("-")[0])
    if not (every or other.any()):
        compared = compared[np.linspace(0, len(compared) - 1, min(_SAMPLE, len(compared))).astype(int)]
    for k in compared.tolist():
        try:
            other[k] = mark_of(images.data(int(drive.rows[k]))) != marks[k]
        except DriveFormatError:
            other[k] = False
    return (
        other
        if every or not other.any() or len(compared) == known.sum()
        else other_images(drive, marks, True)
    )


def content_key(path: Path) -> str:
    """Return what changes when a recording does: the names, sizes and bytes of its files, of images a sample.

    Args:
        path: A folder, or a file.

    Raises:
        DriveFormatError: If a file cannot be read.
    """
    if path.is_file():
        return file_mark(path)
    walked = ((Path(folder), inside) for folder, _, inside in os.walk(path))
    files = sorted(folder / name for folder, inside in walked for name in inside if name[0] != ".")
    photos = [file for file in files if file.suffix.lower() in PHOTO_ENDINGS]
    sampled = {photos[k] for k in np.linspace(0, len(photos) - 1, min(_SAMPLE, len(photos))).astype(int)}
    unread, whole = {*photos} - sampled, hashlib.sha256()
    for file in files:
        read = file not in unread and file.is_file()
        mark = file_mark(file) if read else _size(file)
        # Names of other systems need not be UTF-8.
        whole.update(f"{file.relative_to(path)}\0{mark}\n".encode(errors="surrogatepass"))
    return whole.hexdigest()


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None
