"""Centre lines of roads: curves of piecewise linear curvature, and whether they keep clear of themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit

#: Distance between samples; a bend of 60 cm leaves its chords by 0.002 cm.
SAMPLE_CM = 1.0
#: Spacing of the points that are compared for clearance; what that may miss is added, see ``check_slack_cm``.
_CHECK_CM = 5.0
#: Newton steps that close a loop; two or three suffice.
_CLOSING_STEPS = 8

#: Length, [cm], and curvature at its start and end, [1/cm], positive left; linear in between.
Section = tuple[float, float, float]


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
        heading, z = _integrate(k0 + bend[:-1], k1 + bend[1:], np.diff(knots))
    # The curvature at a joint is that of the piece that begins there.
    curvature = np.append(k0, k1[-1]) + bend
    last = -1 if closed else None
    at = np.flatnonzero(is_sample)[:last]
    xy = np.stack([z.real, z.imag], axis=1)[at]
    return CentreLine(xy, heading[at], curvature[at], float(knots[-1]) / (is_sample.sum() - 1))


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
    along0, along1 = (side - (ends - length)[section] for side in (knots[:-1], knots[1:]))
    return (
        knots,
        start[section] + slope[section] * along0,
        start[section] + slope[section] * along1,
        is_sample,
    )


def end_of(sections: Sequence[Section]) -> tuple[float, complex]:
    """Return heading and position (x + iy) at the end of a road that starts at the origin along +x."""
    knots, k0, k1, _ = _knots(sections)
    heading, z = _integrate(k0, k1, np.diff(knots))
    return float(heading[-1]), complex(z[-1])


def check_slack_cm(line: CentreLine) -> float:
    """Return how much nearer two sections may be than the points at which they are compared.

    These points may straddle the nearest ones by half a stride on both curves.
    """
    return 0.25 * _check_stride(line) * line.step_cm


def _check_stride(line: CentreLine) -> int:
    return max(1, round(_CHECK_CM / line.step_cm))


def comes_near_itself(
    line: CentreLine, separation_cm: float, closed: bool, after_cm: float = 0.0, middle_cm: float = 0.0
) -> tuple[float, float, float] | None:
    """Find two sections of a road that lie closer together than they should.

    Args:
        line: The centre line.
        separation_cm: Least distance of points that are far apart along the road. Far apart is more than
            pi/2 times this, so that a bend of radius 2/3 ``separation_cm`` is not taken for a near miss.
        closed: Whether the end joins the start.
        after_cm: Only points further along than this are compared with the whole curve.
        middle_cm: Offset of the road's middle, whose distance counts.

    Returns:
        The two places along the road and their distance, [cm]; None where it keeps clear.
    """
    stride = _check_stride(line)
    heading = line.heading_rad[::stride]
    points = line.xy_cm[::stride] + middle_cm * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    s_cm = np.arange(len(line.xy_cm))[::stride] * line.step_cm
    separation_cm += check_slack_cm(line)
    lap_cm = len(line.xy_cm) * line.step_cm if closed else np.inf
    i, j = _first_pair(points, s_cm, separation_cm, 0.5 * np.pi * separation_cm, lap_cm, after_cm)
    if i < 0:
        return None
    i, j = max(i, j), min(i, j)
    return float(s_cm[j]), float(s_cm[i]), float(np.linalg.norm(points[i] - points[j]))


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
