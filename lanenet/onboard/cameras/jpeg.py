"""JPEG images of cameras: a decoder that refuses most of those that lost bytes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.perception.edges.compiled import loops_of

_kernels: Any = loops_of("lanenet.onboard.cameras")

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

    OpenCV returns images that lost bytes, too. Those are refused whose codes end before the last block, or
    are no codes. A loss of a few bytes, after which as many blocks follow as before, cannot be told from
    another picture.

    Args:
        data: An image; what follows its end is ignored.
    """
    end = data.rfind(_EOI)
    if end < 0:
        return None
    # 1 if all blocks are there, 0 if not, -1 for kinds of images that cameras do not send.
    whole = -1 if _kernels is None else _kernels.whole(data[:end])
    image = None if whole == 0 else _decoded(data[:end] + _EOI)
    return None if image is None or (whole < 0 and _ends_early(image, data[:end])) else image


def _ends_early(image: UInt8[np.ndarray, "h w 3"], data: bytes) -> bool:
    """Tell whether an image lacks its last block, without compiled loops.

    libjpeg leaves gray in its place. An image whose last block is that very gray by itself is decoded once
    more, with bytes added: they change only an image that lacks blocks.
    """
    rows, columns = ((side - 1) // _BLOCK_PX * _BLOCK_PX + _RIM_PX for side in image.shape[:2])
    if not (image[rows:, columns:] == _GRAY).all():
        return False
    longer = _decoded(data + _MORE + _EOI)
    return longer is None or not np.array_equal(image, longer)


def _decoded(data: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image)
