"""What the bundle adjustment believes without looking at the pictures: level frames, a car that rolls."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csc_matrix

from datagen.slam.bundle_kernels import N_FRAME
from datagen.slam.bundle_settings import BundleSettings
from datagen.slam.bundle_state import BundleState

#: Shorter commanded ways than this, 1 where they are usual, count as this one.
_LEAST_WAY = 0.1


def frame_priors(
    state: BundleState,
    settings: BundleSettings,
    joined: Int[np.ndarray, "m"],
    expected: Float[np.ndarray, "n"],
    recorded: bool = False,
) -> tuple[float, csc_matrix, Float[np.ndarray, "u"]]:
    """Cost, normal matrix and downhill slope of the priors of all frames.

    Args:
        state: Where.
        settings: Standard deviations.
        joined: Frames that the next one follows.
        expected: Commanded way from the frame before, 1 where it is usual.
        recorded: Whether these come from a recorded speed; else they only say how ways change.
    """
    s, n = settings, len(state.poses)
    rows: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    values: list[np.ndarray] = []
    errors: list[np.ndarray] = []
    count = 0

    def add(error: np.ndarray, sigma: float, *terms: tuple[np.ndarray, np.ndarray]) -> None:
        nonlocal count
        errors.append(error / sigma)
        for column, derivative in terms:
            rows.append(count + np.arange(len(error)))
            columns.append(column)
            values.append(np.broadcast_to(derivative, error.shape) / sigma)
        count += len(error)

    frames = N_FRAME * np.arange(n)
    for offset, (value, sigma) in enumerate(
        zip(state.tilt.T, (s.frame_pitch, s.frame_roll), strict=True), start=3
    ):
        add(value, sigma, (frames + offset, np.ones(n)))
    i, j = joined, joined + 1
    c, si = np.cos(state.poses[i, 2]), np.sin(state.poses[i, 2])
    dx, dy = (state.poses[j] - state.poses[i])[:, :2].T
    turn = state.poses[j, 2] - state.poses[i, 2]
    ahead, left = c * dx + si * dy, c * dy - si * dx
    half = 0.5 * turn
    # On an arc the rear axle moves along the heading at half of the turn.
    xi, yi, ti, xj, yj, tj = (N_FRAME * k + d for k in (i, j) for d in (0, 1, 2))
    along = np.cos(half) * ahead + np.sin(half) * left
    across = np.cos(half) * left - np.sin(half) * ahead
    cm, sm = np.cos(state.poses[i, 2] + half), np.sin(state.poses[i, 2] + half)
    one = np.ones(len(i))
    add(across, s.slip, (xi, sm), (yi, -cm), (xj, -sm), (yj, cm), (ti, -0.5 * along), (tj, -0.5 * along))
    follows = np.flatnonzero(j[:-1] == i[1:])
    a, b = follows, follows + 1
    # Ways in proportion to what was commanded; where the car was told to stand, its way is left alone.
    per = np.where(expected[j] > 0.0, 1.0 / np.maximum(expected[j], _LEAST_WAY), 0.0)
    per_a, per_b = per[a] * (per[b] > 0.0), per[b] * (per[a] > 0.0)
    add(
        per_b * along[b] - per_a * along[a],
        s.speed_change,
        (xj[b], per_b * cm[b]),
        (yj[b], per_b * sm[b]),
        (xi[b], -per_b * cm[b] - per_a * cm[a]),
        (yi[b], -per_b * sm[b] - per_a * sm[a]),
        (xi[a], per_a * cm[a]),
        (yi[a], per_a * sm[a]),
        *((k, 0.5 * per_b * across[b]) for k in (ti[b], tj[b])),
        *((k, -0.5 * per_a * across[a]) for k in (ti[a], tj[a])),
    )
    # Of a car that hardly moves the recorded speed says little of the way.
    told = np.flatnonzero(expected[j] >= _LEAST_WAY) if recorded else np.zeros(0, np.int64)
    if told.size:
        # Of the gain the ways themselves are asked: what all have in common is left to the pictures.
        usual = max(float(np.median(per[told] * along[told])), 1e-6)
        by = per[told] / usual
        add(
            by * along[told] - 1.0,
            s.recorded_speed,
            (xj[told], by * cm[told]),
            (yj[told], by * sm[told]),
            (xi[told], -by * cm[told]),
            (yi[told], -by * sm[told]),
            *((k[told], 0.5 * by * across[told]) for k in (ti, tj)),
        )
    add(turn[b] - turn[a], s.turn_change, (tj[b], one[b]), (ti[b], -2.0 * one[b]), (ti[a], one[a]))
    # The first pose stays.
    add(np.zeros(3), 1e-6, (np.arange(3), np.ones(3)))
    e = np.concatenate(errors)
    jac = coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(count, N_FRAME * n)
    ).tocsc()
    return 0.5 * float(e @ e), (jac.T @ jac).tocsc(), -(jac.T @ e)
