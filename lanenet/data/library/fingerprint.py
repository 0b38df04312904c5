"""By what a recording is known again, whatever its name: the bytes of its images, and what they show."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt64

from lanenet.data.drives.recording import COMMAND_NAMES, Drive, StoredImages
from lanenet.errors import DriveFormatError

#: Bytes of a video that are read at a time; chosen.
_CHUNK = 2**20
#: Side of the small gray image, and of the square of its lowest frequencies. Chosen: 16 times 16 tell laps of
#: one track from copies; 8 times 8 do not.
_SIDE_PX, _FREQUENCIES = 32, 16
#: Bytes of a frame: a bit for each frequency, and as many for which of them count.
HASH_BYTES = 2 * _FREQUENCIES**2 // 8
#: Share of the frequencies that do not count, the weakest: their signs are noise. Measured on four tubs,
#: encoded again in six ways: with a quarter left out, 0.1 % of the signs of a copy differ at most (mean of 16
#: frames), with none left out 7 %.
_WEAK = 0.25
#: A gray image whose frequencies are all below this has nothing to be known by; chosen, in gray levels.
_FLAT = 1e-3


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """By what a drive's frames are known again.

    Attributes:
        frames: Frame numbers, increasing.
        digests: First eight bytes of the SHA-256 of each image as it is stored, of a video as it is decoded;
            0 if it cannot be read.
        hashes: Of what each frame shows: the signs of the lowest frequencies of its small gray image (a
            discrete cosine transform, as in pHash by Zauner 2010), then which of them are strong enough to
            count; no bit of an image that cannot be read or shows nothing.
    """

    frames: Int[np.ndarray, "n"]
    digests: UInt64[np.ndarray, "n"]
    hashes: UInt8[np.ndarray, "n b"]

    def __len__(self) -> int:
        return len(self.frames)

    def to_bytes(self) -> bytes:
        """Return it as little-endian bytes: all frame numbers, digests, then hashes."""
        numbers = self.frames.astype("<i8").tobytes() + self.digests.astype("<u8").tobytes()
        return numbers + self.hashes.tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> Fingerprint:
        """Read what :meth:`to_bytes` wrote.

        Raises:
            ValueError: If it cannot be that.
        """
        n = len(data) // (16 + HASH_BYTES)
        frames, digests = np.frombuffer(data, "<i8", n), np.frombuffer(data, "<u8", n, 8 * n)
        hashes = np.frombuffer(data, np.uint8, -1, 16 * n).reshape(n, HASH_BYTES)
        return cls(frames.astype(np.int64), digests.astype(np.uint64), hashes)


def take_fingerprint(
    drive: Drive, progress: Callable[[int, int], object] | None = None
) -> tuple[Fingerprint, str]:
    """Read all of a drive once.

    Args:
        drive: The drive.
        progress: Called with (frames done, frames).

    Returns:
        Its fingerprint, and its checksum: the SHA-256 of its images as they are stored and of its commands,
        in order. The same images and commands give the same, be they a tub or a drive folder; times do not
        count. The images of a video are its file. An image that cannot be read counts as an empty one.

    Raises:
        DriveFormatError: If a video's file cannot be read.
    """
    whole = hashlib.sha256()
    digests, hashes = np.zeros(len(drive), np.uint64), np.zeros((len(drive), HASH_BYTES), np.uint8)
    stored = drive.images if isinstance(drive.images, StoredImages) else None
    for i, row in enumerate(drive.rows.tolist()):
        data, image = b"", None
        try:
            data = b"" if stored is None else stored.data(row)
            image = drive.images.read(row)
        except DriveFormatError:  # said where the drive is used
            pass
        if stored is None and image is not None:
            data = image.tobytes()
        digest = hashlib.sha256(data).digest()
        if stored is not None:
            whole.update(digest)
        if image is not None:
            digests[i], hashes[i] = int.from_bytes(digest[:8], "little"), hash_image(image)
        if progress is not None:
            progress(i + 1, len(drive))
    if stored is None:
        _add_file(drive, whole)
    _add_commands(drive, whole)
    return Fingerprint(drive.frames, digests, hashes), whole.hexdigest()


def checksum(drive: Drive) -> str:
    """Return the checksum of :func:`take_fingerprint`, without decoding an image.

    Raises:
        DriveFormatError: If a video's file cannot be read.
    """
    whole = hashlib.sha256()
    if not isinstance(drive.images, StoredImages):
        _add_file(drive, whole)
    else:
        for row in drive.rows.tolist():
            try:
                data = drive.images.data(row)
            except DriveFormatError:
                data = b""
            whole.update(hashlib.sha256(data).digest())
    _add_commands(drive, whole)
    return whole.hexdigest()


def hash_image(image_bgr: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "b"]:
    """Return the hash of what one image shows; see :class:`Fingerprint`."""
    gray = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    small = cv2.resize(gray, (_SIDE_PX, _SIDE_PX), interpolation=cv2.INTER_AREA)
    found: Float[np.ndarray, "k k"] = cv2.dct(small.astype(np.float32))[:_FREQUENCIES, :_FREQUENCIES]
    values = found.ravel()
    # The mean brightness says nothing.
    values[0] = 0.0
    strength = np.abs(values)
    strong = strength > max(float(np.quantile(strength, _WEAK)), _FLAT)
    return np.packbits(np.concatenate([(values > 0.0) & strong.any(), strong]))


def _add_file(drive: Drive, whole: hashlib._Hash) -> None:
    try:
        with drive.path.open("rb") as stream:
            while chunk := stream.read(_CHUNK):
                whole.update(chunk)
    except OSError as error:
        raise DriveFormatError(f"{drive.path}: cannot be read ({error})") from None
    whole.update(drive.rows.astype("<i8").tobytes())


def _add_commands(drive: Drive, whole: hashlib._Hash) -> None:
    for name in COMMAND_NAMES:
        values = getattr(drive.commands, name)
        if values is not None:
            whole.update(name.encode() + values.astype("<f8").tobytes())
