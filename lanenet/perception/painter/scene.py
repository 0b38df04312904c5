"""The scene of an image without a camera file: a road that runs to a horizon, or something else.

The lines of a road, its kerbs, barriers and neighbouring lanes run ahead, so that most of its straight
segments meet in one point of the horizon. That point tells the scene, and it places the region of interest:
at whatever height a camera of the car looks, the two lines of the lane pass from there to the bottom of the
image, at slopes that depend on the lane's width and the camera's height alone.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.perception.image_lane import Polyline
from lanenet.perception.painter.lines import (
    PainterEdgeSettings,
    PainterLineSettings,
    find_painter_segments,
    value_channel,
)

#: The painter's settings on such a road, where a settings file does not say otherwise. Chosen on half of
#: the 30 road images of ``tests/support/road_labels.csv``, cropped, scaled, darkened and blurred, too. Most
#: misses were lines without the evidence that keeps the painter from finding lanes in carpets.
ROAD: dict[str, Any] = {
    "evidence": {"required": False},
    "lines": {
        "votes_share": 0.05,
        "min_length_share": 0.06,
        "max_gap_share": 0.05,
        "agree_share": 0.05,
        "min_support_share": 0.0,
        "min_width_share": 0.1,
    },
    "curve": {"min_span_share": 0.7},
}

#: Images are reduced to this width before segments are searched. Chosen: the point is needed within some
#: pixels, and the search in a 1280 x 720 image would take four times as long.
_WIDTH_PX = 640
#: Segments that are searched, by the height of the whole image. Chosen: dashes and posts of a barrier count.
_SEGMENTS = PainterLineSettings(votes_share=0.05, min_length_share=0.07, max_gap_share=0.03)
#: The upper part of an image is sky or ceiling. Chosen.
_SKY_SHARE = 0.2
#: Least rise over run, and run over rise, of segments that count. Chosen: shadows are level, posts upright.
_LEAST_RISE, _LEAST_RUN = 0.2, 0.15
#: Where the point may lie, as shares of width and height, and steps of the grid of places.
_U_SHARES, _V_SHARES = np.linspace(0.15, 0.85, 50), np.linspace(0.15, 0.8, 46)
#: A camera looks along its car: mean and sigma of the point's place, as shares of width and height. Chosen.
_PRIOR = ((0.5, 0.15), (0.5, 0.25))
#: A segment votes for a place that its line misses by about this share of the width. Chosen: 8 px of 640.
_MISS_SHARE = 0.012
#: Weight of the earlier frames of a video against the newest one. Chosen: five frames count.
_KEPT = 0.8
#: A road: so many votes meet, they are this share of all, and their product is so much. Chosen: that holds
#: for 28 of 30 road images, each by itself, and for none of 240 frames of noise, blocks and strokes.
_LEAST_VOTES, _LEAST_SHARE, _LEAST_PRODUCT = 0.8, 0.2, 0.5

#: The top of the region of interest on a road, as a share of the rows from the vanishing point to the bottom
#: of the image, and up to where the lines that are found there are continued. Chosen as :data:`ROAD`.
_TOP, _CONTINUED_TO = 0.12, 0.05
#: Run over rise of the region's sides. A line lies as far to the side as this many camera heights: half a
#: lane of 3.75 m is 1.6 heights of 1.2 m. Chosen: a car beside the middle of its lane, and a lower camera.
_SIDE_SLOPE = 2.6


class VanishingPoint:
    """The point of the image in which the segments of a drive's frames meet.

    Attributes:
        point_px: The point, [px], frame image; None until a road was seen.
    """

    def __init__(self) -> None:
        self.point_px: Float[np.ndarray, "2"] | None = None
        self._votes = np.zeros((2, 2, len(_V_SHARES), len(_U_SHARES)))
        self._frames = 0.0

    def see(self, frame_bgr: UInt8[np.ndarray, "h w 3"], settings: PainterEdgeSettings) -> None:
        """Take the votes of one more frame of the same size.

        The point is where the geometric mean of the votes of both sides is largest: a barrier on one side,
        or a wall of bricks, makes none. It stays where later frames show no road.

        Source:
            Own derivation; tested with drawn roads and with frames of texture.
        """
        height, width = frame_bgr.shape[:2]
        self._votes = _KEPT * self._votes + _votes(_find_segments(frame_bgr, settings), height / width)
        self._frames = _KEPT * self._frames + 1.0
        meeting, all_below = np.sqrt(self._votes[:, 0] * self._votes[:, 1]) / self._frames
        prior = [
            np.exp(-0.5 * ((shares - mean) / sigma) ** 2)
            for shares, (mean, sigma) in zip((_U_SHARES, _V_SHARES), _PRIOR, strict=True)
        ]
        row, column = np.unravel_index(np.argmax(meeting * np.outer(prior[1], prior[0])), meeting.shape)
        votes = meeting[row, column]
        share = votes / max(all_below[row, column], 1e-9)
        if votes >= _LEAST_VOTES and share >= _LEAST_SHARE and votes * share >= _LEAST_PRODUCT:
            self.point_px = np.array([_U_SHARES[column] * (width - 1.0), _V_SHARES[row] * (height - 1.0)])


def find_road_trapezoid(point_px: Float[np.ndarray, "2"], height: int) -> Float[np.ndarray, "4 2"]:
    """Return the region of interest on a road, clockwise from the top left; it may reach beside the image."""
    u, v = point_px
    rows = height - 1.0 - v
    top, bottom = _SIDE_SLOPE * _TOP * rows, _SIDE_SLOPE * rows
    top_v = v + _TOP * rows
    return np.array(
        [[u - top, top_v], [u + top, top_v], [u + bottom, height - 1.0], [u - bottom, height - 1.0]]
    )


def continue_line(line_px: Polyline, point_px: Float[np.ndarray, "2"], height: int) -> Polyline:
    """Continue a line of the region straight to the bottom of the image and towards the vanishing point.

    Args:
        line_px: The line, near to far, [px].
        point_px: The vanishing point, [px].
        height: Of the image, [px].
    """
    far_v = point_px[1] + _CONTINUED_TO * (height - 1.0 - point_px[1])
    near, far = line_px[:2], line_px[-2:]
    ends = []
    for (first, second), v in ((near, height - 1.0), (far[::-1], far_v)):
        rise = second[1] - first[1]
        beyond = (first[1] - v) * rise > 0.0
        ends.append([first + (second - first) * (v - first[1]) / rise] if beyond else [])
    return np.array([*ends[0], *line_px, *ends[1]])


def _find_segments(
    frame_bgr: UInt8[np.ndarray, "h w 3"], settings: PainterEdgeSettings
) -> Float[np.ndarray, "n 4"]:
    """The segments x1, y1, x2, y2 below the sky, x as shares of the width and y of the height."""
    height, width = frame_bgr.shape[:2]
    if width > _WIDTH_PX:
        size = (_WIDTH_PX, max(1, round(height * _WIDTH_PX / width)))
        frame_bgr = np.asarray(cv2.resize(frame_bgr, size, interpolation=cv2.INTER_AREA))
    value = cv2.GaussianBlur(value_channel(frame_bgr, settings), (settings.blur_px, settings.blur_px), 0)
    edges = np.asarray(cv2.Canny(value, settings.low, settings.high))
    edges[: round(_SKY_SHARE * len(edges))] = 0
    segments = find_painter_segments(edges, float(len(edges)), _SEGMENTS)
    run, rise = np.abs(segments[:, 2:] - segments[:, :2]).T
    kept = (rise > _LEAST_RISE * run) & (run > _LEAST_RUN * rise)
    return segments[kept] / np.tile(edges.shape[::-1], 2)


def _votes(segments: Float[np.ndarray, "n 4"], aspect: float) -> Float[np.ndarray, "2 2 rows columns"]:
    """The votes of the left and the right side for each place of the grid.

    Args:
        segments: Segments as shares of width and height.
        aspect: Height over width of the image.

    Returns:
        First those of the segments whose lines pass it, then those of all that reach below it; each of the
        segments that rise to the right, then of those that fall.
    """
    # Single precision takes a third of the time, and a vote needs no more.
    x1, y1, x2, y2 = segments.astype(np.float32).T
    dx, dy = x2 - x1, np.float32(aspect) * (y2 - y1)
    run = np.hypot(dx, dy)
    weight = np.sqrt(run / aspect)
    u, v = (x.astype(np.float32) for x in (_U_SHARES[None, :, None], _V_SHARES[:, None, None]))
    missed = (dy * (u - x1) - dx * np.float32(aspect) * (v - y1)) / run
    # All of the segment is on the road, below the point.
    below = np.minimum(y1, y2) >= v - _MISS_SHARE
    passing = below * np.exp(-0.5 * (missed / _MISS_SHARE) ** 2)
    reaching = np.broadcast_to(np.maximum(y1, y2) > v, passing.shape)
    rising = dx * dy < 0.0
    sides = np.stack([weight * rising, weight * ~rising])
    return np.moveaxis(np.stack([passing @ sides.T, reaching @ sides.T]), -1, 1)
