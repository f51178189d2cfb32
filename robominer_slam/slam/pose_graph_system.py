"""The normal equations of a pose graph, held in the way that suits its size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.dense_system import DenseSystem
from robominer_slam.slam.linear_system import LinearSystem
from robominer_slam.slam.sparse_system import SparseSystem

#: Up to so many unknowns a full matrix is quicker; on a PC both take the same time at 300.
DENSE_UNKNOWNS = 150


def normal_system(
    i: NDArray[np.int64], j: NDArray[np.int64], fixed: NDArray[np.bool_], block_size: int
) -> LinearSystem:
    """Normal equations of edges (i, j), shape (m,) each, i != j.

    Args:
        i, j: nodes of the edges.
        fixed: nodes that do not move, shape (n,).
        block_size: d, unknowns per node.
    """
    unknowns = (fixed.size - np.count_nonzero(fixed)) * block_size
    if unknowns <= DENSE_UNKNOWNS:
        return DenseSystem(i, j, fixed, block_size)
    return SparseSystem(i, j, fixed, block_size)
