"""JPEG images of cameras: a decoder that refuses most of those that lost bytes."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

#: End of an image.
_EOI = b"\xff\xd9"
#: What libjpeg leaves in place of blocks that are missing at the end of an image.
_GRAY = 128
#: Side of a block, and how far the colours of its neighbours reach into it, [px].
_BLOCK_PX, _RIM_PX = 8, 2
#: Bytes that are no marker and decode to other blocks than gray; chosen: longer than a few blocks.
_MORE = bytes(range(0x11, 0x71))


def decode_jpeg(data: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return a JPEG image in OpenCV's order; None if it is broken.

    OpenCV returns images that lost bytes, too. Where blocks are missing at the end, libjpeg leaves gray:
    these images are refused. An image whose last block is that very gray by itself is decoded once more, with
    bytes added: they change only an image that lacks blocks. A loss of a few bytes after which as many
    blocks follow as before cannot be told from another picture.

    Args:
        data: A baseline image, of a stream without restart markers; what follows its end is ignored.
    """
    end = data.rfind(_EOI)
    image = _decoded(data[: end + 2]) if end > 0 else None
    if image is None:
        return None
    rows, columns = ((side - 1) // _BLOCK_PX * _BLOCK_PX + _RIM_PX for side in image.shape[:2])
    if (image[rows:, columns:] == _GRAY).all():
        longer = _decoded(data[:end] + _MORE + _EOI)
        return image if longer is not None and np.array_equal(image, longer) else None
    return image


def _decoded(data: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image)
