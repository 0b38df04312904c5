"""A map from above that is drawn while the car drives, in a canvas that keeps its size."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.quality.pictures import draw_metre

_FINEST_CM = 0.5
_MARGIN_PX = 40
_HUES, _FRAMES_PER_HUE = 150, 4
_DRIVEN = 255


class LiveCanvas:
    """Edges (hue = time, which comes round again) and the driven path (white) of one segment.

    Where the car leaves the canvas, its pixels are made twice as coarse: the memory stays what it is.

    Attributes:
        frames: How many frames were drawn.
        cm_per_px: Side of a pixel.
    """

    def __init__(self, size_px: int = 2400) -> None:
        self.frames, self.cm_per_px = 0, _FINEST_CM
        self._pixels: UInt8[np.ndarray, "s s"] = np.zeros((size_px, size_px), np.uint8)
        #: Corners of what was drawn, and the canvas's own lower one, frame map.
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)
        self._corner = np.zeros(2)
        self._car: Float[np.ndarray, "1 2"] | None = None

    def add(self, edges_map_cm: Float[np.ndarray, "m 2"], car_cm: Float[np.ndarray, "2"]) -> None:
        """Draw a frame's edges and the way to its place, [cm], frame map."""
        before = car_cm[None] if self._car is None else self._car
        self._car = car_cm[None]
        steps = int(np.abs(self._car - before).max() / self.cm_per_px) + 2
        way = before + np.linspace(0.0, 1.0, steps)[:, None] * (self._car - before)
        self._make_room(np.concatenate([edges_map_cm, way]))
        self._plot(edges_map_cm, 1 + self.frames // _FRAMES_PER_HUE % _HUES)
        self._plot(way, _DRIVEN)
        self.frames += 1

    def picture(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return what was drawn, with a metre of scale."""
        colours = np.full((256, 1, 3), 24, np.uint8)
        hues = np.stack([np.arange(_HUES), np.full(_HUES, 200), np.full(_HUES, 200)], axis=1)
        colours[1 : 1 + _HUES] = cv2.cvtColor(hues[:, None].astype(np.uint8), cv2.COLOR_HSV2BGR)
        colours[_DRIVEN] = 255
        used = self._pixels
        if self.frames:
            low, high = (((c - self._corner) / self.cm_per_px).astype(int) for c in (self._low, self._high))
            used = used[low[1] : high[1] + 1, low[0] : high[0] + 1]
        # y grows upwards on the map.
        indices = np.pad(used[::-1], _MARGIN_PX)
        image = np.ascontiguousarray(colours[indices, 0])
        draw_metre(image, 1.0 / self.cm_per_px)
        return image

    def _plot(self, points_cm: Float[np.ndarray, "m 2"], value: int) -> None:
        column, row = ((points_cm - self._corner) / self.cm_per_px).astype(int).T
        self._pixels[row, column] = np.maximum(self._pixels[row, column], value) if value < 255 else value

    def _make_room(self, points_cm: Float[np.ndarray, "m 2"]) -> None:
        """Move or coarsen the canvas so that the points fit on it."""
        self._low = np.minimum(self._low, points_cm.min(axis=0))
        self._high = np.maximum(self._high, points_cm.max(axis=0))
        size = len(self._pixels)
        extent = self._high - self._corner
        if self.frames and (self._low >= self._corner).all() and (extent < size * self.cm_per_px).all():
            return
        row, column = np.nonzero(self._pixels)
        drawn = self._corner + (np.stack([column, row], axis=1) + 0.5) * self.cm_per_px
        values = self._pixels[row, column]
        # Room on all sides, so that this is rare.
        while 1.25 * (self._high - self._low).max() >= size * self.cm_per_px:
            self.cm_per_px *= 2.0
        self._corner = 0.5 * (self._low + self._high - size * self.cm_per_px)
        self._pixels[:] = 0
        column, row = ((drawn - self._corner) / self.cm_per_px).astype(int).T
        np.maximum.at(self._pixels, (row, column), values)
