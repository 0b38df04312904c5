"""Random closed roads: straights, bends with clothoids, S-bends and dents, that end where they start."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from datagen.world.road.centre_line import CentreLine, Radii, comes_near_itself
from datagen.world.road.pieces import Stretch, sample_stretches
from lanenet.errors import ConfigError

_TRIES = 400
_SHORTEST_STRAIGHT_CM = 2.0
_RAMP_CM = (20.0, 60.0)  # length of a clothoid at either end of a bend


def closed_centre_line(
    length_cm: float, min_radius_cm: Radii, separation_cm: float, middle_cm: float, rng: np.random.Generator
) -> CentreLine:
    """Draw a random closed road.

    Bends are drawn, and the straights between them are made as long as it takes to close the loop at the
    wanted length. Later attempts are simpler, down to two half circles and two straights.

    Args:
        length_cm: Length of the centre line.
        min_radius_cm: Smallest radius of left and of right bends.
        separation_cm: Least distance of the middles of two stretches of road.
        middle_cm: Offset of the road's middle from the centre line.
        rng: Source of randomness.

    Raises:
        ConfigError: If no loop of this length keeps to the smallest radius and clear of itself.
    """
    direction = 1.0 if rng.random() < 0.5 else -1.0
    for attempt in range(_TRIES):
        variety = 1.0 - attempt / (_TRIES - 1)
        angles = _random_angles(length_cm / (2.0 * np.pi * max(min_radius_cm)), variety, rng)
        stretches = _close(direction * angles, length_cm, min_radius_cm, variety, rng)
        if stretches is None:
            continue
        line = sample_stretches(stretches, closed=True)
        if comes_near_itself(line, separation_cm, True, middle_cm=middle_cm) is None:
            return line
    stretches = _oval(direction, length_cm, min_radius_cm, separation_cm)
    if stretches is None:
        raise ConfigError(
            f"track: no closed road of {length_cm:.0f} cm with bends of {min(min_radius_cm):.0f} cm found; "
            "choose a longer length_cm"
        )
    return sample_stretches(stretches, closed=True)


def _random_angles(size: float, variety: float, rng: np.random.Generator) -> Float[np.ndarray, "k"]:
    """Angles of the bends of a loop to the left; they sum to a full turn.

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
) -> list[Stretch] | None:
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
    left_cm = length_cm - sum(stretch[0] for bend in bends for stretch in bend)
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
    stretches: list[Stretch] = []
    for k in range(n):
        i = (start + 1 + k) % n
        stretches += [*bends[i], (float(straights[i]), 0.0, 0.0)]
    # Half of the longest straight goes to the front: roads start straight.
    half = 0.5 * stretches[-1][0]
    return [(half, 0.0, 0.0), *stretches[:-1], (half, 0.0, 0.0)]


def _bend(angle_rad: float, radius_cm: float, ramp_cm: float) -> list[Stretch]:
    """Clothoid, arc, clothoid that turn by an angle in all."""
    k = float(np.sign(angle_rad)) / radius_cm
    arc_cm = abs(angle_rad) * radius_cm - ramp_cm
    return [(float(ramp_cm), 0.0, k), (float(arc_cm), k, k), (float(ramp_cm), k, 0.0)]


def _displacement(stretches: list[Stretch]) -> complex:
    """Where a bend ends, seen from its start: Simpson's rule on 32 parts of each stretch."""
    share = np.arange(65) / 64.0
    weight = np.full(65, 2.0)
    weight[1::2] = 4.0
    weight[[0, -1]] = 1.0
    heading, z = 0.0, 0.0 + 0.0j
    for length, start, end in stretches:
        turn = length * (start * share + 0.5 * (end - start) * share**2)
        z += length / 192.0 * np.sum(weight * np.exp(1j * (heading + turn)))
        heading += turn[-1]
    return complex(z)


def _oval(
    direction: float, length_cm: float, min_radius_cm: Radii, separation_cm: float
) -> list[Stretch] | None:
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
