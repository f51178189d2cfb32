"""Normal equations of a small pose graph, as one full matrix factorised by Cholesky's method.

Up to some hundred unknowns the work is nothing and the calls are everything: a full matrix needs no order of
elimination and no pattern, and LAPACK solves it in less time than a sparse matrix takes to be made.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs

from robominer_slam.geometry import FloatArray
from robominer_slam.slam.linear_system import SingularSystemError


class DenseFactors:
    """Cholesky's factor of a full matrix."""

    def __init__(self, factor: FloatArray) -> None:
        """Keep the upper factor, shape (n, n), as LAPACK left it."""
        self._factor = factor

    def solve(self, rhs: FloatArray, /) -> FloatArray:
        """H^-1 rhs, shape (n,) or (n, k)."""
        x, _ = dpotrs(self._factor, rhs)
        return np.asarray(x)


class DenseSystem:
    """The normal equations of `linear_system.LinearSystem` as a full matrix; free nodes in ascending order."""

    def __init__(self, i: NDArray[np.int64], j: NDArray[np.int64], fixed: NDArray[np.bool_], block_size: int) -> None:
        """Find where the edges' numbers go.

        Args:
            i, j: nodes of the edges, shape (m,), i != j.
            fixed: nodes that do not move, shape (n,).
            block_size: d, unknowns per node.
        """
        self.block_size = d = block_size
        self.free_nodes = np.flatnonzero(~fixed)
        f = self.free_nodes.size
        # All fixed nodes share one place behind the free ones, and are cut off from what is summed.
        place = np.full(fixed.size, f)
        place[self.free_nodes] = np.arange(f)
        ends = place[np.array([i, j])]
        nodes = np.arange(f)
        self._signs = np.equal.outer(nodes, ends[1]) * 1.0 - np.equal.outer(nodes, ends[0])
        self._width = (f + 1) * d
        at = np.arange(d)
        ends.sort(axis=0)
        # LAPACK reads the upper triangle only.
        corners = ends[[0, 1, 0]] * (d * self._width) + ends[[0, 1, 1]] * d
        self._slots = (corners[:, :, None, None] + (at[:, None] * self._width + at)).reshape(-1)

    def gradient(self, edge_gradients: FloatArray) -> FloatArray:
        """Sum of the edges' gradients, shape (m, k), over the free nodes, shape (f, k)."""
        return np.asarray(self._signs @ edge_gradients)

    def factorise(self, edge_blocks: FloatArray) -> DenseFactors:
        """Factors of the sum of the edges' blocks, shape (m, d, d).

        Raises:
            SingularSystemError: the matrix is not positive definite.
        """
        if not self.free_nodes.size:
            return DenseFactors(np.zeros((0, 0)))
        blocks = edge_blocks.reshape(-1)
        summed = np.bincount(self._slots, np.concatenate([blocks, blocks, -blocks]), self._width**2)
        n = self._width - self.block_size
        factor, trouble = dpotrf(summed.reshape(self._width, self._width)[:n, :n], clean=0)
        if trouble:
            raise SingularSystemError(f"row {trouble - 1} of the normal equations depends on those before it")
        return DenseFactors(factor)
