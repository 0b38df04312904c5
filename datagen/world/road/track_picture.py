"""Pictures of a road from above."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.road.track import Bgr, Marking, Track

_FLOOR: Bgr = (80.0, 80.0, 80.0)
_CAR: Bgr = (60.0, 160.0, 60.0)
_MARGIN_CM = 25.0
_STEP_CM = 8.0  # of the polygons that stand for bent tape; their sides leave a radius of 60 cm by 0.13 cm
#: OpenCV draws at sixteenths of a pixel.
FIXED_BITS = 4
_LARGEST_PX = 20_000


def picture_scale(track: Track, longer_side_px: int = 1600) -> float:
    """Return the pixels per centimetre at which a road fills a picture of a given size, 4 at most."""
    low, high = painted_bounds_cm(track, _MARGIN_CM)
    return min(4.0, longer_side_px / float(np.max(high - low)))


def draw_track(
    track: Track, px_per_cm: float = 1.0, floor_bgr: Bgr | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a road from above, the map's y upwards, with its start, the direction of travel and a metre.

    Args:
        track: The road.
        px_per_cm: Scale.
        floor_bgr: Colour of the floor; None stands for grey.

    Raises:
        ValueError: If the picture would be larger than 20,000 px.
    """
    low, high = painted_bounds_cm(track, _MARGIN_CM)
    width, height = (int(v) for v in np.ceil((high - low) * px_per_cm))
    if max(width, height) > _LARGEST_PX:
        raise ValueError(
            f"px_per_cm {px_per_cm:g} gives {width} x {height} px, expected at most {_LARGEST_PX}"
        )
    image = np.empty((height, width, 3), np.uint8)
    image[:] = np.rint(_FLOOR if floor_bgr is None else floor_bgr)

    def pixels(xy_cm: Float[np.ndarray, "n 2"]) -> np.ndarray:
        u = (xy_cm[:, 0] - low[0]) * px_per_cm - 0.5
        v = height - (xy_cm[:, 1] - low[1]) * px_per_cm - 0.5
        return np.rint(np.stack([u, v], axis=1) * 2**FIXED_BITS).astype(np.int32)

    paint_track(image, track, pixels)
    cv2.fillPoly(image, [pixels(_start(track))], _CAR, cv2.LINE_AA, FIXED_BITS)
    _scale_bar(image, px_per_cm)
    return image


def paint_track(
    image: UInt8[np.ndarray, "h w 3"], track: Track, pixels: Callable[[Float[np.ndarray, "n 2"]], np.ndarray]
) -> None:
    """Paint a road's lines and furniture into a picture from above.

    Args:
        image: Painted in place.
        track: The road.
        pixels: From points of the map, [cm], to pixels times 2**FIXED_BITS, rounded.
    """

    def fill(polygon_cm: Float[np.ndarray, "n 2"], colour: Bgr) -> None:
        cv2.fillPoly(image, [pixels(polygon_cm)], colour, cv2.LINE_AA, FIXED_BITS)

    for marking in track.markings:
        for start_cm, end_cm in marking.painted_cm:
            fill(_tape(track, marking, float(start_cm), float(end_cm)), marking.colour_bgr)
    for box in track.boxes:
        fill(box_corners_cm(box), (float(box[6]), float(box[7]), float(box[8])))


def painted_bounds_cm(
    track: Track, margin_cm: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the corners of all that is painted, frame map, with a margin around the road."""
    lines_cm = [abs(marking.offset_cm) for marking in track.markings]
    reach_cm = max([track.half_width_cm + abs(track.middle_cm), *lines_cm]) + margin_cm
    points = [track.xy_cm - reach_cm, track.xy_cm + reach_cm]
    if len(track.boxes):
        size = (track.boxes[:, 4] + track.boxes[:, 5])[:, None] + 5.0
        points += [track.boxes[:, :2] - size, track.boxes[:, :2] + size]
    xy = np.concatenate(points)
    return xy.min(axis=0), xy.max(axis=0)


def _tape(track: Track, marking: Marking, start_cm: float, end_cm: float) -> Float[np.ndarray, "n 2"]:
    if track.kinks_rad.any():
        left, right = (
            track.line_beside(start_cm, end_cm, marking.offset_cm + aside * 0.5 * marking.width_cm)
            for aside in (1.0, -1.0)
        )
        return np.concatenate([left, right[::-1]])
    places = np.linspace(start_cm, end_cm, max(2, int(np.ceil((end_cm - start_cm) / _STEP_CM)) + 1))
    half_cm = 0.5 * marking.width_cm
    left, _ = track.points(places, marking.offset_cm + half_cm)
    right, _ = track.points(places[::-1], marking.offset_cm - half_cm)
    return np.concatenate([left, right])


def box_corners_cm(box: Float[np.ndarray, "9"], beyond_cm: float = 0.0) -> Float[np.ndarray, "4 2"]:
    """Return the corners of one of ``Track.boxes``, made larger by ``beyond_cm`` on all sides, frame map."""
    along = box[2:4] * (box[4] + beyond_cm)
    across = np.array([-box[3], box[2]]) * (box[5] + beyond_cm)
    return np.array([box[:2] + a * along + b * across for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))])


def _start(track: Track) -> Float[np.ndarray, "3 2"]:
    """A triangle on the start of the driven lane that points the way."""
    size = 0.3 * track.lane_width_cm
    origin, heading = track.point(0.0)
    c, s = np.cos(heading), np.sin(heading)
    shape = np.array([[1.6 * size, 0.0], [0.0, 0.6 * size], [0.0, -0.6 * size]])
    return origin + shape @ np.array([[c, s], [-s, c]])


def _scale_bar(image: UInt8[np.ndarray, "h w 3"], px_per_cm: float) -> None:
    metre, bottom = round(100.0 * px_per_cm), image.shape[0] - 10
    cv2.line(image, (10, bottom), (10 + metre, bottom), _CAR, 2)
    cv2.putText(image, "1 m", (10, bottom - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _CAR, 1, cv2.LINE_AA)
