"""Rectangles of paint for each thing on the road, and the lines that it interrupts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from datagen.world.furniture import COLOURS, Arrow, Furniture, Junction, Parking, StopLine, Zebra, extent_cm
from datagen.world.road import Bgr, Side, Track

_LINE_STOP_CM = 5.0  # stop bars of side roads are twice as thick as lines, but wide lines stay as they are
_CORNER_STEP_RAD = 0.2  # arc per strip of tape; at 15 cm radius a strip leaves the arc by 0.02 cm


@dataclass(frozen=True, eq=False)
class Painted:
    """What one thing needs.

    Attributes:
        boxes: Rectangles, see ``Track.boxes``.
        cuts: Offset of the line, start and end along the road of what is not painted, [cm].
    """

    boxes: Float[np.ndarray, "b 9"]
    cuts: tuple[tuple[float, float, float], ...] = ()


def paint_furniture(track: Track, item: Furniture, line_width_cm: float) -> Painted:
    """Paint one thing; its place must lie on the road."""
    match item.value:
        case StopLine() as stop:
            return _stop_line(track, stop)
        case Zebra() as zebra:
            return _zebra(track, zebra)
        case Arrow() as arrow:
            return _arrow(track, arrow)
        case Junction() as junction:
            return _junction(track, junction, line_width_cm)
        case Parking() as parking:
            return _parking(track, parking, line_width_cm)
    raise TypeError(f"cannot paint {item.kind}")


def outer_offset_cm(track: Track, side: Side) -> float:
    """Offset of the outer line of the whole road on one side, left positive, [cm]."""
    return track.middle_cm + (track.half_width_cm if side == "left" else -track.half_width_cm)


class _Strips:
    """Collects rectangles given in the frame of one place on the road: x ahead, y left."""

    def __init__(self, track: Track, at_cm: float, colour: str) -> None:
        self._origin, self._heading = track.point(at_cm)
        self._colour: Bgr = COLOURS[colour]
        self._rows: list[list[float]] = []

    def box(
        self,
        x_cm: float,
        y_cm: float,
        angle_rad: float,
        length_cm: float,
        width_cm: float,
        colour: str | None = None,
    ) -> None:
        c, s = np.cos(self._heading), np.sin(self._heading)
        x, y = self._origin[0] + x_cm * c - y_cm * s, self._origin[1] + x_cm * s + y_cm * c
        direction = self._heading + angle_rad
        bgr = self._colour if colour is None else COLOURS[colour]
        self._rows.append([x, y, np.cos(direction), np.sin(direction), 0.5 * length_cm, 0.5 * width_cm, *bgr])

    def strip(
        self, start: tuple[float, float], end: tuple[float, float], width_cm: float, overlap_cm: float = 0.0
    ) -> None:
        """Lay a strip of tape from point to point, longer by ``overlap_cm`` in all."""
        dx, dy = end[0] - start[0], end[1] - start[1]
        middle = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
        self.box(*middle, float(np.arctan2(dy, dx)), float(np.hypot(dx, dy)) + overlap_cm, width_cm)

    @property
    def boxes(self) -> Float[np.ndarray, "b 9"]:
        return np.array(self._rows).reshape(-1, 9)


def _stop_line(track: Track, stop: StopLine) -> Painted:
    strips = _Strips(track, stop.at_cm, stop.colour)
    if not stop.dashed:
        strips.box(0.0, 0.0, 0.0, stop.thickness_cm, track.lane_width_cm)
        return Painted(strips.boxes)
    n = max(1, round(track.lane_width_cm / (2.0 * stop.thickness_cm)))
    for y_cm in (np.arange(n) - 0.5 * (n - 1)) * track.lane_width_cm / n:
        strips.box(0.0, float(y_cm), 0.0, stop.thickness_cm, 0.5 * track.lane_width_cm / n)
    return Painted(strips.boxes)


def _zebra(track: Track, zebra: Zebra) -> Painted:
    strips = _Strips(track, zebra.at_cm, zebra.colour)
    width_cm, period_cm = 2.0 * track.half_width_cm, zebra.bar_cm + zebra.gap_cm
    n = max(1, int((width_cm - zebra.gap_cm) / period_cm))
    for y_cm in (np.arange(n) - 0.5 * (n - 1)) * period_cm + track.middle_cm:
        strips.box(0.0, float(y_cm), 0.0, zebra.length_cm, zebra.bar_cm)
    # The bars take the place of the line between the lanes.
    half_cm = 0.5 * zebra.length_cm
    cuts = ((track.middle_cm, zebra.at_cm - half_cm, zebra.at_cm + half_cm),) if track.oncoming_cm else ()
    return Painted(strips.boxes, cuts)


def _arrow(track: Track, arrow: Arrow) -> Painted:
    strips = _Strips(track, arrow.at_cm, arrow.colour)
    half_cm, head_cm, width_cm = 0.5 * arrow.length_cm, 0.35 * arrow.length_cm, arrow.strip_cm
    tip, back = (half_cm, 0.0), (-1.0, 0.0)
    if arrow.direction != "straight":
        side = 1.0 if arrow.direction == "left" else -1.0
        turn_cm = half_cm - head_cm
        strips.strip((-half_cm, 0.0), (turn_cm, 0.0), width_cm)
        tip, back = (turn_cm, side * 0.55 * arrow.length_cm), (0.0, -side)
        strips.strip((turn_cm, -side * 0.5 * width_cm), tip, width_cm)
    else:
        strips.strip((-half_cm, 0.0), tip, width_cm)
    for across in (1.0, -1.0):
        barb = (
            tip[0] + 0.7 * head_cm * (back[0] + across * back[1]),
            tip[1] + 0.7 * head_cm * (back[1] + across * back[0]),
        )
        strips.strip(tip, barb, width_cm)
    return Painted(strips.boxes)


def _junction(track: Track, junction: Junction, line_width_cm: float) -> Painted:
    strips = _Strips(track, junction.at_cm, junction.colour)
    sides: tuple[Side, ...] = ("left", "right") if junction.sides == "both" else (junction.sides,)
    half_cm, radius_cm = 0.5 * junction.width_cm, junction.corner_radius_cm
    reach_cm = 0.5 * extent_cm(Furniture(junction=junction))
    between = (junction.at_cm - reach_cm, junction.at_cm + reach_cm)
    cuts = []
    for side in sides:
        sign = 1.0 if side == "left" else -1.0
        line_cm = outer_offset_cm(track, side)
        cuts.append((line_cm, *between))
        for ahead in (1.0, -1.0):
            angles = np.linspace(0.0, 0.5 * np.pi, int(np.ceil(0.5 * np.pi / _CORNER_STEP_RAD)) + 1)
            x = ahead * (reach_cm - radius_cm * np.sin(angles))
            y = line_cm + sign * radius_cm * (1.0 - np.cos(angles))
            points = [(float(a), float(b)) for a, b in zip(x, y, strict=True)]
            # A little longer than the chords, so that no gap opens on the outside of the curve.
            overlap_cm = line_width_cm * np.tan(0.25 * np.pi / (len(points) - 1))
            for start, end in pairwise(points):
                strips.strip(start, end, line_width_cm, overlap_cm)
            if junction.length_cm > radius_cm:
                strips.strip(
                    points[-1], (ahead * half_cm, line_cm + sign * junction.length_cm), line_width_cm
                )
        if track.oncoming_cm is not None:
            # Dashes between the two lanes of the side road, half a lane long.
            dash_cm = 0.25 * junction.width_cm
            for start_cm in np.arange(radius_cm + dash_cm, junction.length_cm - dash_cm, 2.0 * dash_cm):
                y_cm = line_cm + sign * (float(start_cm) + 0.5 * dash_cm)
                strips.box(0.0, y_cm, 0.5 * np.pi, dash_cm, line_width_cm, junction.middle_colour)
        if junction.stop:
            # Across the lane that comes towards this road: on its right.
            width_cm = half_cm if track.oncoming_cm is not None else junction.width_cm
            x_cm = -sign * 0.5 * half_cm if track.oncoming_cm is not None else 0.0
            y_cm = line_cm + sign * (radius_cm + 2.0 * line_width_cm)
            thick_cm = max(line_width_cm, min(2.0 * line_width_cm, _LINE_STOP_CM))
            strips.box(x_cm, y_cm, 0.0, width_cm, thick_cm, junction.stop_colour)
    if junction.sides == "both" and track.oncoming_cm is not None:
        cuts.append((track.middle_cm, *between))
    return Painted(strips.boxes, tuple(cuts))


def _parking(track: Track, parking: Parking, line_width_cm: float) -> Painted:
    sign = 1.0 if parking.side == "left" else -1.0
    line_cm = outer_offset_cm(track, parking.side)
    back_cm = line_cm + sign * parking.depth_cm
    places = parking.at_cm + (np.arange(parking.bays + 1) - 0.5 * parking.bays) * parking.bay_cm
    # In the map, since the row follows the road: each separator is straight, each back edge a chord.
    boxes = []
    ends = [track.point(float(s), back_cm)[0] for s in places]
    for s, end in zip(places, ends, strict=True):
        start = track.point(float(s), line_cm)[0]
        boxes.append(_strip_row(start, end, line_width_cm, COLOURS[parking.colour]))
    for start, end in pairwise(ends):
        boxes.append(_strip_row(start, end, line_width_cm, COLOURS[parking.colour]))
    return Painted(np.array(boxes).reshape(-1, 9))


def _strip_row(
    start_cm: Float[np.ndarray, "2"], end_cm: Float[np.ndarray, "2"], width_cm: float, colour_bgr: Bgr
) -> list[float]:
    along = end_cm - start_cm
    length = float(np.hypot(*along))
    middle = 0.5 * (start_cm + end_cm)
    return [*middle, *(along / length), 0.5 * length, 0.5 * width_cm, *colour_bgr]
