"""Normal equations of a large pose graph, as a sparse matrix factorised by SuperLU.

The system holds everything that depends on which nodes are joined and not on numbers: the elimination order of the
nodes, where each block goes, the sparse matrix's indices.

The order comes from SuperLU's minimum degree on the graph of nodes, which is d^2 times smaller than the matrix of
scalars; the factorisations then keep it. Symmetric mode with diagonal pivots suits positive definite matrices and
keeps the fill of that order: with SuperLU's default order 3D graphs take a hundred times longer. Leave its
`relax` at the default: 16 or more overruns a buffer inside SuperLU and corrupts the heap (seen with scipy 1.17).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import SuperLU, splu

from robominer_slam.geometry import FloatArray
from robominer_slam.slam.linear_system import IndexArray, SingularSystemError

_SYMMETRIC = {"SymmetricMode": True, "Equil": False}


class SparseSystem:
    """The normal equations of `linear_system.LinearSystem` as a sparse matrix; free nodes in elimination order."""

    def __init__(
        self,
        i: NDArray[np.int64],
        j: NDArray[np.int64],
        fixed: NDArray[np.bool_],
        block_size: int,
    ) -> None:
        """Find the order of elimination and where the edges' numbers go.

        Args:
            i, j: nodes of the edges, shape (m,), i != j.
            fixed: nodes that do not move, shape (n,).
            block_size: d, unknowns per node.
        """
        self.block_size = block_size
        free = np.flatnonzero(~fixed)
        place = np.full(fixed.size, -1, dtype=np.intp)
        place[free] = np.arange(free.size)
        order = _elimination_order(place[i], place[j], free.size)
        self.free_nodes = free[order]
        place[self.free_nodes] = np.arange(free.size)
        self._lay_out(place[i], place[j], free.size)

    def _lay_out(self, a: IndexArray, b: IndexArray, f: int) -> None:
        d, m = self.block_size, a.size
        edge = np.arange(m)
        has_a, has_b = a >= 0, b >= 0
        both = has_a & has_b
        low_of_edge = np.minimum(a[both], b[both]).astype(np.int64)
        keys, pair = np.unique(low_of_edge * f + np.maximum(a[both], b[both]), return_inverse=True)
        low, high = (keys // f).astype(np.intp), (keys % f).astype(np.intp)
        # Blocks: the diagonal ones of the f nodes, then one per joined pair of nodes.
        self._blocks_of_edges = _signed_selection(
            (f + keys.size, m),
            [(a[has_a], edge[has_a], 1.0), (b[has_b], edge[has_b], 1.0), (f + pair, edge[both], -1.0)],
        )
        self._gradient_of_edges = _signed_selection(
            (f, m), [(b[has_b], edge[has_b], 1.0), (a[has_a], edge[has_a], -1.0)]
        )
        diagonal = np.arange(f)
        pairs = f + np.arange(keys.size)
        row = np.concatenate([diagonal, low, high])
        column = np.concatenate([diagonal, high, low])
        block = np.concatenate([diagonal, pairs, pairs])
        by_column = np.lexsort((row, column))
        row, column, block = row[by_column], column[by_column], block[by_column]
        per_column = np.bincount(column, minlength=f)
        first = np.cumsum(per_column) - per_column
        # Column c of a block column lists, for each of its blocks in turn, that block's d rows.
        c, r = np.arange(d)[:, None], np.arange(d)
        start = first[column] * d * d + (np.arange(row.size) - first[column]) * d
        slot = start[:, None, None] + (c * per_column[column][:, None, None]) * d + r
        self._source = np.empty(row.size * d * d, dtype=np.intp)
        self._source[slot] = block[:, None, None] * d * d + r * d + c
        indices = np.empty(self._source.size, dtype=np.int32)
        indices[slot] = row[:, None, None] * d + r
        indptr = np.concatenate([[0], np.cumsum(np.repeat(per_column * d, d))]).astype(np.int32)
        self._H = csc_matrix((np.zeros(indices.size), indices, indptr), shape=(f * d, f * d))
        self._H.has_sorted_indices = True

    def gradient(self, edge_gradients: FloatArray) -> FloatArray:
        """Sum of the edges' gradients, shape (m, k), over the free nodes, shape (f, k)."""
        return np.asarray(self._gradient_of_edges @ edge_gradients)

    def factorise(self, edge_blocks: FloatArray) -> SuperLU:
        """Factors of the sum of the edges' blocks, shape (m, d, d).

        Raises:
            SingularSystemError: the matrix is singular.
        """
        d = self.block_size
        # The f diagonal blocks, then the others.
        blocks = np.asarray(self._blocks_of_edges @ edge_blocks.reshape(-1, d * d))
        np.take(blocks.reshape(-1), self._source, out=self._H.data)
        try:
            return splu(self._H, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=_SYMMETRIC)
        except RuntimeError as error:  # SuperLU: "Factor is exactly singular"
            raise SingularSystemError(str(error)) from error


def _signed_selection(shape: tuple[int, int], entries: list[tuple[IndexArray, IndexArray, float]]) -> csr_matrix:
    rows = np.concatenate([row for row, _, _ in entries])
    columns = np.concatenate([column for _, column, _ in entries])
    values = np.concatenate([np.full(row.size, sign) for row, _, sign in entries])
    by_row = np.argsort(rows, kind="stable")
    start = np.zeros(shape[0] + 1, dtype=np.int32)
    np.cumsum(np.bincount(rows, minlength=shape[0]), out=start[1:])
    return csr_matrix((values[by_row], columns[by_row].astype(np.int32), start), shape=shape)


def _elimination_order(a: IndexArray, b: IndexArray, f: int) -> IndexArray:
    """Free nodes in an order of little fill: minimum degree on the graph whose edges are (a, b); -1 is fixed."""
    if f == 0:
        return np.empty(0, dtype=np.intp)
    both = (a >= 0) & (b >= 0)
    a, b, k = a[both], b[both], np.arange(f)
    degree = 1.0 + np.bincount(a, minlength=f) + np.bincount(b, minlength=f)
    off = np.full(a.size, -1.0)
    graph = csc_matrix(
        (np.concatenate([degree, off, off]), (np.concatenate([k, a, b]), np.concatenate([k, b, a]))), shape=(f, f)
    )
    factors = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=_SYMMETRIC)
    return np.argsort(factors.perm_c)
