"""The normal equations of the bundle adjustment: a sparse matrix of the frames, bordered by the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_matrix, csc_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from datagen.slam.bundle_kernels import N_FRAME


@dataclass(frozen=True)
class Equations:
    """Normal equations about a state.

    Attributes:
        cost: Robust cost there, priors included.
        frames: Between the frames' numbers.
        border: Between the frames' numbers and those of the camera that are free.
        camera: Between the latter.
        rhs: Downhill slope of the cost, frames first.
        residual_px: Residual of each link; NaN where it has none.
    """

    cost: float
    frames: csc_matrix
    border: Float[np.ndarray, "u f"]
    camera: Float[np.ndarray, "f f"]
    rhs: Float[np.ndarray, "v"]
    residual_px: Float[np.ndarray, "r"]

    def step(self, damping: float) -> Float[np.ndarray, "v"]:
        """Solve with the camera's few dense columns eliminated last.

        Args:
            damping: Share added to the diagonal.
        """
        count = len(self.border)
        frames = (self.frames + damping * diags(self.frames.diagonal())).tocsc()
        reduced = _factorised(frames).solve(np.column_stack([self.rhs[:count], self.border]))
        if not self.border.shape[1]:
            return np.asarray(reduced[:, 0])
        camera = self.camera + damping * np.diag(np.diag(self.camera))
        schur = camera - self.border.T @ reduced[:, 1:]
        found = np.linalg.solve(schur, self.rhs[count:] - self.border.T @ reduced[:, 0])
        return np.concatenate([reduced[:, 0] - reduced[:, 1:] @ found, found])

    def camera_sigma(self) -> Float[np.ndarray, "f"]:
        """Standard deviations of the camera's free numbers when all else is free, too."""
        if not self.border.shape[1]:
            return np.zeros(0)
        schur = self.camera - self.border.T @ _factorised(self.frames).solve(self.border)
        return np.sqrt(np.maximum(np.diag(np.linalg.inv(schur)), 0.0))


def _factorised(matrix: csc_matrix) -> SuperLU:
    """Factors of a positive definite matrix: no pivoting, and an order that suits symmetry."""
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


class FramePattern:
    """Where the blocks of pairs of frames go in the matrix; found once, since the pairs stay."""

    def __init__(self, pairs: Int[np.ndarray, "p 2"], frames: int) -> None:
        i, j = pairs.T
        # In the order of a pair's quarters: (i, i), (i, j), (j, i), (j, j); every frame has its diagonal.
        each = np.arange(frames)
        row = np.concatenate([np.stack([i, i, j, j], axis=1).ravel(), each])
        column = np.concatenate([np.stack([i, j, i, j], axis=1).ravel(), each])
        places, slot = np.unique(row * frames + column, return_inverse=True)
        self._order = np.argsort(slot[: 4 * len(pairs)], kind="stable")
        sorted_slot = slot[self._order]
        self._first = np.flatnonzero(np.diff(sorted_slot, prepend=-1))
        self._filled = sorted_slot[self._first]
        size = N_FRAME * N_FRAME
        numbered = np.arange(len(places) * size).reshape(-1, N_FRAME, N_FRAME)
        starts = np.searchsorted(places // frames, np.arange(frames + 1))
        # Numbers counted from 1, since a conversion may drop zeros.
        blocks = bsr_matrix((numbered + 1.0, places % frames, starts), shape=(N_FRAME * frames,) * 2).tocsc()
        blocks.sort_indices()
        self._at = blocks.data.astype(np.int64) - 1
        self._indices, self._starts, self._shape = blocks.indices, blocks.indptr, blocks.shape
        self._blocks = len(places)

    def matrix(self, blocks: Float[np.ndarray, "p 10 10"]) -> csc_matrix:
        """Sum the pairs' blocks into the matrix."""
        count = len(blocks)
        quarters = blocks.reshape(count, 2, N_FRAME, 2, N_FRAME).transpose(0, 1, 3, 2, 4)
        quarters = quarters.reshape(4 * count, N_FRAME, N_FRAME)
        summed = np.zeros((self._blocks, N_FRAME, N_FRAME))
        if count:
            summed[self._filled] = np.add.reduceat(quarters[self._order], self._first, axis=0)
        return csc_matrix((summed.ravel()[self._at], self._indices, self._starts), shape=self._shape)
