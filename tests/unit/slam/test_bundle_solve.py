"""The bordered sparse system of the bundle adjustment, against the same in full."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import block_diag, csc_matrix

from datagen.slam.adjustment.adjust import Equations, sum_blocks
from datagen.slam.adjustment.kernels import N_FRAME

FRAMES = 9


def _pairs(rng: np.random.Generator) -> np.ndarray:
    """Neighbours both ways round, one pair twice, a loop; the last frame in no pair."""
    near = [(k + 1, k) if rng.random() < 0.5 else (k, k + 1) for k in range(FRAMES - 2)]
    return np.array([*near, (0, 4), (0, 4), (7, 1)])


def _unknowns(pairs: np.ndarray) -> np.ndarray:
    return (N_FRAME * pairs[:, :, None] + np.arange(N_FRAME)).reshape(-1, 2 * N_FRAME)


def _dense(pairs: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    full = np.zeros((N_FRAME * FRAMES, N_FRAME * FRAMES))
    for (i, j), block in zip(pairs, blocks, strict=True):
        at = np.concatenate([N_FRAME * i + np.arange(N_FRAME), N_FRAME * j + np.arange(N_FRAME)])
        full[np.ix_(at, at)] += block
    return full


@pytest.mark.parametrize("seed", range(3))
def test_blocks_of_pairs_add_up_where_they_belong(seed):
    rng = np.random.default_rng(seed)
    pairs = _pairs(rng)
    blocks = rng.normal(size=(len(pairs), 10, 10))
    found = sum_blocks(_unknowns(pairs), blocks, N_FRAME * FRAMES)
    np.testing.assert_allclose(found.toarray(), _dense(pairs, blocks), atol=1e-12)


def test_without_a_pair_the_matrix_is_empty():
    assert not sum_blocks(np.empty((0, 10), np.int64), np.empty((0, 10, 10)), 15).toarray().any()


@pytest.mark.parametrize("free", [0, 3])
@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_a_step_and_the_uncertainty_are_those_of_the_full_system(free, damping):
    rng = np.random.default_rng(free)
    pairs, size = _pairs(rng), N_FRAME * FRAMES
    half = rng.normal(size=(len(pairs), 12, 10))
    blocks = np.einsum("pki,pkj->pij", half, half) + 0.5 * np.eye(10)
    frames = sum_blocks(_unknowns(pairs), blocks, size)
    frames.setdiag(frames.diagonal() + 1.0)
    border, rhs = 0.1 * rng.normal(size=(size, free)), rng.normal(size=size + free)
    camera = 5.0 * np.eye(free) + 0.3
    full = np.block([[frames.toarray(), border], [border.T, camera]])
    now = Equations(1.0, frames.tocsc(), border, camera, rhs, np.zeros(0))
    damped = full + damping * np.diag(np.diag(full))
    np.testing.assert_allclose(now.step(damping), np.linalg.solve(damped, rhs), rtol=1e-8, atol=1e-10)
    sigma = np.sqrt(np.diag(np.linalg.inv(full))[size:])
    information, follow = now.without_frames()
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(information))), sigma, rtol=1e-8)
    np.testing.assert_allclose(follow, -np.linalg.solve(frames.toarray(), border), rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("most_band", [0, 50_000_000])
def test_numbers_that_no_equation_has_stay_and_the_others_move(monkeypatch, most_band):
    """A frame without an edge, of a car that was commanded to stand, has zeros in its rows."""
    monkeypatch.setattr("datagen.slam.adjustment.adjust._MOST_BAND", most_band)
    held = csc_matrix(2.0 * np.eye(N_FRAME))
    nothing = csc_matrix((N_FRAME, N_FRAME))
    border = np.concatenate([np.full((N_FRAME, 1), 0.5), np.zeros((N_FRAME, 1))])
    descent = np.concatenate([np.ones(N_FRAME), np.zeros(N_FRAME + 1)])
    now = Equations(1.0, block_diag([held, nothing]).tocsc(), border, np.array([[5.0]]), descent, np.zeros(0))
    step = now.step(1e-8)
    assert not step[N_FRAME : 2 * N_FRAME].any()
    full = np.block([[2.0 * np.eye(N_FRAME), border[:N_FRAME]], [border[:N_FRAME].T, np.array([[5.0]])]])
    expected = np.linalg.solve(full, np.append(descent[:N_FRAME], 0.0))
    np.testing.assert_allclose(np.append(step[:N_FRAME], step[-1]), expected, rtol=1e-6)
    information, follow = now.without_frames()
    np.testing.assert_allclose(information, [[5.0 - N_FRAME * 0.5**2 / 2.0]], rtol=1e-6)
    assert np.isfinite(follow).all()


def test_frames_that_nothing_joins_to_the_others_leave_the_camera_as_sure_as_it_was():
    """What joins them to each other says nothing of where they lie: their block is singular."""
    each = csc_matrix(np.kron([[1.0, -1.0], [-1.0, 1.0]], np.eye(N_FRAME)))
    held = csc_matrix(2.0 * np.eye(N_FRAME))
    alone = np.zeros((2 * N_FRAME, 1))
    border = np.concatenate([alone, np.full((N_FRAME, 1), 0.5)])
    afloat = Equations(
        1.0, block_diag([each, held]).tocsc(), border, np.array([[5.0]]), np.zeros(16), np.zeros(0)
    )
    information, follow = afloat.without_frames()
    np.testing.assert_allclose(information, [[5.0 - N_FRAME * 0.5**2 / 2.0]], rtol=1e-6)
    assert not follow[: 2 * N_FRAME].any()
