"""Shapes of random roads: smooth centre lines that keep clear of themselves.

Whether a road keeps clear of itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

from lanenet.errors import ConfigError


def nearest_approach(
    xy_cm: Float[np.ndarray, "n 2"],
    s_cm: Float[np.ndarray, "n"],
    separation_cm: float,
    lap_cm: float | None,
    after_cm: float = 0.0,
) -> tuple[float, float, float] | None:
    """Find a place where two stretches of a curve lie closer together than they should.

    Args:
        xy_cm: Points along the curve.
        s_cm: Their distance along it, evenly spaced.
        separation_cm: Least distance of points that are far apart along the curve. Far apart is more than
            pi/2 times this, so that a bend of radius 2/3 ``separation_cm`` is not taken for a near miss.
        lap_cm: Length of a closed curve; None for an open one.
        after_cm: Only points further along than this are compared with the whole curve.

    Returns:
        The two places along the curve and their distance, [cm]; None where it keeps clear.
    """
    gap_cm = 0.5 * np.pi * separation_cm
    lap = np.inf if lap_cm is None else lap_cm
    i, j = _first_pair(xy_cm, s_cm, separation_cm, gap_cm, lap, after_cm)
    if i < 0:
        return None
    i, j = max(i, j), min(i, j)
    return float(s_cm[j]), float(s_cm[i]), float(np.linalg.norm(xy_cm[i] - xy_cm[j]))


@njit(cache=True, error_model="numpy")
@no_type_check
def _first_pair(xy, s, separation, gap, lap, after):
    """Indices of the first two points that are too close, -1 if there are none."""
    n = xy.shape[0]
    step = s[1] - s[0]
    for i in range(n):
        if s[i] < after:
            continue
        j = 0
        while j < n:
            d = np.hypot(xy[i, 0] - xy[j, 0], xy[i, 1] - xy[j, 1])
            if d >= separation:
                # A curve leads no nearer than its length: what comes before this is no closer either. Twice
                # the step covers a line beside the centre line, which is longer than it in bends.
                j += max(1, int((d - separation) / (2.0 * step)))
                continue
            along = abs(s[i] - s[j])
            if min(along, lap - along) > gap:
                return i, j
            j += 1
    return -1, -1


_SAMPLE_CM = 1.0
_CHECK_CM = 5.0  # spacing of the points compared for clearance
_PIECE_TRIES = 30
_RETREATS = 60
_RETREAT_PIECES = 5

# A corner: its turn, its radius in smallest radii, the ways into and out of it, and the straight behind it.
_CORNER_RAD = (math.radians(80.0), math.radians(100.0))
_CORNER_RADII = (1.0, 1.25)
_CORNER_RAMP_CM = (8.0, 20.0)
_CORNER_STRAIGHT_CM = (20.0, 150.0)

#: Smallest radius of left and of right bends, [cm].
Radii = tuple[float, float]


@dataclass(frozen=True)
class CentreLine:
    """A curve sampled evenly along its length; a closed one does not repeat its first sample.

    Attributes:
        xy_cm: Positions, [cm], frame map.
        heading_rad: Direction of travel, unwrapped, [rad].
        curvature_per_cm: Positive to the left, [1/cm].
        step_cm: Distance along the curve between samples, [cm].
    """

    xy_cm: Float[np.ndarray, "n 2"]
    heading_rad: Float[np.ndarray, "n"]
    curvature_per_cm: Float[np.ndarray, "n"]
    step_cm: float


def integrate_curvature(curvature_per_cm: Float[np.ndarray, "n"], step_cm: float = _SAMPLE_CM) -> CentreLine:
    """Draw the curve with the given curvature, linear between samples, from the origin along +x.

    Headings are exact; positions follow by Simpson's rule over each step.
    """
    k0, k1 = curvature_per_cm[:-1], curvature_per_cm[1:]
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (k0 + k1) * step_cm)])
    middle = heading[:-1] + (3.0 * k0 + k1) * step_cm / 8.0
    # Complex numbers carry x and y together.
    steps = np.exp(1j * heading[:-1]) + 4.0 * np.exp(1j * middle) + np.exp(1j * heading[1:])
    z = np.concatenate([[0.0], np.cumsum(steps * step_cm / 6.0)])
    return CentreLine(np.stack([z.real, z.imag], axis=1), heading, curvature_per_cm, step_cm)


def check_slack_cm(line: CentreLine) -> float:
    """How much nearer two stretches may be than the points at which they are compared.

    Points of the check may straddle the nearest ones by half a stride on both curves.
    """
    return 0.25 * _check_stride(line) * line.step_cm


def _check_stride(line: CentreLine) -> int:
    return max(1, round(_CHECK_CM / line.step_cm))


def comes_near_itself(
    line: CentreLine, separation_cm: float, closed: bool, after_cm: float = 0.0, middle_cm: float = 0.0
) -> tuple[float, float, float] | None:
    """Find two stretches of a road that lie closer together than they should.

    Args:
        line: The centre line.
        separation_cm: See :func:`~datagen.world.road.centre_line.nearest_approach`.
        closed: Whether the end joins the start.
        after_cm: Only points further along than this are compared with the whole curve.
        middle_cm: Offset of the road's middle, of which the distance is taken.

    Returns:
        The two places along the road and their distance, [cm]; None where it keeps clear.
    """
    stride = _check_stride(line)
    heading = line.heading_rad[::stride]
    points = line.xy_cm[::stride] + middle_cm * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    s_cm = np.arange(len(line.xy_cm))[::stride] * line.step_cm
    separation_cm += check_slack_cm(line)
    lap_cm = len(line.xy_cm) * line.step_cm if closed else None
    return nearest_approach(points, s_cm, separation_cm, lap_cm, after_cm)


def open_centre_line(
    length_cm: float,
    min_radius_cm: Radii,
    separation_cm: float,
    middle_cm: float,
    rng: np.random.Generator,
    corners: float = 0.0,
) -> CentreLine:
    """Draw a random open road of straights, bends and S-bends joined by clothoids.

    A piece that comes near the road so far is drawn again; when that does not help, the last pieces go too.

    Args:
        length_cm: Length of the centre line.
        min_radius_cm: Smallest radius of left and of right bends.
        separation_cm: Least distance of the middles of two stretches of road.
        middle_cm: Offset of the road's middle from the centre line.
        rng: Source of randomness.
        corners: Share of the pieces that are sharp turns of nearly a right angle, each with a straight
            behind it.

    Raises:
        ConfigError: If no road of this length fits.
    """
    target = int(np.ceil(length_cm / _SAMPLE_CM)) + 1
    pieces = [np.zeros(30)]
    line = integrate_curvature(pieces[0])
    furthest, depth = 0, _RETREAT_PIECES
    for _ in range(_RETREATS + target // 100):
        failed = 0
        while failed < _PIECE_TRIES and len(line.xy_cm) < target:
            # Without corners nothing more is drawn: the roads stay those that they were.
            draw = _corner if corners > 0.0 and rng.random() < corners else _random_piece
            piece = draw(float(line.curvature_per_cm[-1]), min_radius_cm, rng)
            trial = _continue(line, piece[: target - len(line.xy_cm)])
            after_cm = len(line.xy_cm) * _SAMPLE_CM
            if comes_near_itself(trial, separation_cm, False, after_cm, middle_cm) is not None:
                failed += 1
            else:
                pieces.append(piece)
                line = trial
        if failed < _PIECE_TRIES:
            return integrate_curvature(np.concatenate(pieces)[:target])
        # Back further and further where the road has run into a trap.
        depth = _RETREAT_PIECES if len(pieces) > furthest else 2 * depth
        furthest = max(furthest, len(pieces))
        del pieces[max(1, len(pieces) - depth) :]
        line = integrate_curvature(np.concatenate(pieces))
    raise ConfigError(
        f"track: no open road of {length_cm:.0f} cm with bends of {min(min_radius_cm):.0f} cm found that "
        "keeps clear of itself; choose a shorter length_cm"
    )


def _continue(line: CentreLine, curvature_per_cm: Float[np.ndarray, "n"]) -> CentreLine:
    """Append samples to a curve, without integrating all of it again."""
    more = integrate_curvature(np.concatenate([line.curvature_per_cm[-1:], curvature_per_cm]))
    c, s = np.cos(line.heading_rad[-1]), np.sin(line.heading_rad[-1])
    xy = line.xy_cm[-1] + more.xy_cm[1:] @ np.array([[c, s], [-s, c]])
    return CentreLine(
        np.concatenate([line.xy_cm, xy]),
        np.concatenate([line.heading_rad, line.heading_rad[-1] + more.heading_rad[1:]]),
        np.concatenate([line.curvature_per_cm, curvature_per_cm]),
        line.step_cm,
    )


def _random_piece(
    curvature_before: float, min_radius_cm: Radii, rng: np.random.Generator
) -> Float[np.ndarray, "n"]:
    """Curvature of one more piece: a linear change to a new value, then that value for a while."""
    straight = rng.random() < 0.25
    share = rng.random()
    sign = _random_side(curvature_before, rng)
    smallest_cm = min_radius_cm[0] if sign > 0.0 else min_radius_cm[1]
    radius_cm = smallest_cm * 4.0**share
    hold_cm = rng.uniform(20.0, 120.0) if straight else radius_cm * rng.uniform(0.3, 1.8)
    after = 0.0 if straight else sign / radius_cm
    ramp_cm = rng.uniform(30.0, 60.0) * max(0.3, abs(after - curvature_before) * smallest_cm)
    n_ramp, n_hold = max(5, round(ramp_cm / _SAMPLE_CM)), round(hold_cm / _SAMPLE_CM)
    return np.concatenate([_ramp(curvature_before, after, n_ramp), np.full(n_hold, after)])


def _corner(
    curvature_before: float, min_radius_cm: Radii, rng: np.random.Generator
) -> Float[np.ndarray, "n"]:
    """Curvature of a corner as tape has it that is laid in a rectangle, and of the straight behind it."""
    sign = _random_side(curvature_before, rng)
    turn_rad, radii, ramp_cm, straight_cm = (
        rng.uniform(*span) for span in (_CORNER_RAD, _CORNER_RADII, _CORNER_RAMP_CM, _CORNER_STRAIGHT_CM)
    )
    curvature = sign / (radii * (min_radius_cm[0] if sign > 0.0 else min_radius_cm[1]))
    n_out = round(ramp_cm / _SAMPLE_CM)
    # Out of a bend the other way it takes as much longer.
    n_in = max(5, round(n_out * abs(1.0 - curvature_before / curvature)))
    ramps = [_ramp(curvature_before, curvature, n_in), _ramp(curvature, 0.0, n_out)]
    turned_rad = 0.5 * _SAMPLE_CM * (n_in * (curvature_before + curvature) + n_out * curvature)
    hold_cm = max(0.0, (turn_rad - sign * turned_rad) / abs(curvature))
    held = np.full(round(hold_cm / _SAMPLE_CM), curvature)
    return np.concatenate([ramps[0], held, ramps[1], np.zeros(round(straight_cm / _SAMPLE_CM))])


def _random_side(curvature_before: float, rng: np.random.Generator) -> float:
    """Draw where the next bend turns: 1 left, -1 right."""
    # Turning the other way is likelier, so that roads wind rather than curl up.
    sign = -np.sign(curvature_before) if rng.random() < 0.65 else np.sign(curvature_before)
    if sign == 0.0:
        sign = 1.0 if rng.random() < 0.5 else -1.0
    return float(sign)


def _ramp(before: float, after: float, n: int) -> Float[np.ndarray, "n"]:
    """Curvature on the way from one value to another, which it ends on."""
    return before + (after - before) * np.arange(1, n + 1) / n
