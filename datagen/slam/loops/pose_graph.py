"""Pose graph: all poses by sparse least squares, from odometry between neighbours and loop closures.

Also here: which pairs of frames show the same place once loops are closed, for the adjustment of all frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from datagen.slam.loops.revisits import Revisit, RevisitSettings, facing
from lanenet.geometry.frames import wrap_angle
from lanenet.geometry.poses import compose, path_lengths, relative_pose

#: Gauss-Newton steps at most, and the step, in camera heights and rad, at which they end. Chosen: four or
#: five are usual.
_ITERATIONS, _CONVERGED = 12, 1e-4
#: Weight that holds the first heading; far above all others.
_HOLD = 1e3
#: Sigmas of a turn between neighbours and of a revisit's heading when the headings are solved alone, [rad].
#: Chosen: only their ratio counts.
_TURN_RAD, _REVISIT_RAD = 0.01, 0.05
#: Sigmas of the odometry: along the road, a share of the step plus camera heights; across, as a share of
#: that; heading, [rad]. Odometry is good to a few per cent of the step, and better across than along.
_STEP_SHARE, _STEP_HEIGHTS, _ACROSS_SHARE, _STEP_RAD = 0.1, 0.01, 0.3, 0.015
#: Sigmas of a revisit along and across the road, camera heights, and in heading, [rad]: about twice the
#: residuals that closed loops left on ``donkey_circuit`` (0.08, 0.03, 0.012).
_ALONG_HEIGHTS, _SIDEWAYS_HEIGHTS, _HEADING_RAD = 0.15, 0.05, 0.02
#: Scale of the Cauchy loss on revisits, in sigmas: the usual three.
_CAUCHY = 3.0
#: What an inlier may miss in a closed map, in camera heights and heading: on a dashed line the next dash is
#: not much further.
_INLIER_HEIGHTS, _INLIER_RAD = 1.0, 0.2
#: Frames around a revisit that are paired, too: every fourth of twelve to either side.
_AROUND_REVISIT = range(-12, 13, 4)
#: Every so many frames one is paired with the nearest ones of so many earlier laps, if they are no further
#: away than this, in camera heights and in heading. With one lap only, laps lay a pixel apart from the rest.
_LAP_EVERY, _LAPS, _LAP_HEIGHTS, _LAP_RAD = 3, 3, 1.5, 0.3
#: Path before the last nearby frame of a lap on which the nearest one is looked for, in camera heights.
_PASSING_HEIGHTS = 10.0


@dataclass(frozen=True)
class _Constraints:
    """Measured relative poses between pairs of poses; odometry first, then revisits.

    Attributes:
        start: Pose from which each is measured.
        end: Pose that is measured.
        measured: Relative poses.
        weight: Inverse sigmas.
    """

    start: Int[np.ndarray, "m"]
    end: Int[np.ndarray, "m"]
    measured: Float[np.ndarray, "m 3"]
    weight: Float[np.ndarray, "m 3"]


def close_loops(
    poses: Float[np.ndarray, "n 3"],
    revisits: list[Revisit],
    camera_height_cm: float,
    periods: Float[np.ndarray, "n"] | None = None,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "r 3"]]:
    """Bend a trajectory so that revisits meet.

    The headings are solved first, alone: that is linear, and a path whose heading is off by a turn is too far
    from the solution of the full problem. The path is then integrated with them, and all poses are solved
    together, first with plain, then with robust loop closures.

    Args:
        poses: Open-loop trajectory, heading unwrapped.
        revisits: Verified revisits.
        camera_height_cm: Sets the scale of the tolerances.
        periods: Time from the frame before to each frame, in typical time steps; None for a drive without
            gaps.

    Returns:
        The closed trajectory, and each revisit's residual (ahead, left, heading) in it.
    """
    if not revisits:
        return poses, np.empty((0, 3))
    odometry = relative_pose(poses[:-1], poses[1:])
    # The longer a step took, the less is known of it.
    trust = np.ones(len(odometry)) if periods is None else 1.0 / periods[1:]
    constraints = _constraints(odometry, trust, revisits, camera_height_cm)
    closed = _integrate(poses[0], odometry, _solve_headings(poses[:, 2], revisits, trust))
    for robust in (False, True):
        for _ in range(_ITERATIONS):
            closed, step = _gauss_newton(closed, constraints, robust)
            if step < _CONVERGED * camera_height_cm:
                break
    return closed, revisit_residuals(closed, revisits)


def revisit_residuals(poses: Float[np.ndarray, "n 3"], revisits: list[Revisit]) -> Float[np.ndarray, "r 3"]:
    """What each revisit misses with these poses: ahead and to the left, [cm], and in heading, [rad]."""
    earlier, later, relative = _arrays(revisits)
    residual = relative_pose(poses[earlier], poses[later]) - relative
    residual[:, 2] = wrap_angle(residual[:, 2])
    return residual


def inlier_revisits(
    poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], camera_height_cm: float
) -> list[Revisit]:
    """Return the revisits that an adjusted map confirms; one that the adjustment overruled is a false match.

    Args:
        poses: Poses after closing loops and adjusting all frames.
        revisits: What the loops were closed with.
        camera_height_cm: Sets the scale.
    """
    missed = revisit_residuals(poses, revisits)
    near = np.hypot(missed[:, 0], missed[:, 1]) < _INLIER_HEIGHTS * camera_height_cm
    inlier = near & (np.abs(missed[:, 2]) < _INLIER_RAD)
    return [revisit for revisit, kept in zip(revisits, inlier, strict=True) if kept]


def loop_pairs(revisits: list[Revisit], part: Int[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """Pairs of frames around each revisit that show the same place, not across a long gap of the drive.

    Args:
        revisits: The revisits.
        part: Part of the drive that each frame belongs to.
    """
    count = len(part)
    # Of two cars that face each other, one comes where the other came from.
    pairs = [
        (r, r.earlier + d, r.later - d if r.faces else r.later + d) for r in revisits for d in _AROUND_REVISIT
    ]
    return [
        (a, b)
        for r, a, b in pairs
        if min(a, b) >= 0 and max(a, b) < count and part[a] == part[r.earlier] and part[b] == part[r.later]
    ]


def neighbouring_laps(
    poses: Float[np.ndarray, "n 3"], camera_height_cm: float, settings: RevisitSettings
) -> list[tuple[int, int]]:
    """Pairs of frames of different laps that a closed map has at about the same place and heading.

    Revisits are too few to hold the laps together everywhere: between them every lap would have lines of its
    own.

    Args:
        poses: Rear-axle poses after closing loops.
        camera_height_cm: Sets the scale.
        settings: What counts as another visit.
    """
    path = path_lengths(poses)
    pairs = []
    for later in range(0, len(poses), _LAP_EVERY):
        apart = np.hypot(*(poses[:later, :2] - poses[later, :2]).T)
        turned = np.abs(wrap_angle(poses[:later, 2] - poses[later, 2]))
        near = np.flatnonzero((turned < _LAP_RAD) & (apart < _LAP_HEIGHTS * camera_height_cm))
        visit = later
        for _ in range(_LAPS):
            near = near[path[near] <= path[visit] - settings.min_gap_heights * camera_height_cm]
            if not near.size:
                break
            passing = near[path[near] > path[near[-1]] - _PASSING_HEIGHTS * camera_height_cm]
            visit = int(passing[np.argmin(apart[passing])])
            pairs.append((visit, later))
        place = facing(poses[later], camera_height_cm)
        apart = relative_pose(np.broadcast_to(place, (later, 3)), poses[:later])
        near = np.hypot(apart[:, 0], apart[:, 1]) < _LAP_HEIGHTS * camera_height_cm
        near &= path[:later] <= path[later] - settings.min_gap_heights * camera_height_cm
        opposite = np.flatnonzero(near & (np.abs(apart[:, 2]) < _LAP_RAD))
        pairs += [(int(opposite[np.hypot(*apart[opposite, :2].T).argmin()]), later)] if opposite.size else []
    return pairs


def _arrays(
    revisits: list[Revisit],
) -> tuple[Int[np.ndarray, "r"], Int[np.ndarray, "r"], Float[np.ndarray, "r 3"]]:
    """Earlier frames, later frames and relative poses."""
    earlier, later = (
        np.array([getattr(r, name) for r in revisits], np.intp) for name in ("earlier", "later")
    )
    return earlier, later, np.array([r.relative for r in revisits]).reshape(-1, 3)


def _constraints(
    odometry: Float[np.ndarray, "k 3"],
    trust: Float[np.ndarray, "k"],
    revisits: list[Revisit],
    height_cm: float,
) -> _Constraints:
    earlier, later, relative = _arrays(revisits)
    frames = np.arange(len(odometry))
    along = _STEP_SHARE * np.abs(odometry[:, 0]) + _STEP_HEIGHTS * height_cm
    odometry_sigma = np.stack([along, _ACROSS_SHARE * along, np.full(len(odometry), _STEP_RAD)], axis=1)
    revisit_sigma = [_ALONG_HEIGHTS * height_cm, _SIDEWAYS_HEIGHTS * height_cm, _HEADING_RAD]
    return _Constraints(
        np.concatenate([frames, earlier]),
        np.concatenate([frames + 1, later]),
        np.concatenate([odometry, relative]),
        np.concatenate([trust[:, None] / odometry_sigma, 1.0 / np.tile(revisit_sigma, (len(revisits), 1))]),
    )


def _solve_headings(
    heading: Float[np.ndarray, "n"], revisits: list[Revisit], trust: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "n"]:
    """Headings that keep the turns between neighbours and meet the revisits with their whole turns."""
    n = len(heading)
    earlier, later, relative = _arrays(revisits)
    turns = relative[:, 2] + 2.0 * np.pi * np.array([r.turns for r in revisits])
    step_weight = trust / _TURN_RAD
    weight = np.concatenate([step_weight, np.full(len(revisits), 1.0 / _REVISIT_RAD)])
    target = np.concatenate([[_HOLD * heading[0]], np.diff(heading) * step_weight, turns / _REVISIT_RAD])
    row = 1 + np.arange(len(weight))
    rows = np.concatenate([[0], row, row])
    columns = np.concatenate([[0], np.arange(n - 1), earlier, np.arange(1, n), later])
    a = coo_matrix(
        (np.concatenate([[_HOLD], -weight, weight]), (rows, columns)), shape=(len(target), n)
    ).tocsc()
    return np.asarray(spsolve((a.T @ a).tocsc(), a.T @ target))


def _integrate(
    start: Float[np.ndarray, "3"], odometry: Float[np.ndarray, "m 3"], heading: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Path from a start with these headings and the odometry's distances."""
    turned = np.column_stack([np.zeros((len(odometry), 2)), heading[:-1]])
    steps = compose(turned, odometry)[:, :2]
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.concatenate([xy, heading[:, None]], axis=1)


def _gauss_newton(
    poses: Float[np.ndarray, "n 3"], constraints: _Constraints, robust: bool
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """One step on all constraints; returns the poses and the largest change.

    A sparse solver of SciPy for general problems (``least_squares``, trust region with LSMR) gave the same
    poses to 0.001 cm in 25 to 37 times the time (300 and 1000 frames).
    """
    n, i, j = len(poses), constraints.start, constraints.end
    residual = relative_pose(poses[i], poses[j]) - constraints.measured
    residual[:, 2] = wrap_angle(residual[:, 2])
    weight = constraints.weight.copy()
    if robust:
        # Cauchy weights on whole revisits: a wrong one is wrong in all three numbers.
        scaled = np.sum((residual * weight)[n - 1 :] ** 2, axis=1)
        weight[n - 1 :] /= np.sqrt(1.0 + scaled[:, None] / _CAUCHY**2)
    c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
    dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
    zero, one = np.zeros_like(c), np.ones_like(c)
    by_start = np.array([[-c, -s, -s * dx + c * dy], [s, -c, -c * dx - s * dy], [zero, zero, -one]])
    by_end = np.array([[c, s, zero], [-s, c, zero], [zero, zero, one]])
    m = len(i)
    jacobian = np.concatenate([by_start, by_end], axis=1) * weight.T[:, None, :]
    rows = np.broadcast_to(3 * np.arange(m) + np.arange(3)[:, None, None], jacobian.shape)
    columns = np.concatenate([3 * k + np.arange(3)[:, None] for k in (i, j)])
    columns = np.broadcast_to(columns, jacobian.shape)
    a = coo_matrix((jacobian.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * m, 3 * n)).tocsc()
    # The first pose stays where it is.
    free = a[:, 3:]
    descent = -(free.T @ (residual * weight).ravel())
    delta = np.asarray(spsolve((free.T @ free).tocsc(), descent)).reshape(-1, 3)
    moved = poses.copy()
    moved[1:] += delta
    return moved, float(np.abs(delta).max())
