"""A detector's answer drawn into its frame, for people to look at."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.image_lane import ImageLane, Polyline

Bgr = tuple[int, int, int]
#: BGR; the left line is green, the right one orange, the steering arrow yellow.
LEFT_BGR, RIGHT_BGR, ARROW_BGR, TEXT_BGR = (80, 220, 80), (40, 140, 255), (60, 230, 250), (255, 255, 255)
#: Lines remembered from earlier frames are blue, as in Suto's video.
MEMORY_BGR, FILL_BGR = (255, 120, 60), (60, 180, 60)
#: Ground truth or labels.
TRUTH_BGR = (255, 60, 255)
_FILL_SHARE = 0.35
FAR_CM = 40.0
_SAMPLES = 41
# Nothing is drawn further outside the image than this share of its size.
_MARGIN = 0.25
# OpenCV draws in fixed point: this many bits below a pixel.
_SHIFT = 4


def draw_estimate(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    estimate: LaneEstimate,
    camera: Camera | None = None,
    scale: int = 1,
    caption: str = "",
    image_lane: ImageLane | None = None,
    truth_cm: Float[np.ndarray, "6"] | None = None,
) -> UInt8[np.ndarray, "sh sw 3"]:
    """Draw the two parabolas (y = 0 to 40 cm), the six points and the steering target into a frame.

    Args:
        frame_bgr: Colour or gray frame; it is not changed.
        estimate: What a detector answered; what it does not know is not drawn.
        camera: Camera of the frame; without one the points on the road are not drawn.
        scale: Whole factor by which the image is enlarged, so that lines stay thin on small frames.
        caption: Text for the top left corner.
        image_lane: Lines of the image, drawn under the rest.
        truth_cm: Six points to compare with, drawn in magenta under the estimate.

    Returns:
        A new image, ``scale`` times the frame's size.
    """
    image = _enlarged(frame_bgr, scale)
    thickness = max(1, round(image.shape[1] / 320))
    if image_lane is not None:
        _draw_image_lane(image, image_lane, scale, 2 * thickness)
        caption = f"{caption}  {image_lane.text}".strip()
    caption = f"{caption}  {estimate.reason}".strip()
    if camera is not None:
        if truth_cm is not None:
            _draw_road(image, LaneEstimate(truth_cm), camera, scale, thickness, (TRUTH_BGR, TRUTH_BGR))
        _draw_road(image, estimate, camera, scale, thickness, (LEFT_BGR, RIGHT_BGR))
    _draw_arrow(image, estimate.steering_rad, 2 * thickness)
    if caption:
        _draw_text(image, caption, thickness)
    return image


def _draw_road(
    image: UInt8[np.ndarray, "h w 3"],
    estimate: LaneEstimate,
    camera: Camera,
    scale: int,
    thickness: int,
    colours: tuple[Bgr, Bgr],
) -> None:
    """The parabolas and the six points."""
    y_cm = np.linspace(0.0, FAR_CM, _SAMPLES)
    for side, colour in enumerate(colours):
        x_cm = np.polyval(estimate.parabolas[side], y_cm)
        draw_polyline(image, _pixels(np.stack([x_cm, y_cm], axis=1), camera, scale), colour, thickness)
    rows_cm = np.tile(ROWS_CM, len(SIDES))
    points = _pixels(np.stack([estimate.points_cm, rows_cm], axis=1), camera, scale)
    for index, point in enumerate(points):
        if np.isfinite(point).all():
            colour = colours[index // len(ROWS_CM)]
            centre = _fixed(point)
            cv2.circle(image, centre, (3 * thickness) << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
            cv2.circle(image, centre, (3 * thickness) << _SHIFT, (0, 0, 0), 1, cv2.LINE_AA, _SHIFT)


def _draw_image_lane(image: UInt8[np.ndarray, "h w 3"], lane: ImageLane, scale: int, thickness: int) -> None:
    def enlarged(line_px: Polyline) -> Polyline:
        return np.asarray((line_px + 0.5) * scale - 0.5)

    if lane.filled and lane.left_px is not None and lane.right_px is not None:
        _fill_between(image, enlarged(lane.left_px), enlarged(lane.right_px))
    for line_px in lane.memory_px:
        draw_polyline(image, enlarged(line_px), MEMORY_BGR, max(1, thickness // 2))
    for side_px, colour in ((lane.left_px, LEFT_BGR), (lane.right_px, RIGHT_BGR)):
        if side_px is not None:
            draw_polyline(image, enlarged(side_px), colour, thickness)


def _fill_between(image: UInt8[np.ndarray, "h w 3"], left_px: Polyline, right_px: Polyline) -> None:
    left_px, right_px = (line[np.isfinite(line).all(axis=1)] for line in (left_px, right_px))
    if min(len(left_px), len(right_px)) < 2:
        return
    outline = _clipped_area(np.concatenate([left_px, right_px[::-1]]), *_bounds(image))
    if len(outline) >= 3:
        filled = image.copy()
        cv2.fillPoly(filled, [np.rint(outline).astype(np.int32)], FILL_BGR)
        cv2.addWeighted(filled, _FILL_SHARE, image, 1.0 - _FILL_SHARE, 0.0, dst=image)


def _enlarged(frame_bgr: UInt8[np.ndarray, "h w *c"], scale: int) -> UInt8[np.ndarray, "sh sw 3"]:
    colour = cv2.cvtColor(frame_bgr, cv2.COLOR_GRAY2BGR) if frame_bgr.ndim == 2 else frame_bgr
    if scale == 1:
        return np.array(colour)
    return np.asarray(cv2.resize(colour, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR))


def _pixels(points_cm: Float[np.ndarray, "n 2"], camera: Camera, scale: int) -> Float[np.ndarray, "n 2"]:
    """Pixels of the enlarged image; NaN where unknown or so far outside that fixed point overflows."""
    known = np.isfinite(points_cm).all(axis=1)
    pixels = np.full_like(points_cm, np.nan)
    pixels[known] = (camera.project_ground(points_cm[known]) + 0.5) * scale - 0.5
    limit = 10.0 * scale * max(camera.width, camera.height)
    with np.errstate(invalid="ignore"):
        pixels[~(np.abs(pixels) < limit).all(axis=1)] = np.nan
    return pixels


def _fixed(point_px: Float[np.ndarray, "2"]) -> tuple[int, int]:
    return round(float(point_px[0]) * (1 << _SHIFT)), round(float(point_px[1]) * (1 << _SHIFT))


def draw_polyline(
    image: UInt8[np.ndarray, "h w 3"],
    points_px: Float[np.ndarray, "n 2"],
    colour: tuple[int, int, int],
    thickness: int,
) -> None:
    """Draw a line in the image, as far as it is inside; points with NaN interrupt it."""
    seen = np.isfinite(points_px).all(axis=1)
    for k in np.flatnonzero(seen[:-1] & seen[1:]):
        # A line is an area of two corners; clipping may repeat its ends.
        ends = _clipped_area(points_px[k : k + 2], *_bounds(image))
        if len(ends):
            along = ends @ (points_px[k + 1] - points_px[k])
            start, end = _fixed(ends[along.argmin()]), _fixed(ends[along.argmax()])
            cv2.line(image, start, end, colour, thickness, cv2.LINE_AA, _SHIFT)


def _bounds(
    image: UInt8[np.ndarray, "h w 3"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Lowest and highest place at which anything is drawn: the image and a margin wider than any line."""
    size = np.array([image.shape[1], image.shape[0]], np.float64)
    return -_MARGIN * size, (1.0 + _MARGIN) * size


def _clipped_area(
    outline_px: Float[np.ndarray, "n 2"], low_px: Float[np.ndarray, "2"], high_px: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "m 2"]:
    """The part of an area within a box: OpenCV's fixed point overflows far outside the image.

    Source:
        Sutherland and Hodgman 1974, "Reentrant polygon clipping", Communications of the ACM 17.
    """
    points = outline_px
    for axis, limit, sign in ((a, b[a], s) for a in (0, 1) for b, s in ((low_px, 1.0), (high_px, -1.0))):
        kept: list[np.ndarray] = []
        for k in range(len(points)):
            before, point = points[k - 1], points[k]
            was, now = (sign * (p[axis] - limit) >= 0.0 for p in (before, point))
            if was != now:
                share = (limit - before[axis]) / (point[axis] - before[axis])
                kept.append(before + share * (point - before))
            if now:
                kept.append(point)
        points = np.array(kept, np.float64).reshape(-1, 2)
    return points


def _draw_arrow(image: UInt8[np.ndarray, "h w 3"], steering_rad: float, thickness: int) -> None:
    """An arrow from the middle of the bottom edge: up is straight on, left is positive."""
    if not math.isfinite(steering_rad):
        return
    height, width = image.shape[:2]
    length = 0.25 * height
    tail = (0.5 * width, height - 1.0)
    tip = (tail[0] - length * math.sin(steering_rad), tail[1] - length * math.cos(steering_rad))
    cv2.arrowedLine(
        image, (round(tail[0]), round(tail[1])), (round(tip[0]), round(tip[1])), ARROW_BGR, thickness
    )


def _draw_text(image: UInt8[np.ndarray, "h w 3"], text: str, thickness: int) -> None:
    size = image.shape[1] / 800.0
    origin = (round(12 * size), round(30 * size))
    outlined_text(image, text, origin, size, TEXT_BGR, (0, 0, 0), thickness)


def outlined_text(
    image: UInt8[np.ndarray, "h w 3"],
    text: str,
    origin: tuple[int, int],
    size: float,
    colour: tuple[int, int, int],
    outline: tuple[int, int, int],
    thickness: int = 1,
) -> None:
    """Write a text that is readable on any ground.

    Args:
        image: Is written on.
        text: The text.
        origin: Of its lower left corner, [px].
        size: OpenCV's scale.
        colour: BGR.
        outline: BGR, of a rim as wide as the strokes.
        thickness: Of the strokes, [px].
    """
    u, v = origin
    # In OpenCV 5 thicker letters are wider, and would run out of step with thinner ones on them.
    rim = [(u + du, v + dv) for du in (-thickness, 0, thickness) for dv in (-thickness, 0, thickness)]
    for at, shade in (*((at, outline) for at in rim), (origin, colour)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, shade, thickness, cv2.LINE_AA)
