"""Centre lines of roads: curves of piecewise linear curvature, and kinks, that keep clear of themselves.

They are sampled from sections, or drawn at random: straights, bends with clothoids and S-bends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from lanenet.errors import ConfigError

#: Distance between samples; a bend of 60 cm leaves its chords by 0.002 cm.
SAMPLE_CM = 1.0
#: Spacing of the points that are compared for clearance; what that may miss is added.
_CHECK_CM = 5.0
#: Newton steps that close a loop; two or three suffice.
_CLOSING_STEPS = 8

#: Least angle at which a road may cross itself; chosen: each section's lines still lead straight on.
_CROSSING_RAD = math.radians(45.0)

#: Length, [cm], and curvature at its start and end, [1/cm], positive left; linear in between.
Section = tuple[float, float, float]
#: Open roads: draws of one piece before pieces are taken back, how often that happens, and how many go first;
#: chosen so that roads of 200 m are found at every seed that was tried.
_PIECE_TRIES = 30
_RETREATS = 60
_RETREAT_PIECES = 5

# A corner: its turn, its radius in smallest radii, the ramps into and out of it, and the straight behind it.
# Chosen: tape laid round a garage by hand.
_CORNER_RAD = (math.radians(80.0), math.radians(100.0))
_CORNER_RADII = (1.0, 1.25)
_CORNER_RAMP_CM = (8.0, 20.0)
_CORNER_STRAIGHT_CM = (20.0, 150.0)

#: Closed roads: attempts, simpler from one to the next, before the oval.
_TRIES = 400
_SHORTEST_STRAIGHT_CM = 2.0
#: Length of a clothoid at either end of a bend; chosen: what a car at 60 cm/s takes to turn its wheels.
_RAMP_CM = (20.0, 60.0)

#: Length of a section that stands for a kink, and the curvature beyond which a section is one. Chosen: far
#: below and above what any bend has; a kink of a degree has the curvature 17.
_KINK_CM, _KINK_PER_CM = 1e-3, 5.0

#: Smallest radius of left and of right bends, [cm].
Radii = tuple[float, float]


@dataclass(frozen=True)
class CentreLine:
    """A curve sampled evenly along its length; a closed one does not repeat its first sample.

    A kink lies in the middle between two samples, whose headings differ by its angle.

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


def integrate_curvature(curvature_per_cm: Float[np.ndarray, "n"], step_cm: float = SAMPLE_CM) -> CentreLine:
    """Return the curve with the given curvature, linear between samples, from the origin along +x."""
    heading, z = _integrate(curvature_per_cm[:-1], curvature_per_cm[1:], step_cm)
    return CentreLine(np.stack([z.real, z.imag], axis=1), heading, curvature_per_cm, step_cm)


def _integrate(
    k0: Float[np.ndarray, "m"], k1: Float[np.ndarray, "m"], step_cm: float | Float[np.ndarray, "m"]
) -> tuple[Float[np.ndarray, "n"], np.ndarray]:
    """Heading, exact, and position (x + iy, Simpson's rule) at both ends of each step.

    Args:
        k0: Curvature where each step begins.
        k1: Curvature where it ends.
        step_cm: Length of the steps.
    """
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (k0 + k1) * step_cm)])
    middle = heading[:-1] + (3.0 * k0 + k1) * step_cm / 8.0
    steps = np.exp(1j * heading[:-1]) + 4.0 * np.exp(1j * middle) + np.exp(1j * heading[1:])
    return heading, np.concatenate([[0.0], np.cumsum(steps * step_cm / 6.0)])


def sample_sections(sections: Sequence[Section], closed: bool) -> CentreLine:
    """Sample a road about every centimetre; the gap at the end of a loop is spread over all of it."""
    knots, k0, k1, is_sample = _knots(sections)
    bend = np.zeros(len(knots))
    heading, z = _integrate(k0, k1, np.diff(knots))
    for _ in range(_CLOSING_STEPS if closed else 0):
        # A figure of eight does not turn at all in sum.
        turned = 2.0 * np.pi * np.rint(heading[-1] / (2.0 * np.pi))
        gap = np.array([turned - heading[-1], -z[-1].real, -z[-1].imag])
        if np.max(np.abs(gap)) < 1e-10:
            break
        # The least additional curvature that closes the gap is linear in position: turning by 1 at z moves
        # the end by i (end - z).
        basis = np.stack([np.ones(len(z)), z.real - z.real.mean(), z.imag - z.imag.mean()])
        weight = np.gradient(knots)
        lever = 1j * (z[-1] - z)
        effect = np.stack([np.ones(len(z)), lever.real, lever.imag])
        bend = bend + np.linalg.solve((effect * weight) @ basis.T, gap) @ basis
        heading, z = _integrate(k0 + bend[:-1], k1 + bend[1:], np.diff(knots))
    # The curvature at a joint is that of the piece that begins there.
    curvature = np.append(k0, k1[-1]) + bend
    last = -1 if closed else None
    at = np.flatnonzero(is_sample)[:last]
    xy = np.stack([z.real, z.imag], axis=1)[at]
    line = CentreLine(xy, heading[at], curvature[at], float(knots[-1]) / (is_sample.sum() - 1))
    lengths, starts, _ = np.array(sections).T
    kinks = np.abs(starts) > _KINK_PER_CM
    return _with_kinks(line, (np.cumsum(lengths) - lengths)[kinks])


def _with_kinks(line: CentreLine, places_cm: Float[np.ndarray, "k"]) -> CentreLine:
    """Move the two samples beside each kink along the road, until it lies in the middle between them.

    Then the nearer of the two is the one on whose side of the kink a point lies.
    """
    xy, curvature, step_cm, n = line.xy_cm.copy(), line.curvature_per_cm.copy(), line.step_cm, len(line.xy_cm)
    for place_cm in places_cm:
        before = int(place_cm / step_cm + 1e-6)
        past_cm = place_cm - before * step_cm
        for i, along_cm in ((before, past_cm - 0.5 * step_cm), (before + 1, past_cm - 0.5 * step_cm)):
            heading = line.heading_rad[i % n]
            xy[i % n] += along_cm * np.array([np.cos(heading), np.sin(heading)])
        # The sample on the kink has its curvature.
        curvature[before] = curvature[before - 1]
    return CentreLine(xy, line.heading_rad, curvature, step_cm)


def kink_section(turn_rad: float) -> Section:
    """Return the section that stands for a kink, whose turn is positive to the left."""
    return _KINK_CM, turn_rad / _KINK_CM, turn_rad / _KINK_CM


def _knots(
    sections: Sequence[Section],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "m"], Float[np.ndarray, "m"], np.ndarray]:
    """Places of samples and joints, curvature after and before each, and which of them are samples."""
    length, start, end = np.array(sections).T
    ends = np.cumsum(length)
    samples = np.linspace(0.0, ends[-1], max(8, round(ends[-1] / SAMPLE_CM)) + 1)
    step = samples[1]
    joints = ends[:-1]
    joints = joints[np.abs(joints / step - np.rint(joints / step)) * step > 1e-9]
    knots = np.concatenate([samples, joints])
    order = np.argsort(knots, kind="stable")
    is_sample = (np.arange(len(knots)) < len(samples))[order]
    knots = knots[order]
    middle = 0.5 * (knots[1:] + knots[:-1])
    section = np.minimum(np.searchsorted(ends, middle), len(ends) - 1)
    slope = (end - start) / length
    along = (side - (ends - length)[section] for side in (knots[:-1], knots[1:]))
    k0, k1 = (start[section] + slope[section] * s_cm for s_cm in along)
    return knots, k0, k1, is_sample


def end_of(sections: Sequence[Section]) -> tuple[float, complex]:
    """Return heading and position (x + iy) at the end of a road that starts at the origin along +x."""
    knots, k0, k1, _ = _knots(sections)
    heading, z = _integrate(k0, k1, np.diff(knots))
    return float(heading[-1]), complex(z[-1])


def comes_near_itself(
    line: CentreLine,
    separation_cm: float,
    closed: bool,
    after_cm: float = 0.0,
    middle_cm: float = 0.0,
    crosses: bool = False,
) -> tuple[float, float, float, float] | None:
    """Find two sections of a road that lie closer together than they should.

    Args:
        line: The centre line.
        separation_cm: Least distance of points that are far apart along the road. Far apart is more than
            pi/2 times this, so that a bend of radius 2/3 ``separation_cm`` is not taken for a near miss.
        closed: Whether the end joins the start.
        after_cm: Only points further along than this are compared with the whole curve.
        middle_cm: Offset of the road's middle, whose distance counts.
        crosses: Whether sections may cross at 45 to 90 degrees.

    Returns:
        The two places along the road, their distance, and what it should be, [cm]: ``separation_cm`` and what
        the check may miss. None where the road keeps clear.
    """
    stride = max(1, round(_CHECK_CM / line.step_cm))
    heading = line.heading_rad[::stride]
    points = line.xy_cm[::stride] + middle_cm * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    s_cm = np.arange(len(line.xy_cm))[::stride] * line.step_cm
    # The points that are compared may straddle the nearest ones by half a stride on both curves.
    separation_cm += 0.25 * stride * line.step_cm
    lap_cm = len(line.xy_cm) * line.step_cm if closed else np.inf
    pairs = cKDTree(points).query_pairs(separation_cm, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    along_cm = np.abs(s_cm[i] - s_cm[j])
    near = (np.minimum(along_cm, lap_cm - along_cm) > 0.5 * np.pi * separation_cm) & (s_cm[i] >= after_cm)
    if crosses:
        near &= np.abs(np.sin(heading[i] - heading[j])) < math.sin(_CROSSING_RAD)
    if not near.any():
        return None
    first, other = min(zip(i[near].tolist(), j[near].tolist(), strict=True))
    apart_cm = float(np.linalg.norm(points[first] - points[other]))
    low_cm, high_cm = sorted(float(s_cm[k]) for k in (first, other))
    return low_cm, high_cm, apart_cm, separation_cm


def open_centre_line(
    length_cm: float,
    min_radius_cm: Radii,
    separation_cm: float,
    middle_cm: float,
    rng: np.random.Generator,
    corners: float = 0.0,
) -> CentreLine:
    """Draw a random open road of straights, bends and S-bends joined by clothoids.

    A piece that comes near the road so far is drawn again; if that does not help, the last pieces go too.

    Args:
        length_cm: Length of the centre line.
        min_radius_cm: Smallest radius of left and of right bends.
        separation_cm: Least distance of the middles of two sections of road.
        middle_cm: Offset of the road's middle from the centre line.
        rng: Source of randomness.
        corners: Share of the pieces that are sharp turns of nearly a right angle, each with a straight
            behind it.

    Raises:
        ConfigError: If no road of this length fits.
    """
    target = int(np.ceil(length_cm / SAMPLE_CM)) + 1
    pieces = [np.zeros(30)]
    line = integrate_curvature(pieces[0])
    furthest, depth = 0, _RETREAT_PIECES
    for _ in range(_RETREATS + target // 100):
        failed = 0
        while failed < _PIECE_TRIES and len(line.xy_cm) < target:
            # Without corners no number is drawn for them.
            draw = _corner if corners > 0.0 and rng.random() < corners else _random_piece
            piece = draw(float(line.curvature_per_cm[-1]), min_radius_cm, rng)
            trial = _continue(line, piece[: target - len(line.xy_cm)])
            after_cm = len(line.xy_cm) * SAMPLE_CM
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
    n_ramp, n_hold = max(5, round(ramp_cm / SAMPLE_CM)), round(hold_cm / SAMPLE_CM)
    return np.concatenate([_ramp(curvature_before, after, n_ramp), np.full(n_hold, after)])


def _corner(
    curvature_before: float, min_radius_cm: Radii, rng: np.random.Generator
) -> Float[np.ndarray, "n"]:
    """Curvature of a corner, as of tape that is laid in a rectangle, and of the straight behind it."""
    sign = _random_side(curvature_before, rng)
    turn_rad, radii, ramp_cm, straight_cm = (
        rng.uniform(*span) for span in (_CORNER_RAD, _CORNER_RADII, _CORNER_RAMP_CM, _CORNER_STRAIGHT_CM)
    )
    curvature = sign / (radii * (min_radius_cm[0] if sign > 0.0 else min_radius_cm[1]))
    n_out = round(ramp_cm / SAMPLE_CM)
    # The ramp into the corner is longer after a bend in the other direction.
    n_in = max(5, round(n_out * abs(1.0 - curvature_before / curvature)))
    ramps = [_ramp(curvature_before, curvature, n_in), _ramp(curvature, 0.0, n_out)]
    turned_rad = 0.5 * SAMPLE_CM * (n_in * (curvature_before + curvature) + n_out * curvature)
    hold_cm = max(0.0, (turn_rad - sign * turned_rad) / abs(curvature))
    held = np.full(round(hold_cm / SAMPLE_CM), curvature)
    return np.concatenate([ramps[0], held, ramps[1], np.zeros(round(straight_cm / SAMPLE_CM))])


def _random_side(curvature_before: float, rng: np.random.Generator) -> float:
    """Draw where the next bend turns: 1 left, -1 right."""
    # Turning the other way is likelier, so that roads wind rather than curl up.
    sign = -np.sign(curvature_before) if rng.random() < 0.65 else np.sign(curvature_before)
    if sign == 0.0:
        sign = 1.0 if rng.random() < 0.5 else -1.0
    return float(sign)


def _ramp(before: float, after: float, n: int) -> Float[np.ndarray, "n"]:
    """Curvature that changes evenly from one value to another, which it ends on."""
    return before + (after - before) * np.arange(1, n + 1) / n


def closed_centre_line(
    length_cm: float, min_radius_cm: Radii, separation_cm: float, middle_cm: float, rng: np.random.Generator
) -> CentreLine:
    """Draw a random closed road.

    Bends are drawn; the straights between them get the lengths that close the loop at the wanted length.
    Later attempts are simpler, down to two half circles and two straights.

    Args:
        length_cm: Length of the centre line.
        min_radius_cm: Smallest radius of left and of right bends.
        separation_cm: Least distance of the middles of two sections of road.
        middle_cm: Offset of the road's middle from the centre line.
        rng: Source of randomness.

    Raises:
        ConfigError: If no loop of this length keeps to the smallest radius and clear of itself.
    """
    direction = 1.0 if rng.random() < 0.5 else -1.0
    for attempt in range(_TRIES):
        variety = 1.0 - attempt / (_TRIES - 1)
        angles = _random_angles(length_cm / (2.0 * np.pi * max(min_radius_cm)), variety, rng)
        sections = _close(direction * angles, length_cm, min_radius_cm, variety, rng)
        if sections is None:
            continue
        line = sample_sections(sections, closed=True)
        if comes_near_itself(line, separation_cm, True, middle_cm=middle_cm) is None:
            return line
    sections = _oval(direction, length_cm, min_radius_cm, separation_cm)
    if sections is None:
        raise ConfigError(
            f"track: no closed road of {length_cm:.0f} cm with bends of {min(min_radius_cm):.0f} cm found; "
            "choose a longer length_cm"
        )
    return sample_sections(sections, closed=True)


def _random_angles(size: float, variety: float, rng: np.random.Generator) -> Float[np.ndarray, "k"]:
    """Angles of the bends of a loop, positive left; they sum to a full turn.

    Args:
        size: Length of the road in circles of the smallest radius.
        variety: 1: as winding as the length allows; 0: convex.
        rng: Source of randomness.
    """
    corners = int(rng.integers(2, 6))
    angles = list(2.0 * np.pi * _shares(corners, 0.6, rng))
    room = min(variety * 1.2 * max(size - 1.2, 0.0), 25.0)
    for _ in range(rng.poisson(room) if room > 0.0 else 0):
        i = int(rng.integers(len(angles) + 1))
        swing = float(rng.uniform(0.3, 1.3))
        if rng.random() < 0.6:  # an S-bend
            side = 1.0 if rng.random() < 0.5 else -1.0
            angles[i:i] = [side * swing, -side * swing]
        else:  # a dent: out, back by twice as much, and out again
            side = 1.0 if rng.random() < 0.3 else -1.0
            angles[i:i] = [-0.5 * side * swing, side * swing, -0.5 * side * swing]
    return np.asarray(angles)


def _shares(n: int, evenness: float, rng: np.random.Generator) -> Float[np.ndarray, "n"]:
    """Random shares of 1; the higher ``evenness`` the more alike."""
    share = evenness + rng.exponential(1.0, n)
    return share / share.sum()


def _close(
    angles: Float[np.ndarray, "k"],
    length_cm: float,
    min_radius_cm: Radii,
    variety: float,
    rng: np.random.Generator,
) -> list[Section] | None:
    """Give bends radii and straights; None where these bends cannot be closed at this length."""
    n = len(angles)
    smallest = np.where(angles > 0.0, min_radius_cm[0], min_radius_cm[1])
    bends_cm = float(np.sum(np.abs(angles) * smallest))
    if bends_cm > 0.97 * length_cm:
        return None
    # Bends may take up most of the length, but not all of it.
    widest = max(1.0, min(3.5, 0.85 * length_cm / bends_cm))
    radius = smallest * widest ** rng.random(n)
    ramp = np.minimum(rng.uniform(*_RAMP_CM, n), 0.8 * np.abs(angles) * radius)
    bends = [_bend(a, r, c) for a, r, c in zip(angles, radius, ramp, strict=True)]
    heading = np.concatenate([[0.0], np.cumsum(angles)])
    ends = np.array([_displacement(bend) for bend in bends])
    offset = np.sum(ends * np.exp(1j * heading[:-1]))
    # Straight i follows bend i. Lengths near random ones that close the loop and sum to what is left.
    left_cm = length_cm - sum(section[0] for bend in bends for section in bend)
    if left_cm < n * _SHORTEST_STRAIGHT_CM:
        return None
    wanted = left_cm * _shares(n, 0.05 + 0.5 * (1.0 - variety), rng)
    direction = np.exp(1j * heading[1:])
    equations = np.stack([np.ones(n), direction.real, direction.imag])
    missing = np.array([left_cm, -offset.real, -offset.imag]) - equations @ wanted
    change = np.linalg.lstsq((equations * wanted) @ equations.T, missing, rcond=None)[0]
    straights = wanted + wanted * (change @ equations)
    if (
        straights.min() < _SHORTEST_STRAIGHT_CM
        or np.abs(equations @ (straights - wanted) - missing).max() > 1e-6
    ):
        return None
    start = int(np.argmax(straights))
    sections: list[Section] = []
    for k in range(n):
        i = (start + 1 + k) % n
        sections += [*bends[i], (float(straights[i]), 0.0, 0.0)]
    # Half of the longest straight goes to the front: roads start straight.
    half = 0.5 * sections[-1][0]
    return [(half, 0.0, 0.0), *sections[:-1], (half, 0.0, 0.0)]


def _bend(angle_rad: float, radius_cm: float, ramp_cm: float) -> list[Section]:
    """Clothoid, arc, clothoid that turn by an angle in all."""
    k = float(np.sign(angle_rad)) / radius_cm
    arc_cm = abs(angle_rad) * radius_cm - ramp_cm
    return [(float(ramp_cm), 0.0, k), (float(arc_cm), k, k), (float(ramp_cm), k, 0.0)]


def _displacement(sections: list[Section]) -> complex:
    """Where a bend ends, seen from its start: Simpson's rule on 32 parts of each section."""
    share = np.arange(65) / 64.0
    weight = np.full(65, 2.0)
    weight[1::2] = 4.0
    weight[[0, -1]] = 1.0
    heading, z = 0.0, 0.0 + 0.0j
    for length, start, end in sections:
        turn = length * (start * share + 0.5 * (end - start) * share**2)
        z += length / 192.0 * np.sum(weight * np.exp(1j * (heading + turn)))
        heading += turn[-1]
    return complex(z)


def _oval(
    direction: float, length_cm: float, min_radius_cm: Radii, separation_cm: float
) -> list[Section] | None:
    """Two half circles and two straights; None where the length is too short for them."""
    smallest = min_radius_cm[0] if direction > 0.0 else min_radius_cm[1]
    radius = max(smallest, 0.52 * separation_cm)
    ramp = min(30.0, 0.5 * length_cm - np.pi * radius - _SHORTEST_STRAIGHT_CM)
    if ramp <= 0.0:
        return None
    bend = _bend(direction * np.pi, radius, ramp)
    straight = 0.5 * length_cm - np.pi * radius - ramp
    half = (0.5 * straight, 0.0, 0.0)
    return [half, *bend, (straight, 0.0, 0.0), *bend, half]
