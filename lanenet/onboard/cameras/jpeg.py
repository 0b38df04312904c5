"""JPEG images of cameras: a decoder that refuses most of those that lost bytes."""

from __future__ import annotations

import contextlib
import re

import cv2
import numpy as np
from jaxtyping import UInt8

try:
    import simplejpeg
except (ImportError, ValueError):
    # ValueError: one that was compiled for another NumPy, as that of the system may be.
    simplejpeg = None

#: End of an image.
_EOI = b"\xff\xd9"
#: What libjpeg leaves in place of blocks that are missing at the end of an image.
_GRAY = 128
#: Side of a block, and how far the colours of its neighbours reach into it, [px].
_BLOCK_PX, _RIM_PX = 8, 2
#: Bytes that are no marker and decode to other blocks than gray; chosen: longer than a few blocks.
_MORE = bytes(range(0x11, 0x71))
#: A block takes one bit at least.
_MOST_PX_PER_BYTE = 8 * _BLOCK_PX**2
#: Cameras, among them some of Logitech, fill up with a few bytes before a marker.
_FILLED = re.compile(r"\b(\d+) extraneous bytes before marker")
#: Most of them; chosen: reports name 1 to 9.
_MOST_FILLED = 16
#: What turbojpeg does not decode, and OpenCV does: subsampling unlike 4:4:4, 4:4:0, 4:2:2, 4:2:0 and 4:1:1.
_UNUSUAL = "Could not determine subsampling"


def is_strict() -> bool:
    """Tell whether simplejpeg is here, which finds most losses."""
    return simplejpeg is not None


def decode_jpeg(data: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return a JPEG image in OpenCV's order; None if it is broken.

    OpenCV returns images that lost bytes, too. The package simplejpeg refuses those whose codes end before
    the last block, are no codes, or go on long after it. A loss of a few bytes, after which as many blocks
    follow as before, cannot be told from another picture. Without simplejpeg, and in images that a camera
    filled up with a few bytes, only a missing last block is found.

    Args:
        data: An image; what follows its end is ignored, and so is an orientation that its Exif data name.
    """
    data = data[: data.rfind(_EOI) + len(_EOI)]
    if not data.endswith(_EOI):
        return None
    if simplejpeg is not None:
        try:
            height, width, *_ = simplejpeg.decode_jpeg_header(data)
            lacks_blocks = height * width > _MOST_PX_PER_BYTE * len(data)
            return None if lacks_blocks else np.asarray(simplejpeg.decode_jpeg(data, "BGR"))
        except ValueError as error:
            if not _may_be_whole(str(error)):
                return None
    image = _decoded(data)
    return None if image is None or _ends_early(image, data) else image


def _may_be_whole(error: str) -> bool:
    """Tell whether an image may be whole although simplejpeg refuses it."""
    filled = _FILLED.search(error)
    return _UNUSUAL in error or (filled is not None and int(filled[1]) <= _MOST_FILLED)


def _ends_early(image: UInt8[np.ndarray, "h w 3"], data: bytes) -> bool:
    """Tell whether an image lacks its last block.

    libjpeg leaves gray in its place. An image whose last block is that very gray by itself is decoded once
    more, with bytes added: they change only an image that lacks blocks.
    """
    rows, columns = ((side - 1) // _BLOCK_PX * _BLOCK_PX + _RIM_PX for side in image.shape[:2])
    if not (image[rows:, columns:] == _GRAY).all():
        return False
    longer = _decoded(data.removesuffix(_EOI) + _MORE + _EOI)
    return longer is None or not np.array_equal(image, longer)


def _decoded(data: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return an image, with gray in place of what it lost; None if there is none."""
    if simplejpeg is not None:
        # Unlike OpenCV it writes no line to the terminal for each image that was filled up.
        with contextlib.suppress(ValueError):
            return np.asarray(simplejpeg.decode_jpeg(data, "BGR", strict=False))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        # A size that OpenCV does not allow.
        return None
    return None if image is None else np.asarray(image)
