"""What the normal equations of a pose graph offer, however they are held: `dense_system` or `sparse_system`.

With the perturbation of `pose_graph_residuals` an edge (i, j) adds one symmetric block A = J' Omega J to the matrix
H: +A at (i, i) and (j, j), -A at (i, j) and (j, i). To the gradient it adds +g at j and -g at i, g = J' Omega e.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robominer_slam.geometry import FloatArray

# Sizes of this machine: on the board's 32 bits numpy refuses 64-bit integers where it counts or gathers.
IndexArray = NDArray[np.intp]


class SingularSystemError(ArithmeticError):
    """The normal equations have no unique solution."""


class Factors(Protocol):
    """Factors of H. Use them in the thread that made them only, and let go of them soon: SuperLU frees per thread."""

    def solve(self, rhs: FloatArray, /) -> FloatArray:
        """H^-1 rhs, shape (f d,) or (f d, k)."""


class LinearSystem(Protocol):
    """Normal equations of a graph whose edges keep their ends; built once, it serves every iteration.

    Attributes:
        free_nodes: nodes that are unknowns, in the system's order, shape (f,).
        block_size: d, 3 in the plane, 6 in space.
    """

    free_nodes: IndexArray
    block_size: int

    def gradient(self, edge_gradients: FloatArray) -> FloatArray:
        """Sum of the edges' gradients J' Omega e, shape (m, k), over the free nodes, shape (f, k); k may be any."""

    def factorise(self, edge_blocks: FloatArray) -> Factors:
        """Factors of H, the sum of the edges' blocks J' Omega J, shape (m, d, d).

        Raises:
            SingularSystemError: the matrix is singular.
        """


def solution(factors: Factors, right_side: FloatArray) -> FloatArray:
    """Solution (f, d) of H x = right_side (f, d).

    Raises:
        SingularSystemError: the solution is not finite.
    """
    x = np.asarray(factors.solve(right_side.reshape(-1)))
    if not np.isfinite(x).all():
        raise SingularSystemError("the solution of the normal equations is not finite")
    return x.reshape(right_side.shape)
