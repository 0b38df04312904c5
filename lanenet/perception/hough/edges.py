"""First stage of Suto's tracker: from a frame to the binary image of its strong vertical contours."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Num, UInt8
from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.errors import ConfigError

#: Neighbouring pixels that differ by this much belong to a contour or to noise.
_ROUGH_STEP = 16
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
        blur_px: Size of the Gauss kernel.
        threshold: T of eq. 1, on the absolute response of the 3 x 3 Sobel operator.
        max_rough_share: Where more than this share of the channel's neighbours differ by 16 or more, the
            channel is noise and nothing is answered. Not in the paper.
    """

    width_px: int = Field(default=160, ge=16)
    height_px: int = Field(default=120, ge=16)
    roi_top_px: int = Field(default=50, ge=0)
    roi_height_px: int = Field(default=70, ge=8)
    channel: Literal["hue", "saturation", "value"] = "hue"
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


def cut_roi(frame_bgr: UInt8[np.ndarray, "h w 3"], settings: HoughEdgeSettings) -> UInt8[np.ndarray, "r c 3"]:
    """Scale a frame to the paper's size and cut out the near field."""
    height, width = frame_bgr.shape[:2]
    if (width, height) != (settings.width_px, settings.height_px):
        size = (settings.width_px, settings.height_px)
        frame_bgr = np.asarray(cv2.resize(frame_bgr, size, interpolation=cv2.INTER_AREA))
    return frame_bgr[settings.roi_top_px : settings.roi_top_px + settings.roi_height_px]


def gray_of(roi_bgr: UInt8[np.ndarray, "r c 3"], settings: HoughEdgeSettings) -> UInt8[np.ndarray, "r c"]:
    """Return the channel of HSV that serves as gray image."""
    hsv = cv2.cvtColor(roi_bgr, cv2.COLOR_BGR2HSV)
    return np.asarray(cv2.extractChannel(hsv, _CHANNELS[settings.channel]))


def rough_share(gray: UInt8[np.ndarray, "r c"]) -> float:
    """Return the share of horizontal neighbours that differ strongly: near 1 in noise, small on a road."""
    return float((cv2.absdiff(gray[:, 1:], gray[:, :-1]) >= _ROUGH_STEP).mean())


def horizontal_response(
    gray: UInt8[np.ndarray, "r c"], settings: HoughEdgeSettings
) -> Num[np.ndarray, "r c"]:
    """Return the absolute horizontal Sobel response f(x, y) of the blurred channel.

    The paper does not say what becomes of negative responses; both sides of a line are contours, hence the
    absolute value.
    """
    blurred = cv2.GaussianBlur(gray, (settings.blur_px, settings.blur_px), 0)
    return np.asarray(np.abs(cv2.Sobel(blurred, cv2.CV_16S, 1, 0)))


def binarise(response: Num[np.ndarray, "r c"], threshold: float) -> UInt8[np.ndarray, "r c"]:
    """Keep responses of at least T: 0 below, 1 from there on.

    Source:
        Suto 2021, eq. 1.
    """
    return (response >= threshold).astype(np.uint8)


def find_contours(
    frame_bgr: UInt8[np.ndarray, "h w 3"], settings: HoughEdgeSettings
) -> UInt8[np.ndarray, "r c"]:
    """Return the binary contours of the region of interest (section 4.1 of the paper as a whole)."""
    gray = gray_of(cut_roi(frame_bgr, settings), settings)
    if rough_share(gray) > settings.max_rough_share:
        return np.zeros_like(gray)
    return binarise(horizontal_response(gray, settings), settings.threshold)
