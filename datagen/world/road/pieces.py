"""Roads from pieces that are written down: straights, arcs, clothoids, S-bends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from datagen.world.road.centre_line import CentreLine
from datagen.world.road.one_of import OneOf
from lanenet.config import Settings
from lanenet.errors import ConfigError

Turn = Literal["left", "right"]
#: Length, [cm], and curvature at its start and end, [1/cm], positive left; linear in between.
Stretch = tuple[float, float, float]

_SAMPLE_CM = 1.0
_GAP_CM, _GAP_DEG = 5.0, 3.0  # how far the ends of a loop may miss each other
_SPREAD_ROUNDS = 8


class StraightPiece(Settings):
    """A straight."""

    length_cm: float = Field(gt=0.0)


class ArcPiece(Settings):
    """A part of a circle."""

    radius_cm: float = Field(gt=0.0)
    angle_deg: float = Field(gt=0.0, le=360.0)
    direction: Turn


class ClothoidPiece(Settings):
    """A bend whose curvature changes evenly; a radius left out stands for straight on.

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
        radius_cm: Of both arcs.
        angle_deg: Of each arc.
        direction: Of the first arc.
        straight_cm: Between the arcs.
    """

    radius_cm: float = Field(gt=0.0)
    angle_deg: float = Field(gt=0.0, le=150.0)
    direction: Turn
    straight_cm: float = Field(default=0.0, ge=0.0)


class Piece(OneOf):
    """One piece of a road, named by its key."""

    straight: StraightPiece | None = None
    arc: ArcPiece | None = None
    clothoid: ClothoidPiece | None = None
    s_bend: SBendPiece | None = None

    def stretches(self) -> list[Stretch]:
        """Return its stretches of evenly changing curvature."""
        piece = self.value
        if isinstance(piece, StraightPiece):
            return [(piece.length_cm, 0.0, 0.0)]
        sign = 1.0 if piece.direction == "left" else -1.0
        if isinstance(piece, ClothoidPiece):
            start, end = (0.0 if r is None else sign / r for r in (piece.from_radius_cm, piece.to_radius_cm))
            return [(piece.length_cm, start, end)]
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
    return float(sum(stretch[0] for piece in pieces for stretch in piece.stretches()))


def lay_out(pieces: Sequence[Piece], closed: bool, where: str) -> CentreLine:
    """Join pieces to a centre line, from the origin along +x.

    A loop whose ends miss each other a little is bent evenly until they meet.

    Args:
        pieces: The pieces in the direction of travel.
        closed: Whether the end joins the start.
        where: Named in the error.

    Raises:
        ConfigError: If a loop does not close, with the gap in cm and degrees.
    """
    stretches = [stretch for piece in pieces for stretch in piece.stretches()]
    if not closed:
        return sample_stretches(stretches, closed=False)
    heading, end = _ends(stretches)
    laps = 1.0 if heading > 0.0 else -1.0
    turn_deg = float(np.rad2deg(heading - laps * 2.0 * np.pi))
    gap_cm = float(abs(end))
    if gap_cm > _GAP_CM or abs(turn_deg) > _GAP_DEG:
        raise ConfigError(
            f"{where}: pieces: a closed road whose end misses its start by {gap_cm:.1f} cm "
            f"({end.real:+.1f} along, {end.imag:+.1f} left) and {turn_deg:+.1f} degrees, expected at most "
            f"{_GAP_CM:g} cm and {_GAP_DEG:g} degrees; change the pieces, or set closed: false"
        )
    return sample_stretches(stretches, closed=True)


def sample_stretches(stretches: Sequence[Stretch], closed: bool) -> CentreLine:
    """Draw a road about every centimetre; what a loop misses its start by is spread over all of it."""
    knots, k0, k1, is_sample = _knots(stretches)
    bend = np.zeros(len(knots))
    heading, z = _integrate(knots, k0, k1)
    for _ in range(_SPREAD_ROUNDS if closed else 0):
        gap = np.array([2.0 * np.pi * np.sign(heading[-1]) - heading[-1], -z[-1].real, -z[-1].imag])
        if np.max(np.abs(gap)) < 1e-10:
            break
        # The least additional curvature that closes the gap is linear in position: turning by 1 at z moves
        # the end by i (end - z).
        basis = np.stack([np.ones(len(z)), z.real - z.real.mean(), z.imag - z.imag.mean()])
        weight = np.gradient(knots)
        lever = 1j * (z[-1] - z)
        effect = np.stack([np.ones(len(z)), lever.real, lever.imag])
        bend = bend + np.linalg.solve((effect * weight) @ basis.T, gap) @ basis
        heading, z = _integrate(knots, k0 + bend[:-1], k1 + bend[1:])
    # The curvature at a joint is that of the piece that begins there.
    curvature = np.append(k0, k1[-1]) + bend
    last = -1 if closed else None
    at = np.flatnonzero(is_sample)[:last]
    xy = np.stack([z.real, z.imag], axis=1)[at]
    return CentreLine(xy, heading[at], curvature[at], float(knots[-1]) / (is_sample.sum() - 1))


def _knots(
    stretches: Sequence[Stretch],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "m"], Float[np.ndarray, "m"], np.ndarray]:
    """Samples and joints, the curvature at both ends of what lies between them, and which are samples."""
    length, start, end = np.array(stretches).T
    ends = np.cumsum(length)
    samples = np.linspace(0.0, ends[-1], max(8, round(ends[-1] / _SAMPLE_CM)) + 1)
    step = samples[1]
    joints = ends[:-1]
    joints = joints[np.abs(joints / step - np.rint(joints / step)) * step > 1e-9]
    knots = np.concatenate([samples, joints])
    order = np.argsort(knots, kind="stable")
    is_sample = (np.arange(len(knots)) < len(samples))[order]
    knots = knots[order]
    middle = 0.5 * (knots[1:] + knots[:-1])
    piece = np.minimum(np.searchsorted(ends, middle), len(ends) - 1)
    slope = (end - start) / length
    along0, along1 = (side - (ends - length)[piece] for side in (knots[:-1], knots[1:]))
    return knots, start[piece] + slope[piece] * along0, start[piece] + slope[piece] * along1, is_sample


def _integrate(
    knots: Float[np.ndarray, "n"], k0: Float[np.ndarray, "m"], k1: Float[np.ndarray, "m"]
) -> tuple[Float[np.ndarray, "n"], np.ndarray]:
    """Heading and position (complex) at each knot; Simpson's rule in between."""
    h = np.diff(knots)
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (k0 + k1) * h)])
    middle = heading[:-1] + (3.0 * k0 + k1) * h / 8.0
    steps = np.exp(1j * heading[:-1]) + 4.0 * np.exp(1j * middle) + np.exp(1j * heading[1:])
    return heading, np.concatenate([[0.0], np.cumsum(steps * h / 6.0)])


def _ends(stretches: Sequence[Stretch]) -> tuple[float, complex]:
    """Heading and position at the end of a road."""
    knots, k0, k1, _ = _knots(stretches)
    heading, z = _integrate(knots, k0, k1)
    return float(heading[-1]), complex(z[-1])
