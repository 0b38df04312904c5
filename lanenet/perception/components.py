"""Connected components of a mask and the measures that tell a strip from a blob."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8

#: Sobel response of a step of one gray level, without blur.
SOBEL_GAIN = 4.0
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


@dataclass(frozen=True, eq=False)
class Components:
    """Components by label; label 0 is the background, whose measures mean nothing.

    Attributes:
        shape: Rows and columns of the mask.
        inside: Flat indices of the components' pixels.
        of_inside: Their labels.
        on_rim: Flat indices of the boundary pixels, without those on the picture's border, where a strip
            goes on unseen.
        of_rim: Their labels.
        area: Pixels of each component.
        rim: Boundary pixels of each component, at least 1.
        elongation: Length over thickness, from the outline with the picture's border: a disk has 3, a
            square 4, a strip twice as long as thick 4.5.
        thickness_cm: On the road, [cm]; NaN where unknown.
    """

    shape: tuple[int, int]
    inside: Int[np.ndarray, "p"]
    of_inside: Int[np.ndarray, "p"]
    on_rim: Int[np.ndarray, "b"]
    of_rim: Int[np.ndarray, "b"]
    area: Int[np.ndarray, "k"]
    rim: Int[np.ndarray, "k"]
    elongation: Float[np.ndarray, "k"]
    thickness_cm: Float[np.ndarray, "k"]

    def boundary_step(self, dx: Int16[np.ndarray, "h w"], dy: Int16[np.ndarray, "h w"]) -> np.ndarray:
        """Return the sharp step, in gray levels, whose gradient is each component's mean on its boundary."""
        gx = dx.reshape(-1).take(self.on_rim).astype(np.float32)
        gy = dy.reshape(-1).take(self.on_rim).astype(np.float32)
        total = np.bincount(self.of_rim, np.sqrt(gx * gx + gy * gy), len(self.rim))
        return total / (SOBEL_GAIN * self.rim)

    def mean(self, image: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "k"]:
        """Return the mean of an image over each component."""
        return np.bincount(self.of_inside, image.reshape(-1).take(self.inside), len(self.area)) / self.area

    def paint(self, chosen: Bool[np.ndarray, "k"]) -> UInt8[np.ndarray, "h w"]:
        """Return a mask of the chosen components."""
        mask = np.zeros(self.shape, np.uint8)
        mask.reshape(-1)[self.inside[chosen.take(self.of_inside)]] = 255
        return mask


def measure_components(
    mask: UInt8[np.ndarray, "h w"], cm_per_px: Float[np.ndarray, "h w"] | None = None
) -> Components:
    """Label the components of a mask (8-connected) and measure them.

    Args:
        mask: 255 inside, 0 elsewhere.
        cm_per_px: Road per pixel, for the thickness.

    Returns:
        The components.

    Source:
        Own derivation: a strip of length l and thickness t has the area l t and a boundary of about 2 l.
    """
    kind = cv2.CV_16U if mask.size < 4 * 65535 else cv2.CV_32S
    count, labels = cv2.connectedComponents(mask, connectivity=8, ltype=kind)
    flat = labels.reshape(-1)
    inside = np.flatnonzero(mask.reshape(-1) != 0)
    of_inside = flat.take(inside).astype(np.intp)
    # The background has no pixels here; one is put in, so that nothing is divided by zero.
    area = np.maximum(np.bincount(of_inside, minlength=count), 1)
    boundary = cv2.erode(mask, _CROSS).reshape(-1).take(inside) == 0
    on_rim, of_rim = inside[boundary], of_inside[boundary]
    rim = np.maximum(np.bincount(of_rim, minlength=count), 1)
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    # Corners count once in the boundary's pixels: four more make small squares and large ones alike.
    outline = rim + np.bincount(border, minlength=count) + 4.0
    thickness_cm = np.full(count, np.nan)
    if cm_per_px is not None:
        scale = np.bincount(of_rim, cm_per_px.reshape(-1)[on_rim], count) / rim
        thickness_cm = np.maximum(2.0 * area / rim, 1.0) * scale
    shape = (mask.shape[0], mask.shape[1])
    elongation = outline * outline / (4.0 * area)
    return Components(shape, inside, of_inside, on_rim, of_rim, area, rim, elongation, thickness_cm)
