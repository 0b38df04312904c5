"""Sparse least squares over all poses: odometry between neighbours, revisits across laps.

Pairs of frames that show the same place, for the adjustment of all frames together.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from datagen.slam.loops.places import Revisit, RevisitSettings
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import path_lengths, relative_pose

_ITERATIONS = 12
#: Weight of the motion across a break, which is known from nothing; not zero, so that all stays determined.
_ACROSS_BREAK = 1e-4
#: What a revisit may miss in a closed map, in camera heights and heading: the next dash of a dashed line is
#: not much further.
_BORNE_OUT_HEIGHTS, _BORNE_OUT_RAD = 1.0, 0.2


def close_loops(
    poses: Float[np.ndarray, "n 3"],
    revisits: list[Revisit],
    camera_height_cm: float,
    breaks: Bool[np.ndarray, "n"] | None = None,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "r 3"]]:
    """Bend a trajectory so that revisits meet.

    The headings are solved first, on their own: that is linear, and a path that is off by a turn of heading
    is too far from its solution for the full problem. The path is then integrated again with them, and all
    poses are solved together, first with plain, then with robust revisit factors.

    Args:
        poses: Open-loop trajectory, heading unwrapped.
        revisits: Verified revisits.
        camera_height_cm: Sets the scale of the tolerances.
        breaks: Frames that do not follow the one before them.

    Returns:
        The closed trajectory, and each revisit's residual (ahead, left, heading) in it.
    """
    if not revisits:
        return poses, np.empty((0, 3))
    odometry = relative_pose(poses[:-1], poses[1:])
    # How far the motion to each frame can be trusted, 1 for what the drive has seen.
    trust = np.ones(len(odometry)) if breaks is None else np.where(breaks[1:], _ACROSS_BREAK, 1.0)
    closed = _integrate(poses[0], odometry, _solve_headings(poses[:, 2], revisits, trust))
    for robust in (False, True):
        for _ in range(_ITERATIONS):
            closed, step = _gauss_newton(closed, odometry, trust, revisits, camera_height_cm, robust)
            if step < 1e-4 * camera_height_cm:
                break
    return closed, missed_by(closed, revisits)


def borne_out(
    poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], camera_height_cm: float
) -> list[Revisit]:
    """Return the revisits that an adjusted map bears out: what the pictures outvoted shows another place.

    Args:
        poses: Poses after closing loops and adjusting all frames.
        revisits: What the loops were closed with.
        camera_height_cm: Sets the scale.
    """
    missed = missed_by(poses, revisits)
    near = np.hypot(missed[:, 0], missed[:, 1]) < _BORNE_OUT_HEIGHTS * camera_height_cm
    true = near & (np.abs(missed[:, 2]) < _BORNE_OUT_RAD)
    return [revisit for revisit, kept in zip(revisits, true, strict=True) if kept]


def _solve_headings(
    heading: Float[np.ndarray, "n"], revisits: list[Revisit], trust: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "n"]:
    """Headings that keep the turns between neighbours and meet the revisits with their whole turns."""
    n = len(heading)
    turn_sigma, revisit_sigma = 0.01, 0.05
    rows, columns, values, targets = [0], [0], [1e3], [1e3 * heading[0]]
    for k in range(n - 1):
        rows += [k + 1, k + 1]
        columns += [k, k + 1]
        weight = float(trust[k]) / turn_sigma
        values += [-weight, weight]
        targets.append((heading[k + 1] - heading[k]) * weight)
    for i, revisit in enumerate(revisits):
        rows += [n + i, n + i]
        columns += [revisit.earlier, revisit.later]
        values += [-1.0 / revisit_sigma, 1.0 / revisit_sigma]
        targets.append((revisit.relative[2] + 2.0 * np.pi * revisit.turns) / revisit_sigma)
    entries = (np.array(values), (np.array(rows), np.array(columns)))
    a = coo_matrix(entries, shape=(n + len(revisits), n)).tocsc()
    return np.asarray(spsolve((a.T @ a).tocsc(), a.T @ np.array(targets)))


def _integrate(
    start: Float[np.ndarray, "3"], odometry: Float[np.ndarray, "m 3"], heading: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    steps = np.stack(
        [c * odometry[:, 0] - s * odometry[:, 1], s * odometry[:, 0] + c * odometry[:, 1]], axis=1
    )
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.concatenate([xy, heading[:, None]], axis=1)


def missed_by(poses: Float[np.ndarray, "n 3"], revisits: list[Revisit]) -> Float[np.ndarray, "r 3"]:
    """What each revisit misses with these poses: ahead and to the left, [cm], and in heading, [rad]."""
    if not revisits:
        return np.empty((0, 3))
    seen = relative_pose(poses[[r.earlier for r in revisits]], poses[[r.later for r in revisits]])
    residual = seen - np.array([r.relative for r in revisits])
    residual[:, 2] = wrap_angle(residual[:, 2])
    return residual


def _gauss_newton(
    poses: Float[np.ndarray, "n 3"],
    odometry: Float[np.ndarray, "m 3"],
    trust: Float[np.ndarray, "m"],
    revisits: list[Revisit],
    camera_height_cm: float,
    robust: bool,
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """One step on all factors; a factor is (from, to, relative pose, inverse sigmas)."""
    n = len(poses)
    i = np.concatenate([np.arange(n - 1), [r.earlier for r in revisits]]).astype(np.intp)
    j = np.concatenate([np.arange(1, n), [r.later for r in revisits]]).astype(np.intp)
    measured = np.concatenate([odometry, [r.relative for r in revisits]])
    # Odometry is good to a few per cent of the step, and better across than along.
    along = 0.1 * np.abs(odometry[:, 0]) + 0.01 * camera_height_cm
    odometry_sigma = np.stack([along, 0.3 * along, np.full(n - 1, 0.015)], axis=1)
    revisit_sigma = np.tile([0.15 * camera_height_cm, 0.05 * camera_height_cm, 0.02], (len(revisits), 1))
    weight = np.concatenate([trust[:, None] / odometry_sigma, 1.0 / revisit_sigma])
    c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
    dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
    residual = (
        np.stack([c * dx + s * dy, -s * dx + c * dy, wrap_angle(poses[j, 2] - poses[i, 2])], axis=1)
        - measured
    )
    residual[:, 2] = wrap_angle(residual[:, 2])
    if robust:
        # Cauchy weights on whole revisits: a wrong one is wrong in all three numbers.
        scaled = np.sum((residual * weight)[n - 1 :] ** 2, axis=1)
        weight[n - 1 :] /= np.sqrt(1.0 + scaled[:, None] / 9.0)
    zero, one = np.zeros_like(c), np.ones_like(c)
    jac_i = np.array([[-c, -s, -s * dx + c * dy], [s, -c, -c * dx - s * dy], [zero, zero, -one]])
    jac_j = np.array([[c, s, zero], [-s, c, zero], [zero, zero, one]])
    m = len(i)
    rows = np.broadcast_to(3 * np.arange(m) + np.arange(3)[:, None, None], (3, 3, m))
    parts = []
    for jac, index in ((jac_i, i), (jac_j, j)):
        columns = np.broadcast_to(3 * index + np.arange(3)[None, :, None], (3, 3, m))
        values = jac * weight.T[:, None, :]
        parts.append((values.ravel(), rows.ravel(), columns.ravel()))
    values, row, column = (np.concatenate(p) for p in zip(*parts, strict=True))
    a = coo_matrix((values, (row, column)), shape=(3 * m, 3 * n)).tocsc()
    # The first pose stays where it is.
    free = a[:, 3:]
    rhs = -(free.T @ (residual * weight).ravel())
    delta = np.asarray(spsolve((free.T @ free).tocsc(), rhs)).reshape(-1, 3)
    moved = poses.copy()
    moved[1:] += delta
    return moved, float(np.abs(delta).max())


#: Where around a revisit more pairs of frames show the same place, in frames.
_BESIDE_REVISIT = range(-12, 13, 4)
#: Every so many frames one is compared with the nearest ones of so many earlier laps, if they are no further
#: away, in camera heights and in heading.
_BESIDE_EVERY, _BESIDE_LAPS, _BESIDE_HEIGHTS, _BESIDE_RAD = 3, 3, 1.5, 0.3
#: Way before the last frame of a lap that is near within which the nearest one of it lies, in camera heights.
_PASSING_HEIGHTS = 10.0


def loop_pairs(
    revisits: list[Revisit], count: int, breaks: Bool[np.ndarray, "n"] | None = None
) -> list[tuple[int, int]]:
    """Pairs of frames around each revisit that show the same place, not beyond a break of the drive.

    Args:
        revisits: The revisits.
        count: Number of frames.
        breaks: Frames that do not follow the one before them; None for one stretch.
    """
    stretch = np.zeros(count, np.int64) if breaks is None else np.cumsum(breaks)
    pairs = [(r, r.earlier + d, r.later + d) for r in revisits for d in _BESIDE_REVISIT]
    return [
        (a, b)
        for r, a, b in pairs
        if a >= 0 and b < count and stretch[a] == stretch[r.earlier] and stretch[b] == stretch[r.later]
    ]


def side_by_side(
    poses: Float[np.ndarray, "n 3"], camera_height_cm: float, settings: RevisitSettings
) -> list[tuple[int, int]]:
    """Pairs of frames of different laps that a closed map has at about the same place and heading.

    Revisits are too few to hold all of one lap on the others; between them every lap would have lines of its
    own. Laps that hang on one other lap each may still lie apart from the rest.

    Args:
        poses: Rear-axle poses after closing loops.
        camera_height_cm: Sets the scale.
        settings: What counts as another visit.
    """
    path = path_lengths(poses)
    pairs = []
    for later in range(0, len(poses), _BESIDE_EVERY):
        apart = np.hypot(*(poses[:later, :2] - poses[later, :2]).T)
        turned = np.abs(wrap_angle(poses[:later, 2] - poses[later, 2]))
        near = np.flatnonzero((turned < _BESIDE_RAD) & (apart < _BESIDE_HEIGHTS * camera_height_cm))
        visit = later
        for _ in range(_BESIDE_LAPS):
            near = near[path[near] <= path[visit] - settings.min_gap_heights * camera_height_cm]
            if not near.size:
                break
            passing = near[path[near] > path[near[-1]] - _PASSING_HEIGHTS * camera_height_cm]
            visit = int(passing[np.argmin(apart[passing])])
            pairs.append((visit, later))
    return pairs
