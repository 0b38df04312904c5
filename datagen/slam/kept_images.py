"""Images that stay in memory once they were read: mapping looks at every frame a dozen times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from lanenet.data.drives import Drive
from lanenet.data.drives.recording import ImageSource

#: What the images of a drive may take up; the rest is read again. About 1100 frames of 320 x 240 px.
MOST_BYTES = 250_000_000


class KeptImages:
    """Images of another source, the first of which are kept until they take up too much."""

    def __init__(self, source: ImageSource, most_bytes: int = MOST_BYTES) -> None:
        self._source, self._free = source, most_bytes
        self._kept: dict[int, UInt8[np.ndarray, "h w 3"]] = {}

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Read one image, which must not be drawn on."""
        kept = self._kept.get(row)
        if kept is not None:
            return kept
        image = self._source.read(row)
        if image.nbytes <= self._free:
            self._free -= image.nbytes
            image.flags.writeable = False
            self._kept[row] = image
        return image


def keep_images(drive: Drive) -> Drive:
    """Return the drive with images that are read once, as far as they fit into memory."""
    return replace(drive, images=KeptImages(drive.images))
