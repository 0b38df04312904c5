"""Headers of image files: size and orientation, read before, and apart from, the decoder.

The decoders of OpenCV's versions differ in which formats they turn as Exif says; here all are alike.
"""

from __future__ import annotations

import struct

_TIFF = (b"II*\0", b"MM\0*")
_ORIENTATION_TAG = 274


def image_size(data: bytes) -> tuple[int, int] | None:
    """Read width and height from an image's header; None if the format is unknown or the header damaged.

    Formats: JPEG (ITU-T T.81, B.2.2), PNG, BMP, WebP (RFC 9649), TIFF 6.0, Netpbm. OpenCV reads others, too,
    but no camera writes them.
    """
    try:
        for start, read in _SIZE_READERS:
            if data.startswith(start):
                size = read(data)
                return size if size is not None and min(size) > 0 else None
    except (struct.error, ValueError, IndexError, KeyError):
        pass
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    # Chosen: far more segments than any camera writes; a file of nothing but markers would take seconds.
    for _ in range(10_000):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        # Frame headers, without the tables DHT, JPG and DAC between them.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker in (0xD9, 0xDA):
            return None
        if marker == 0xFF:  # a filling byte
            at += 1
        elif 0xD0 <= marker <= 0xD7 or marker == 1:  # restart markers and TEM have no length
            at += 2
        else:
            at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


def _png_size(data: bytes) -> tuple[int, int] | None:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _bmp_size(data: bytes) -> tuple[int, int] | None:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    return abs(width), abs(height)


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[8:16]
    if kind == b"WEBPVP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"WEBPVP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"WEBPVP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    found = _tiff_tags(data)
    return found[256][1], found[257][1]


def _tiff_tags(data: bytes) -> dict[int, tuple[int, int]]:
    """Return place and value of the tags in the first directory of TIFF or Exif data."""
    order = "<" if data[:2] == b"II" else ">"
    directory = struct.unpack_from(order + "I", data, 4)[0]
    found: dict[int, tuple[int, int]] = {}
    for k in range(struct.unpack_from(order + "H", data, directory)[0]):
        at = directory + 2 + 12 * k
        tag, kind = struct.unpack_from(order + "HH", data, at)
        found[tag] = at + 8, struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 8)[0]
    return found


def _netpbm_size(data: bytes) -> tuple[int, int] | None:
    # A comment runs to the end of its line.
    lines = (line.partition(b"#")[0] for line in data[2:4096].split(b"\n"))
    words = b" ".join(lines).split()
    return int(words[0]), int(words[1])


_SIZE_READERS = (
    (b"\xff\xd8", _jpeg_size),
    (b"\x89PNG\r\n\x1a\n", _png_size),
    (b"BM", _bmp_size),
    (b"RIFF", _webp_size),
    (b"II*\0", _tiff_size),
    (b"MM\0*", _tiff_size),
    *((b"P%d" % kind, _netpbm_size) for kind in (1, 2, 3, 4, 5, 6)),
)


def orientation(data: bytes) -> int:
    """Return how an image is turned when it is shown: 1 to 8, as Exif's tag; 1 where it does not say.

    Formats: JPEG, PNG, WebP, TIFF. Source: Exif 2.32, tag 274.
    """
    try:
        value = _tiff_tags(_exif(data))[_ORIENTATION_TAG][1]
    except (struct.error, IndexError, KeyError):
        return 1
    return value if 1 <= value <= 8 else 1


def as_stored(data: bytes) -> bytes:
    """Return a TIFF without its orientation: OpenCV cannot be told to leave it; other formats as they are."""
    if not data.startswith(_TIFF):
        return data
    try:
        at, value = _tiff_tags(data)[_ORIENTATION_TAG]
    except (struct.error, IndexError, KeyError):
        return data
    order = "<H" if data[:2] == b"II" else ">H"
    return data if value == 1 else data[:at] + struct.pack(order, 1) + data[at + 2 :]


def _exif(data: bytes) -> bytes:
    """Return the Exif data of an image, which are TIFF; empty if it has none."""
    if data.startswith(_TIFF):
        return data
    # A JPEG has it among the segments before its first table, of 64 kB at most each; the others in a chunk.
    if data.startswith(b"\xff\xd8"):
        at = data.find(b"Exif\0\0", 0, 2**17) + 6
        found = at >= 6
    elif data.startswith(b"\x89PNG"):
        at = data.find(b"eXIf") + 4
        found = at >= 4
    else:
        at = data.rfind(b"EXIF") + 8
        found = at >= 8 and data.startswith(b"RIFF")
        at += 6 if data[at : at + 6] == b"Exif\0\0" else 0
    exif = data[at:] if found else b""
    return exif if exif.startswith(_TIFF) else b""


def scan_count(data: bytes) -> int:
    """Return how many times a JPEG goes over its pixels; 0 for other formats."""
    # Within a scan, every 255 is followed by another byte; thumbnails have their own.
    return data.count(b"\xff\xda") if data.startswith(b"\xff\xd8") else 0


def is_cut_off(data: bytes) -> bool:
    """Tell whether a JPEG or PNG ends too early."""
    if data.startswith(b"\xff\xd8"):
        # The end marker must follow the last scan: a thumbnail in the header has an end marker, too.
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:]
    return False
