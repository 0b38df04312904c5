"""Roads from pieces that are written down: straights, arcs, clothoids, S-bends, kinks.

A list in YAML has entries that say by one key what they are: ``- arc: {radius_cm: 80, angle_deg: 90}``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_serializer, model_validator

from datagen.world.road.centre_line import CentreLine, Section, end_of, kink_section, sample_sections
from lanenet.config import Settings
from lanenet.errors import ConfigError

Turn = Literal["left", "right"]

#: How far the ends of a loop may miss each other: what hand-written lengths and angles leave.
_GAP_CM, _GAP_DEG = 5.0, 3.0


class OneOf(Settings):
    """An entry of which exactly one key is set."""

    @model_validator(mode="after")
    def _exactly_one(self) -> OneOf:
        names = self.keys_set
        if len(names) != 1:
            known = ", ".join(type(self).model_fields)
            raise ValueError(f"expected exactly one of {known}, found {' and '.join(names) or 'none'}")
        return self

    @model_serializer(mode="wrap")
    def _only_what_is_set(self, handler: Callable[[Any], Any]) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if value is not None}

    @property
    def keys_set(self) -> list[str]:
        """Names of the keys that are set."""
        return [name for name in type(self).model_fields if getattr(self, name) is not None]

    @property
    def kind(self) -> str:
        """Name of the one key."""
        return self.keys_set[0]

    @property
    def value(self) -> Any:
        """What stands under it."""
        return getattr(self, self.kind)


class StraightPiece(Settings):
    """A straight.

    Attributes:
        length_cm: Along the centre line.
    """

    length_cm: float = Field(gt=0.0)


class ArcPiece(Settings):
    """A part of a circle.

    Attributes:
        radius_cm: Of the centre line.
        angle_deg: By which the road turns.
        direction: Where it turns.
    """

    radius_cm: float = Field(gt=0.0)
    angle_deg: float = Field(gt=0.0, le=360.0)
    direction: Turn


class ClothoidPiece(Settings):
    """A bend whose curvature changes evenly; a radius that is left out is infinite.

    Attributes:
        length_cm: Along the centre line.
        from_radius_cm: At its start.
        to_radius_cm: At its end.
        direction: Where it bends.
    """

    length_cm: float = Field(gt=0.0)
    from_radius_cm: float | None = Field(default=None, gt=0.0)
    to_radius_cm: float | None = Field(default=None, gt=0.0)
    direction: Turn

    @model_validator(mode="after")
    def _bends(self) -> ClothoidPiece:
        if self.from_radius_cm is None and self.to_radius_cm is None:
            raise ValueError("expected from_radius_cm or to_radius_cm, found neither; use straight")
        return self


class SBendPiece(Settings):
    """Two arcs in opposite directions; the road goes on parallel to itself.

    Attributes:
        radius_cm: Radius of both arcs.
        angle_deg: Of each arc.
        direction: Of the first arc.
        straight_cm: Between the arcs.
    """

    radius_cm: float = Field(gt=0.0)
    angle_deg: float = Field(gt=0.0, le=150.0)
    direction: Turn
    straight_cm: float = Field(default=0.0, ge=0.0)


class KinkPiece(Settings):
    """A corner without a bend, where the road goes from one straight to the next.

    All lines turn at once, as tape does that is laid in straight sections: at the corner, the lane is wider
    than elsewhere by one over the cosine of half the angle.

    Attributes:
        angle_deg: Of the turn.
        direction: Where it turns.
    """

    angle_deg: float = Field(gt=0.0, le=100.0)
    direction: Turn


class Piece(OneOf):
    """One piece of a road, named by its key."""

    straight: StraightPiece | None = None
    arc: ArcPiece | None = None
    clothoid: ClothoidPiece | None = None
    s_bend: SBendPiece | None = None
    kink: KinkPiece | None = None

    def sections(self) -> list[Section]:
        """Return its sections of evenly changing curvature."""
        piece = self.value
        if isinstance(piece, StraightPiece):
            return [(piece.length_cm, 0.0, 0.0)]
        sign = 1.0 if piece.direction == "left" else -1.0
        if isinstance(piece, ClothoidPiece):
            start, end = (0.0 if r is None else sign / r for r in (piece.from_radius_cm, piece.to_radius_cm))
            return [(piece.length_cm, start, end)]
        if isinstance(piece, KinkPiece):
            return [kink_section(sign * float(np.deg2rad(piece.angle_deg)))]
        k = sign / piece.radius_cm
        arc_cm = float(np.deg2rad(piece.angle_deg)) * piece.radius_cm
        if isinstance(piece, ArcPiece):
            return [(arc_cm, k, k)]
        between = [(piece.straight_cm, 0.0, 0.0)] if piece.straight_cm > 0.0 else []
        return [(arc_cm, k, k), *between, (arc_cm, -k, -k)]

    def bends(self) -> list[tuple[str, float, Turn]]:
        """Return each radius with its key and direction."""
        piece, found = self.value, []
        for key in ("radius_cm", "from_radius_cm", "to_radius_cm"):
            radius_cm = getattr(piece, key, None)
            if radius_cm is not None:
                found.append((key, radius_cm, piece.direction))
        if isinstance(piece, SBendPiece):
            found.append(("radius_cm", piece.radius_cm, "right" if piece.direction == "left" else "left"))
        return found


def length_of(pieces: Sequence[Piece]) -> float:
    """Return the length of the centre line, [cm]."""
    return float(sum(section[0] for piece in pieces for section in piece.sections()))


def lay_out(pieces: Sequence[Piece], closed: bool, where: str, crosses: bool = False) -> CentreLine:
    """Join pieces to a centre line, from the origin along +x.

    A loop whose ends miss each other a little is bent evenly until they meet.

    Args:
        pieces: The pieces in the direction of travel.
        closed: Whether the end joins the start.
        where: What errors call the road.
        crosses: Whether the road may cross itself; a figure of eight turns by 0 degrees in sum.

    Raises:
        ConfigError: If a loop does not close, with the gap in cm and degrees.
    """
    sections = [section for piece in pieces for section in piece.sections()]
    heading, end = end_of(sections)
    laps = round(heading / (2.0 * np.pi)) if crosses else np.copysign(1.0, heading)
    turn_deg = float(np.rad2deg(heading - laps * 2.0 * np.pi))
    gap_cm = float(abs(end))
    if closed and (gap_cm > _GAP_CM or abs(turn_deg) > _GAP_DEG):
        raise ConfigError(
            f"{where}: pieces: a closed road whose end misses its start by {gap_cm:.1f} cm "
            f"({end.real:+.1f} along, {end.imag:+.1f} left) and {turn_deg:+.1f} degrees, expected at most "
            f"{_GAP_CM:g} cm and {_GAP_DEG:g} degrees; change the pieces, or set closed: false"
        )
    return sample_sections(sections, closed)
