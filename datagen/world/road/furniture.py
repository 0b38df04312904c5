"""Road furniture, which is painted: stop lines, crossings, arrows, junctions, parking bays.

Settings list what is there, and are checked; random things go where there is room. Each thing is a set of
painted rectangles and the lines that it interrupts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.world.road.pieces import OneOf
from datagen.world.road.track import Bgr, Side, Track
from lanenet.config import Settings
from lanenet.errors import ConfigError

Colour = Literal["white", "yellow", "orange", "red", "blue", "black"]

COLOURS: dict[str, Bgr] = {
    "white": (235.0, 235.0, 235.0),
    "yellow": (40.0, 190.0, 230.0),
    "orange": (30.0, 110.0, 230.0),
    "red": (45.0, 40.0, 190.0),
    "blue": (165.0, 90.0, 30.0),
    "black": (25.0, 25.0, 25.0),
}
#: Stop bars of side roads are twice as thick as lines, up to this; wide lines are not made thicker.
_LINE_STOP_CM = 5.0
#: Arc per strip of tape; at 15 cm radius a strip leaves the arc by 0.07 cm.
_CORNER_STEP_RAD = 0.2
#: Random furniture: placement attempts per item; minimum distance along and beside the road. Chosen.
_TRIES = 15
_APART_CM = 30.0
_BESIDE_CM = 10.0
#: Spacing of the points whose distances are compared.
_OUTLINE_CM = 5.0
#: How far the end of a random crossing's bar may lie beside its bend: about a line's width.
_BAR_BESIDE_CM = 2.0
#: How much the road may turn over a junction, whose lines are straight.
_BEND_RAD = 0.1


class Paint(Settings):
    """What is painted at a place on the road.

    Attributes:
        at_cm: Of its middle, along the centre line.
        colour: Of the paint.
    """

    at_cm: float = Field(ge=0.0)
    colour: Colour = "white"


class StopLine(Paint):
    """A bar across the driven lane.

    Attributes:
        thickness_cm: Along the road.
        dashed: A row of squares (give way) instead of a bar.
    """

    thickness_cm: float = Field(default=4.0, gt=0.0)
    dashed: bool = False


class Zebra(Paint):
    """Bars along the road, over its whole width.

    Attributes:
        length_cm: Of the bars.
        bar_cm: Width of a bar.
        gap_cm: Between bars.
    """

    length_cm: float = Field(default=40.0, gt=0.0)
    bar_cm: float = Field(default=4.0, gt=0.0)
    gap_cm: float = Field(default=4.0, gt=0.0)


class Arrow(Paint):
    """An arrow in the middle of the driven lane, made of strips of tape.

    Attributes:
        direction: Where it points.
        length_cm: Along the road.
        strip_cm: Width of the tape.
    """

    direction: Literal["straight", "left", "right"] = "straight"
    length_cm: float = Field(default=30.0, gt=0.0)
    strip_cm: float = Field(default=3.0, gt=0.0)


class Junction(Paint):
    """A road that meets this one at a right angle; the lines at its mouth are interrupted.

    Attributes:
        sides: Where it leads to: one side (a T) or both (a cross).
        width_cm: Of the side road, between its lines.
        corner_radius_cm: Of the curve from line to line.
        length_cm: Of the side road, from the line of this one.
        stop: Bars at the ends of the side road.
        stop_colour: Of the bars; None: that of the paint.
        middle_colour: Of the dashes between the lanes of the side road; None: that of the paint.
    """

    sides: Literal["left", "right", "both"] = "right"
    width_cm: float = Field(default=40.0, gt=0.0)
    corner_radius_cm: float = Field(default=15.0, gt=0.0)
    length_cm: float = Field(default=100.0, gt=0.0)
    stop: bool = True
    stop_colour: Colour | None = None
    middle_colour: Colour | None = None


class Parking(Paint):
    """Parking bays beside the road.

    Attributes:
        side: Of the road.
        bays: How many.
        bay_cm: Length of a bay along the road.
        depth_cm: Across.
    """

    side: Side = "right"
    bays: int = Field(default=3, ge=1, le=50)
    bay_cm: float = Field(default=60.0, gt=0.0)
    depth_cm: float = Field(default=30.0, gt=0.0)


class Furniture(OneOf):
    """One thing on the road, named by its key."""

    stop_line: StopLine | None = None
    zebra: Zebra | None = None
    arrow: Arrow | None = None
    junction: Junction | None = None
    parking: Parking | None = None


class FurnitureRates(Settings):
    """How many things are placed at random, per metre of road.

    Attributes:
        stop_line_per_m: Stop lines.
        zebra_per_m: Crossings.
        arrow_per_m: Arrows.
        junction_per_m: Junctions.
        parking_per_m: Rows of parking bays.
        junction_stop_colour: Of the bars at junctions; None: that of the paint.
    """

    stop_line_per_m: float = Field(default=0.0, ge=0.0, le=2.0)
    zebra_per_m: float = Field(default=0.0, ge=0.0, le=2.0)
    arrow_per_m: float = Field(default=0.0, ge=0.0, le=2.0)
    junction_per_m: float = Field(default=0.0, ge=0.0, le=2.0)
    parking_per_m: float = Field(default=0.0, ge=0.0, le=2.0)
    junction_stop_colour: Colour | None = None


def extent_cm(item: Furniture) -> float:
    """Return the length along the road that something takes up."""
    match item.value:
        case StopLine(thickness_cm=length_cm) | Zebra(length_cm=length_cm) | Arrow(length_cm=length_cm):
            return float(length_cm)
        case Junction() as junction:
            return junction.width_cm + 2.0 * junction.corner_radius_cm
        case parking:
            return float(parking.bays * parking.bay_cm)


@dataclass(frozen=True, eq=False)
class Painted:
    """The paint of one thing.

    Attributes:
        boxes: Rectangles, see ``Track.boxes``.
        cuts: Interruptions of lines: offset of the line, start and end along the road, [cm].
    """

    boxes: Float[np.ndarray, "b 9"]
    cuts: tuple[tuple[float, float, float], ...] = ()


def paint_furniture(track: Track, item: Furniture, line_width_cm: float) -> Painted:
    """Paint one thing; its place must lie on the road."""
    return _PAINTERS[item.kind](track, item.value, line_width_cm)


def outer_offset_cm(track: Track, side: Side) -> float:
    """Offset of the outer line of the whole road on one side, left positive, [cm]."""
    return track.middle_cm + (track.half_width_cm if side == "left" else -track.half_width_cm)


_Point = tuple[float, float] | Float[np.ndarray, "2"]


class _Strips:
    """Collects rectangles given in the frame of one place: x ahead, y left."""

    def __init__(self, origin_cm: Float[np.ndarray, "2"], heading_rad: float, colour: str) -> None:
        self._origin, self._heading = origin_cm, heading_rad
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

    def strip(self, start: _Point, end: _Point, width_cm: float, overlap_cm: float = 0.0) -> None:
        """Add a strip of tape from point to point, longer by ``overlap_cm`` in total."""
        dx, dy = end[0] - start[0], end[1] - start[1]
        middle = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
        self.box(*middle, float(np.arctan2(dy, dx)), float(np.hypot(dx, dy)) + overlap_cm, width_cm)

    @property
    def boxes(self) -> Float[np.ndarray, "b 9"]:
        return np.array(self._rows).reshape(-1, 9)


def _stop_line(track: Track, stop: StopLine, _: float) -> Painted:
    strips = _Strips(*track.point(stop.at_cm), stop.colour)
    if not stop.dashed:
        strips.box(0.0, 0.0, 0.0, stop.thickness_cm, track.lane_width_cm)
        return Painted(strips.boxes)
    n = max(1, round(track.lane_width_cm / (2.0 * stop.thickness_cm)))
    for y_cm in (np.arange(n) - 0.5 * (n - 1)) * track.lane_width_cm / n:
        strips.box(0.0, float(y_cm), 0.0, stop.thickness_cm, 0.5 * track.lane_width_cm / n)
    return Painted(strips.boxes)


def _zebra(track: Track, zebra: Zebra, _: float) -> Painted:
    strips = _Strips(*track.point(zebra.at_cm), zebra.colour)
    width_cm, period_cm = 2.0 * track.half_width_cm, zebra.bar_cm + zebra.gap_cm
    n = max(1, int((width_cm - zebra.gap_cm) / period_cm))
    for y_cm in (np.arange(n) - 0.5 * (n - 1)) * period_cm + track.middle_cm:
        strips.box(0.0, float(y_cm), 0.0, zebra.length_cm, zebra.bar_cm)
    # The bars replace the line between the lanes.
    half_cm = 0.5 * zebra.length_cm
    cuts = ((track.middle_cm, zebra.at_cm - half_cm, zebra.at_cm + half_cm),) if track.oncoming_cm else ()
    return Painted(strips.boxes, cuts)


def _arrow(track: Track, arrow: Arrow, _: float) -> Painted:
    strips = _Strips(*track.point(arrow.at_cm), arrow.colour)
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
    strips = _Strips(*track.point(junction.at_cm), junction.colour)
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
            points = np.stack([x, y], axis=1)
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
    # In the frame map, since the row follows the road: separators are straight, back edges are chords.
    strips = _Strips(np.zeros(2), 0.0, parking.colour)
    starts, ends = (track.points(places, side_cm)[0] for side_cm in (line_cm, back_cm))
    for start, end in [*zip(starts, ends, strict=True), *pairwise(ends)]:
        strips.strip(start, end, line_width_cm)
    return Painted(strips.boxes)


_PAINTERS: dict[str, Callable[[Track, Any, float], Painted]] = {
    "stop_line": _stop_line,
    "zebra": _zebra,
    "arrow": _arrow,
    "junction": _junction,
    "parking": _parking,
}


def listed_furniture(
    track: Track, items: Sequence[Furniture], line_width_cm: float, where: str
) -> list[Painted]:
    """Paint what a file lists.

    Raises:
        ConfigError: If something lies beyond the end, on a bend that it does not fit, or on another section
            of the road; with its place in the list.
    """
    result = []
    for number, item in enumerate(items):
        problem = _misplaced(track, item)
        if problem is None:
            result.append(paint_furniture(track, item, line_width_cm))
            problem = _on_the_road(track, item, result[-1])
        if problem is not None:
            raise ConfigError(f"{where}: key 'furniture.{number}.{item.kind}.at_cm': {problem}")
    return result


def random_furniture(
    track: Track,
    rates: FurnitureRates,
    taken: Sequence[Furniture],
    line_width_cm: float,
    colour: Colour,
    rng: np.random.Generator,
    middle_colour: Colour | None = None,
) -> list[Painted]:
    """Draw things where there is room; what finds no room is left out.

    Args:
        track: The road.
        rates: How many.
        taken: Things that are there already.
        line_width_cm: Width of the tape.
        colour: Of the paint.
        rng: Source of randomness; each kind of thing has its own child.
        middle_colour: Of the line between two lanes; None: that of the paint.
    """
    colours: dict[str, dict[str, Any]] = {
        "junction": {"stop_colour": rates.junction_stop_colour, "middle_colour": middle_colour}
    }
    occupied = [(item.value.at_cm, extent_cm(item)) for item in taken]
    # Side roads and bays may meet beside the road even if they are far apart along it.
    outlines = [_outline(paint_furniture(track, item, line_width_cm).boxes) for item in taken]
    result = []
    # The order is part of the format: the widest things first, new kinds at the end.
    kinds = ("junction", "parking", "zebra", "stop_line", "arrow")
    for kind, kind_rng in zip(kinds, rng.spawn(len(kinds)), strict=True):
        expected = getattr(rates, f"{kind}_per_m") * track.length_cm / 100.0
        for _ in range(kind_rng.poisson(expected)):
            for _ in range(_TRIES):
                at_cm = float(kind_rng.uniform(0.0, track.length_cm))
                thing = _random_thing(track, kind, at_cm, kind_rng)
                thing = thing.model_copy(update={"colour": colour, **colours.get(kind, {})})
                item = Furniture.model_validate({kind: thing})
                if not _is_free(track, item, occupied) or _misplaced(track, item) is not None:
                    continue
                if kind == "zebra" and _leaves_the_bend(track, item):
                    continue
                painted = paint_furniture(track, item, line_width_cm)
                outline = _outline(painted.boxes)
                if any(_meets(outline, other, _BESIDE_CM) for other in outlines):
                    continue
                if _on_the_road(track, item, painted) is None:
                    outlines.append(outline)
                    occupied.append((at_cm, extent_cm(item)))
                    result.append(painted)
                    break
    return result


def _random_thing(track: Track, kind: str, at_cm: float, rng: np.random.Generator) -> Any:
    lane_cm = track.lane_width_cm
    share, choice, size = rng.random(3)
    if kind == "junction":
        return Junction(
            at_cm=at_cm,
            sides="left" if choice < 0.35 else "right" if choice < 0.7 else "both",
            width_cm=2.0 * track.half_width_cm,
            corner_radius_cm=lane_cm * (0.25 + 0.5 * size),
            length_cm=lane_cm * (2.0 + 2.0 * share),
            stop=bool(rng.random() < 0.7),
        )
    if kind == "parking":
        across = choice < 0.4
        return Parking(
            at_cm=at_cm,
            side="right" if share < 0.8 else "left",
            bays=1 + int(4.0 * size),
            bay_cm=lane_cm * (0.85 if across else 1.6),
            depth_cm=lane_cm * (1.2 if across else 0.75),
        )
    if kind == "zebra":
        bar_cm = 3.0 + 3.0 * share
        return Zebra(at_cm=at_cm, length_cm=lane_cm * (0.7 + 0.6 * size), bar_cm=bar_cm, gap_cm=bar_cm)
    if kind == "stop_line":
        return StopLine(at_cm=at_cm, thickness_cm=2.0 + 3.0 * size, dashed=bool(choice < 0.3))
    return Arrow(
        at_cm=at_cm,
        direction="straight" if choice < 0.34 else "left" if choice < 0.67 else "right",
        length_cm=lane_cm * (0.6 + 0.4 * size),
        strip_cm=1.5 + 2.0 * share,
    )


def _leaves_the_bend(track: Track, item: Furniture) -> bool:
    """Whether straight bars would reach over the lines of a bent road."""
    at_cm, length_cm = item.value.at_cm, extent_cm(item)
    places = np.arange(at_cm - 0.5 * length_cm, at_cm + 0.5 * length_cm, track.step_cm)
    tightest = float(np.abs(track.curvature(places)).max())
    return tightest * length_cm**2 / 8.0 > _BAR_BESIDE_CM


def _is_free(track: Track, item: Furniture, occupied: Sequence[tuple[float, float]]) -> bool:
    at_cm, length_cm = np.reshape(occupied, (-1, 2)).T
    apart = np.abs(item.value.at_cm - at_cm)
    if track.closed:
        apart = np.minimum(apart, track.length_cm - apart)
    return bool(np.all(apart >= 0.5 * (extent_cm(item) + length_cm) + _APART_CM))


def _misplaced(track: Track, item: Furniture) -> str | None:
    """What is wrong with the place along the road, or None."""
    at_cm, half_cm = item.value.at_cm, 0.5 * extent_cm(item)
    last_cm = track.length_cm - (0.0 if track.closed else half_cm)
    first_cm = 0.0 if track.closed else half_cm
    if not first_cm <= at_cm <= last_cm:
        return (
            f"found {at_cm:g}, expected {first_cm:g} to {last_cm:.1f}: the road is {track.length_cm:.1f} cm "
            f"long and this takes up {2.0 * half_cm:.1f} cm"
        )
    places = np.arange(at_cm - half_cm, at_cm + half_cm + track.step_cm, track.step_cm)
    curvature = track.curvature(places)
    if item.junction is not None:
        turn = float(np.abs(np.cumsum(curvature)).max()) * track.step_cm
        if turn > _BEND_RAD:
            return (
                f"found a road that turns by {np.rad2deg(turn):.0f} degrees over the junction at "
                f"{at_cm:g} cm, expected at most {np.rad2deg(_BEND_RAD):.0f}"
            )
    if item.parking is not None:
        inwards = curvature if item.parking.side == "left" else -curvature
        back_cm = track.half_width_cm + abs(track.middle_cm) + item.parking.depth_cm
        if inwards.max() * back_cm > 0.8:
            return (
                f"found a bend of {1.0 / inwards.max():.0f} cm towards the bays at {at_cm:g} cm, expected "
                f"at least {back_cm / 0.8:.0f}"
            )
    return None


def _on_the_road(track: Track, item: Furniture, painted: Painted) -> str | None:
    """What is wrong if something beside the road lies on another section of it, or None."""
    if item.junction is None and item.parking is None:
        return None
    outer = _outline(painted.boxes)
    gap = np.abs(track.s_cm - item.value.at_cm)
    if track.closed:
        gap = np.minimum(gap, track.length_cm - gap)
    reach = track.half_width_cm + 2.0
    # The section beside the thing itself does not count, nor, for bends, some more of the road around it.
    others = np.flatnonzero(gap > 0.5 * extent_cm(item) + 2.0 * reach)[::3]
    middle = track.beside(others, track.middle_cm)
    for i in range(0, len(middle), 4096):
        d = np.linalg.norm(outer[:, None] - middle[None, i : i + 4096], axis=2)
        if d.min() < reach:
            s_cm = track.s_cm[others[i + int(d.min(axis=0).argmin())]]
            return f"it lies on another section of the road, at {s_cm:.0f} cm; make it shorter or move it"
    return None


def _outline(boxes: Float[np.ndarray, "b 9"]) -> Float[np.ndarray, "c 2"]:
    """Points along the middle of all strips."""
    points = [np.empty((0, 2))]
    for box in boxes:
        share = np.linspace(-1.0, 1.0, max(2, int(np.ceil(2.0 * box[4] / _OUTLINE_CM)) + 1))
        points.append(box[:2] + (share * box[4])[:, None] * box[2:4])
    return np.concatenate(points)


def _meets(a_cm: Float[np.ndarray, "a 2"], b_cm: Float[np.ndarray, "b 2"], within_cm: float) -> bool:
    return bool((np.linalg.norm(a_cm[:, None] - b_cm[None], axis=2) < within_cm).any())
