"""PNG pictures as bytes, as tables hold them."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8


def png_bytes(image: UInt8[np.ndarray, "h w *c"]) -> bytes:
    """Encode a picture; the same picture always gives the same bytes."""
    _, data = cv2.imencode(".png", image)
    return bytes(data.tobytes())


def png_size(data: bytes) -> tuple[int, int] | None:
    """Read width and height from the header of a PNG; None if it is not one."""
    if len(data) < 24 or data[:8] != b"\x89PNG\r\n\x1a\n":
        return None
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
