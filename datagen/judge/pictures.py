"""Top views: a road from above, with the way that each entrant drove."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.judge.run import RunResult, Trajectory
from datagen.world.track import Marking, Track

_SIDE_PX = 1100  # of the longer side of the road
_MARGIN_CM = 50.0
_ROW_PX = 26
_SHIFT = 4  # OpenCV draws in fixed point: this many bits below a pixel
_GROUND_BGR, _ROAD_BGR, _TEXT_BGR = (225, 228, 225), (120, 120, 120), (30, 30, 30)
#: BGR by place among the entrants; more of them start over.
COLOURS_BGR: tuple[tuple[int, int, int], ...] = (
    (40, 40, 40),
    (230, 140, 20),
    (30, 160, 40),
    (20, 110, 245),
    (200, 40, 200),
    (40, 40, 220),
    (200, 190, 0),
)


@dataclass(frozen=True)
class _View:
    """From the map to the picture."""

    origin_cm: Float[np.ndarray, "2"]
    px_per_cm: float
    top_px: int

    def fixed(self, xy_cm: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """Points in OpenCV's fixed point; y of the map is up."""
        px = (xy_cm - self.origin_cm) * [self.px_per_cm, -self.px_per_cm] + [0.0, self.top_px]
        return np.rint(px * (1 << _SHIFT)).astype(np.int32)


def draw_top_view(
    track: Track, runs: Sequence[tuple[RunResult, Trajectory]], title: str
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a road and the runs on it.

    A filled dot marks where a departure begins, a cross where the car was put back.

    Args:
        track: The road.
        runs: Results and trajectories, in the order of their colours.
        title: For the top left corner.
    """
    # Markings reach beyond the driven lane where the road has another one.
    half_cm = 0.5 * track.lane_width_cm
    sides_cm = [-half_cm, half_cm, *(marking.offset_cm for marking in track.markings)]
    reach_cm = max(abs(side_cm) for side_cm in sides_cm) + _MARGIN_CM
    low_cm, high_cm = track.xy_cm.min(axis=0) - reach_cm, track.xy_cm.max(axis=0) + reach_cm
    size_cm = high_cm - low_cm
    scale = _SIDE_PX / float(size_cm.max())
    header_px = _ROW_PX * (len(runs) + 1) + 12
    width, height = max(760, round(size_cm[0] * scale)), round(size_cm[1] * scale) + header_px
    picture = np.full((height, width, 3), _GROUND_BGR, np.uint8)
    view = _View(np.array([low_cm[0], high_cm[1]]), scale, header_px)
    road_px = max(1, round(scale * (max(sides_cm) - min(sides_cm) + 6.0)))
    points = view.fixed(_beside(track, 0.5 * (max(sides_cm) + min(sides_cm))))
    cv2.polylines(picture, [points], track.closed, _ROAD_BGR, road_px, cv2.LINE_AA, _SHIFT)
    for marking in track.markings:
        _draw_marking(picture, track, marking, view)
    for index, (_, trajectory) in enumerate(runs):
        # Later ones are thinner, so that those who drove the same way stay visible below.
        thickness = min(2 + len(runs) - 1 - index, 7)
        _draw_run(picture, trajectory, COLOURS_BGR[index % len(COLOURS_BGR)], thickness, view)
    _draw_start(picture, track, max(sides_cm) + 18.0, view)
    _write(picture, title, 0, _TEXT_BGR)
    for index, (result, _) in enumerate(runs):
        text = (
            f"{result.entrant}: {result.laps:.2f} laps, {result.departures} departures, "
            f"{result.put_backs} put back, offset {result.mean_offset_cm:.2f} cm mean, "
            f"{result.worst_offset_cm:.1f} cm worst"
        )
        _write(picture, text, index + 1, COLOURS_BGR[index % len(COLOURS_BGR)])
    return picture


def _beside(track: Track, offset_cm: float) -> Float[np.ndarray, "n 2"]:
    normal = np.stack([-np.sin(track.heading_rad), np.cos(track.heading_rad)], axis=1)
    return track.xy_cm + offset_cm * normal


def _draw_marking(picture: UInt8[np.ndarray, "h w 3"], track: Track, marking: Marking, view: _View) -> None:
    line_cm = _beside(track, marking.offset_cm)
    colour = tuple(int(v) for v in marking.colour_bgr)
    thickness = max(1, round(view.px_per_cm * marking.width_cm))
    n = len(line_cm)
    for start_cm, end_cm in marking.painted_cm:
        rows = np.arange(int(np.ceil(start_cm / track.step_cm)), int(end_cm / track.step_cm) + 1)
        rows = rows[: n + 1] % n if track.closed else rows[(rows >= 0) & (rows < n)]
        if rows.size:
            cv2.polylines(picture, [view.fixed(line_cm[rows])], False, colour, thickness, cv2.LINE_AA, _SHIFT)


def _draw_run(
    picture: UInt8[np.ndarray, "h w 3"],
    trajectory: Trajectory,
    colour: tuple[int, int, int],
    thickness: int,
    view: _View,
) -> None:
    points = view.fixed(trajectory.xy_cm)
    for piece in np.split(points, np.flatnonzero(trajectory.put_back) + 1):
        if len(piece):
            cv2.polylines(picture, [piece], False, colour, thickness, cv2.LINE_AA, _SHIFT)
    begins = np.flatnonzero(trajectory.over & ~np.concatenate([[False], trajectory.over[:-1]]))
    for x, y in points[begins].tolist():
        cv2.circle(picture, (x, y), 5 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
        cv2.circle(picture, (x, y), 5 << _SHIFT, (255, 255, 255), 1, cv2.LINE_AA, _SHIFT)
    for x, y in (points[trajectory.put_back] >> _SHIFT).tolist():
        cv2.drawMarker(picture, (x, y), colour, cv2.MARKER_TILTED_CROSS, 14, 3)


def _draw_start(picture: UInt8[np.ndarray, "h w 3"], track: Track, offset_cm: float, view: _View) -> None:
    """An arrow beside the start, in the direction of travel."""
    heading = float(track.heading_rad[0])
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    tail_cm = track.xy_cm[0] + offset_cm * left
    tail, tip = (view.fixed(np.stack([tail_cm, tail_cm + 40.0 * ahead])) >> _SHIFT).tolist()
    cv2.arrowedLine(picture, tail, tip, _TEXT_BGR, 2, cv2.LINE_AA, tipLength=0.35)


def _write(picture: UInt8[np.ndarray, "h w 3"], text: str, row: int, colour: tuple[int, int, int]) -> None:
    place = (12, _ROW_PX * (row + 1))
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, 2 if row else 1, cv2.LINE_AA)
