"""Shapes of random roads: smooth centre lines that keep clear of themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lanenet.errors import ConfigError

_SAMPLE_CM = 1.0
_CHECK_CM = 5.0  # spacing of the points compared for clearance
_PIECE_TRIES = 30
_RETREATS = 60
_LOOP_TRIES = 400


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


def comes_near_itself(line: CentreLine, separation_cm: float, closed: bool, after_cm: float = 0.0) -> bool:
    """Tell whether two stretches of a curve lie closer together than they should.

    Args:
        line: The curve.
        separation_cm: Least distance of points that are far apart along the curve. Far apart is more than
            pi/2 times this, so that a bend of radius 2/3 ``separation_cm`` is not taken for a near miss.
        closed: Whether the end joins the start.
        after_cm: Only points further along than this are compared with the whole curve.
    """
    stride = max(1, round(_CHECK_CM / line.step_cm))
    points = line.xy_cm[::stride]
    s = np.arange(len(line.xy_cm))[::stride] * line.step_cm
    late = s >= after_cm
    gap = np.abs(s[late][:, None] - s[None, :])
    if closed:
        gap = np.minimum(gap, len(line.xy_cm) * line.step_cm - gap)
    distance = np.linalg.norm(points[late][:, None] - points[None, :], axis=2)
    # Points of the check may straddle the nearest ones by half a stride on both curves.
    near: Bool[np.ndarray, "a b"] = distance < separation_cm + 0.25 * stride * line.step_cm
    return bool((near & (gap > 0.5 * np.pi * separation_cm)).any())


def open_centre_line(
    length_cm: float, min_radius_cm: float, separation_cm: float, rng: np.random.Generator
) -> CentreLine:
    """Draw a random open road of straights, bends and S-bends joined by clothoids.

    A piece that comes near the road so far is drawn again; when that does not help, the last pieces go too.

    Raises:
        ConfigError: If no road of this length fits.
    """
    target = int(np.ceil(length_cm / _SAMPLE_CM)) + 1
    pieces = [np.zeros(30)]
    for _ in range(_RETREATS):
        failed = 0
        while failed < _PIECE_TRIES and sum(map(len, pieces)) < target:
            so_far = np.concatenate(pieces)
            piece = _random_piece(float(so_far[-1]), min_radius_cm, rng)
            trial = integrate_curvature(np.concatenate([so_far, piece])[:target])
            if comes_near_itself(trial, separation_cm, closed=False, after_cm=len(so_far) * _SAMPLE_CM):
                failed += 1
            else:
                pieces.append(piece)
        if failed < _PIECE_TRIES:
            return integrate_curvature(np.concatenate(pieces)[:target])
        del pieces[max(1, len(pieces) - 5) :]
    raise ConfigError(
        f"track: no open road of {length_cm:.0f} cm with bends of {min_radius_cm:.0f} cm found that keeps "
        "clear of itself; choose a shorter length_cm"
    )


def _random_piece(
    curvature_before: float, min_radius_cm: float, rng: np.random.Generator
) -> Float[np.ndarray, "n"]:
    """Curvature of one more piece: a linear change to a new value, then that value for a while."""
    straight = rng.random() < 0.25
    radius_cm = min_radius_cm * 4.0 ** rng.random()
    # Turning the other way is likelier, so that roads wind rather than curl up.
    sign = -np.sign(curvature_before) if rng.random() < 0.65 else np.sign(curvature_before)
    if sign == 0.0:
        sign = 1.0 if rng.random() < 0.5 else -1.0
    hold_cm = rng.uniform(20.0, 120.0) if straight else radius_cm * rng.uniform(0.3, 1.8)
    after = 0.0 if straight else float(sign) / radius_cm
    ramp_cm = rng.uniform(30.0, 60.0) * max(0.3, abs(after - curvature_before) * min_radius_cm)
    n_ramp, n_hold = max(5, round(ramp_cm / _SAMPLE_CM)), round(hold_cm / _SAMPLE_CM)
    ramp = curvature_before + (after - curvature_before) * np.arange(1, n_ramp + 1) / n_ramp
    return np.concatenate([ramp, np.full(n_hold, after)])


def closed_centre_line(
    length_cm: float, min_radius_cm: float, separation_cm: float, rng: np.random.Generator
) -> CentreLine:
    """Draw a random closed road: a circle whose radius swings by a few harmonics.

    Raises:
        ConfigError: If no loop of this length keeps to the smallest radius and clear of itself.
    """
    direction = 1.0 if rng.random() < 0.5 else -1.0
    for attempt in range(_LOOP_TRIES):
        # Later attempts swing less, down to a circle.
        swing = 0.5 * (1.0 - attempt / (_LOOP_TRIES - 1))
        orders = np.arange(2, 6)
        amplitudes = swing * rng.random(orders.size) * 2.0 / orders
        phases = rng.uniform(0.0, 2.0 * np.pi, orders.size)
        line = _loop(length_cm, direction, orders, amplitudes, phases)
        if line is None or np.max(np.abs(line.curvature_per_cm)) > 1.0 / min_radius_cm:
            continue
        if not comes_near_itself(line, separation_cm, closed=True):
            return line
    raise ConfigError(
        f"track: no closed road of {length_cm:.0f} cm with bends of {min_radius_cm:.0f} cm found; "
        "choose a longer length_cm"
    )


def _loop(
    length_cm: float,
    direction: float,
    orders: Float[np.ndarray, "k"] | np.ndarray,
    amplitudes: Float[np.ndarray, "k"],
    phases: Float[np.ndarray, "k"],
) -> CentreLine | None:
    """The loop r = 1 + sum a_k cos(k phi + p_k), scaled to a length; None when r comes near 0."""

    def curve(phi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        angle = np.outer(phi, orders) + phases
        r = 1.0 + np.cos(angle) @ amplitudes
        dr = -np.sin(angle) @ (amplitudes * orders)
        ddr = -np.cos(angle) @ (amplitudes * orders**2)
        turn = np.exp(1j * phi)
        return r * turn, (dr + 1j * r) * turn, (ddr + 2j * dr - r) * turn

    fine = np.linspace(0.0, 2.0 * np.pi, 16384 + 1)
    z, dz, _ = curve(fine)
    if np.min(np.abs(z)) < 0.2:
        return None
    speed = np.abs(dz)
    arc = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(fine))])
    n = max(8, round(length_cm / _SAMPLE_CM))
    z, dz, ddz = curve(np.interp(np.arange(n) * arc[-1] / n, arc, fine))
    scale = length_cm / arc[-1]
    z, heading = z * scale, np.unwrap(np.angle(dz))
    curvature = np.imag(np.conj(dz) * ddz) / np.abs(dz) ** 3 / scale
    # Start at the origin along +x; a loop driven the other way round is the mirror image.
    z, heading = (z - z[0]) * np.exp(-1j * heading[0]), heading - heading[0]
    xy = np.stack([z.real, direction * z.imag], axis=1)
    return CentreLine(xy, direction * heading, direction * curvature, length_cm / n)
