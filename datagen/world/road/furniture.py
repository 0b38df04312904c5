"""Settings of road furniture, which is painted: stop lines, crossings, arrows, junctions, parking bays."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from datagen.world.road.one_of import OneOf
from datagen.world.road.track import Bgr, Side
from lanenet.config import Settings

Colour = Literal["white", "yellow", "orange", "red", "black"]

COLOURS: dict[str, Bgr] = {
    "white": (235.0, 235.0, 235.0),
    "yellow": (40.0, 190.0, 230.0),
    "orange": (30.0, 110.0, 230.0),
    "red": (45.0, 40.0, 190.0),
    "black": (25.0, 25.0, 25.0),
}


class StopLine(Settings):
    """A bar across the driven lane.

    Attributes:
        at_cm: Of its middle, along the centre line.
        thickness_cm: Along the road.
        colour: Of the paint.
        dashed: A row of squares (give way) instead of a bar.
    """

    at_cm: float = Field(ge=0.0)
    thickness_cm: float = Field(default=4.0, gt=0.0)
    colour: Colour = "white"
    dashed: bool = False


class Zebra(Settings):
    """Bars along the road, over its whole width.

    Attributes:
        at_cm: Of its middle, along the centre line.
        length_cm: Of the bars.
        bar_cm: Width of a bar.
        gap_cm: Between bars.
        colour: Of the paint.
    """

    at_cm: float = Field(ge=0.0)
    length_cm: float = Field(default=40.0, gt=0.0)
    bar_cm: float = Field(default=4.0, gt=0.0)
    gap_cm: float = Field(default=4.0, gt=0.0)
    colour: Colour = "white"


class Arrow(Settings):
    """An arrow in the middle of the driven lane, made of strips of tape.

    Attributes:
        at_cm: Of its middle, along the centre line.
        direction: Where it points.
        length_cm: Along the road.
        strip_cm: Width of the tape.
        colour: Of the paint.
    """

    at_cm: float = Field(ge=0.0)
    direction: Literal["straight", "left", "right"] = "straight"
    length_cm: float = Field(default=30.0, gt=0.0)
    strip_cm: float = Field(default=3.0, gt=0.0)
    colour: Colour = "white"


class Junction(Settings):
    """A road that meets this one at a right angle; the lines at its mouth are interrupted.

    Attributes:
        at_cm: Of its middle, along the centre line.
        sides: Where it leads to: one side (a T) or both (a cross).
        width_cm: Of the side road, between its lines.
        corner_radius_cm: Of the curve from line to line.
        length_cm: Of the side road, from the line of this one.
        stop: Bars at the ends of the side road.
        stop_colour: Of the bars; None: that of the paint.
        middle_colour: Of the dashes between the lanes of the side road; None: that of the paint.
        colour: Of the paint.
    """

    at_cm: float = Field(ge=0.0)
    sides: Literal["left", "right", "both"] = "right"
    width_cm: float = Field(default=40.0, gt=0.0)
    corner_radius_cm: float = Field(default=15.0, gt=0.0)
    length_cm: float = Field(default=100.0, gt=0.0)
    stop: bool = True
    stop_colour: Colour | None = None
    middle_colour: Colour | None = None
    colour: Colour = "white"


class Parking(Settings):
    """Parking bays beside the road.

    Attributes:
        at_cm: Of the middle of the row, along the centre line.
        side: Of the road.
        bays: How many.
        bay_cm: Length of a bay along the road.
        depth_cm: Across.
        colour: Of the paint.
    """

    at_cm: float = Field(ge=0.0)
    side: Side = "right"
    bays: int = Field(default=3, ge=1, le=50)
    bay_cm: float = Field(default=60.0, gt=0.0)
    depth_cm: float = Field(default=30.0, gt=0.0)
    colour: Colour = "white"


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
        case StopLine() as line:
            return line.thickness_cm
        case Zebra() | Arrow() as thing:
            return thing.length_cm
        case Junction() as junction:
            return junction.width_cm + 2.0 * junction.corner_radius_cm
        case Parking() as parking:
            return parking.bays * parking.bay_cm
    raise TypeError(f"no extent of {item.kind}")
