"""First stage of Suto's tracker: from a frame to the binary image of its strong vertical contours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Int16, Num, UInt8
from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.errors import ConfigError

#: Neighbouring pixels that differ by this much belong to a contour or to noise. Chosen: a sixteenth of the
#: range, above the noise of a camera in daylight.
_ROUGH_STEP = 16
#: Hue of pixels without colour: the end of OpenCV's scale, far from yellow markings and brown floors.
_GRAY_HUE = np.uint8(179)
#: Size of the blocks in which clutter is counted. Chosen: a marking fills few of them, a texture most.
_BLOCK_PX = 10
#: Place of each channel in OpenCV's HSV image.
_CHANNELS = {"hue": 0, "saturation": 1, "value": 2}


class HoughEdgeSettings(Settings):
    """How Suto's contours are found (section 4.1).

    Attributes:
        width_px: Width to which a frame is scaled.
        height_px: Height to which it is scaled.
        roi_top_px: First row of the region of interest, which is as wide as the image. The paper gives its
            size, 160 x 70, and that it lies in the near field: the bottom of the image.
        roi_height_px: Rows of the region of interest.
        channel: Channel of HSV that serves as gray image; the paper's is the hue, 0 to 179 in OpenCV. Hue is
            noise where a colour is nearly gray, so white lines on gray floors need ``value``.
        min_saturation: A hue of less saturation than this is noise and counts as 179, the end of the scale
            that is far from yellow markings and brown floors. Not in the paper; 0 is the paper's.
        min_value: The same for the hue of a dark pixel.
        blur_px: Size of the Gauss kernel.
        threshold: T of eq. 1, on the absolute response of the 3 x 3 Sobel operator.
        max_rough_share: If more than this share of horizontal neighbours differ by 16 or more, the channel is
            noise and the frame has no contours. Not in the paper; 1 is the paper's.
    """

    width_px: int = Field(default=160, ge=16)
    height_px: int = Field(default=120, ge=16)
    roi_top_px: int = Field(default=50, ge=0)
    roi_height_px: int = Field(default=70, ge=8)
    channel: Literal["hue", "saturation", "value"] = "hue"
    min_saturation: int = Field(default=40, ge=0, le=255)
    min_value: int = Field(default=40, ge=0, le=255)
    blur_px: Literal[3, 5, 7] = 5
    threshold: float = Field(default=100.0, gt=0.0)
    max_rough_share: float = Field(default=0.4, gt=0.0, le=1.0)

    @model_validator(mode="after")
    def _roi_lies_in_the_image(self) -> HoughEdgeSettings:
        if self.roi_top_px + self.roi_height_px > self.height_px:
            raise ConfigError(
                f"hough edges: roi_top_px {self.roi_top_px} and roi_height_px {self.roi_height_px} reach "
                f"beyond height_px {self.height_px}"
            )
        return self


@dataclass(frozen=True)
class Contours:
    """Contours of the region of interest.

    Attributes:
        response: Signed response of the horizontal Sobel operator: positive where the channel rises to the
            right.
        binary: 1 where its absolute value reaches the threshold; all 0 in a frame that shows no road.
    """

    response: Int16[np.ndarray, "r c"]
    binary: UInt8[np.ndarray, "r c"]

    @property
    def by_sign(self) -> tuple[UInt8[np.ndarray, "r c"], UInt8[np.ndarray, "r c"]]:
        """The rising and the falling contours, each as a binary image of its own."""
        rising = self.binary * (self.response > 0)
        return rising, self.binary - rising


def cut_roi(frame_bgr: UInt8[np.ndarray, "h w 3"], settings: HoughEdgeSettings) -> UInt8[np.ndarray, "r c 3"]:
    """Scale a frame to the paper's size and cut out the near field."""
    height, width = frame_bgr.shape[:2]
    if (width, height) != (settings.width_px, settings.height_px):
        size = (settings.width_px, settings.height_px)
        frame_bgr = np.asarray(cv2.resize(frame_bgr, size, interpolation=cv2.INTER_AREA))
    return frame_bgr[settings.roi_top_px : settings.roi_top_px + settings.roi_height_px]


def gray_of(roi_bgr: UInt8[np.ndarray, "r c 3"], settings: HoughEdgeSettings) -> UInt8[np.ndarray, "r c"]:
    """Return the channel of HSV that serves as gray image; a hue that would be noise becomes 179."""
    hsv = cv2.cvtColor(roi_bgr, cv2.COLOR_BGR2HSV)
    gray = np.asarray(cv2.extractChannel(hsv, _CHANNELS[settings.channel]))
    if settings.channel != "hue":
        return gray
    coloured = (hsv[..., 1] >= settings.min_saturation) & (hsv[..., 2] >= settings.min_value)
    return np.where(coloured, gray, _GRAY_HUE)


def crowded_share(binary: UInt8[np.ndarray, "r c"]) -> float:
    """Return the share of blocks that hold a contour: near 1 in a texture, mostly below a half on a road.

    A road's markings fill few blocks well; strokes, leaves and tiles leave some contour in most.
    """
    rows, columns = (max(n // _BLOCK_PX, 1) for n in binary.shape)
    blocks = binary[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    return float(blocks.reshape(rows, -1, columns, blocks.shape[1] // columns).any(axis=(1, 3)).mean())


def binarise(response: Num[np.ndarray, "r c"], threshold: float) -> UInt8[np.ndarray, "r c"]:
    """Keep responses f(x, y) of at least T: 0 below, 1 from there on.

    The paper does not mention negative responses. Both borders of a line are contours, so f is read as the
    absolute response.

    Source:
        Suto 2021, eq. 1.
    """
    return (np.abs(response) >= threshold).astype(np.uint8)


def find_contours(frame_bgr: UInt8[np.ndarray, "h w 3"], settings: HoughEdgeSettings) -> Contours:
    """Return the contours of the region of interest (section 4.1 of the paper as a whole)."""
    gray = gray_of(cut_roi(frame_bgr, settings), settings)
    blurred = cv2.GaussianBlur(gray, (settings.blur_px, settings.blur_px), 0)
    response = np.asarray(cv2.Sobel(blurred, cv2.CV_16S, 1, 0))
    binary = binarise(response, settings.threshold)
    # Near 1 in noise, small on a road.
    rough_share = float((cv2.absdiff(gray[:, 1:], gray[:, :-1]) >= _ROUGH_STEP).mean())
    if rough_share > settings.max_rough_share:
        binary = np.zeros_like(gray)
    return Contours(response, binary)
