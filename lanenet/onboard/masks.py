"""Which pixels of a source show the car itself: found from its frames, or read from a picture."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.data.drives.sources import Source
from lanenet.errors import ConfigError, DriveFormatError
from lanenet.perception.edges.static import find_static, spread_frames


def find_mask(source: Source) -> tuple[UInt8[np.ndarray, "h w"] | None, str]:
    """Look for the car in what never moves at the bottom of a source's frames.

    Args:
        source: Frames of a moving car; those that cannot be read are passed over.

    Returns:
        255 on the car and 0 elsewhere, or None if it is not found; and what to tell about that.
    """

    def frames() -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for i in spread_frames(len(source)):
            with contextlib.suppress(DriveFormatError):
                yield source.image(i)

    try:
        static = find_static(frames())
    except DriveFormatError as error:
        return None, f"no mask: {error}"
    mask, rows = static.mask, static.rows
    if not rows:
        return None, "no mask: nothing stays in place at the bottom of the frames"
    if static.is_too_high:
        return None, (
            f"no mask: something in the lowest {rows} of {mask.shape[0]} rows never moves, which is too much "
            "to be taken for the car; if it is, give a picture of it"
        )
    return mask, f"mask: {np.count_nonzero(mask)} px in the lowest {rows} rows show the car"


def read_mask(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Read a picture that is black except on the car.

    Args:
        path: PNG, gray or colour.

    Returns:
        255 where any channel of the picture is above 0, and 0 elsewhere; transparency does not count.

    Raises:
        ConfigError: If the file is missing, is no PNG (JPEG's black is not 0 everywhere), or hides all.
    """
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: expected 'auto' or a .png that is black except on the car")
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if picture is None:
        raise ConfigError(f"{path}: not a picture that can be read")
    if picture.ndim == 3:
        picture = picture[..., :3].max(axis=2)
    if picture.all():
        raise ConfigError(f"{path}: hides the whole picture; expected 0 where the road can be seen")
    return np.where(picture > 0, 255, 0).astype(np.uint8)
