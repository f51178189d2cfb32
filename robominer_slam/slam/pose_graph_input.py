"""What may go into a pose graph: poses, information matrices, edges between nodes that exist and are joined."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from robominer_slam.geometry import FloatArray

#: Up to so many edges the parts of a graph are found in Python.
_FEW_EDGES = 200


class PoseGraphError(ValueError):
    """A graph that cannot be built or solved; the message says which node or edge, and what was expected."""


def checked_poses(dim: int, poses: ArrayLike, count: int | None, what: str) -> FloatArray:
    """Poses (count, 3) or (count, 4, 4) as floats; `count` None takes any number.

    Raises:
        PoseGraphError: a wrong shape, a number that is not finite, or no proper rotation.
    """
    p = np.asarray(poses, dtype=np.float64)
    shape = (3,) if dim == 2 else (4, 4)
    if p.ndim != 1 + len(shape) or p.shape[1:] != shape or count not in (None, p.shape[0]):
        expected = ", ".join(str(size) for size in ("k" if count is None else count, *shape))
        raise PoseGraphError(f"{what}s have shape {p.shape}; expected ({expected})")
    good = np.isfinite(p).all(axis=tuple(range(1, p.ndim)))
    if dim == 3:
        R = p[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        good &= (off < 1e-6) & (np.linalg.det(R) > 0.0)
    for k in np.flatnonzero(~good)[:1]:
        raise PoseGraphError(f"{what} {k} of those given is not a finite pose with a proper rotation")
    return p


def checked_information(d: int, information: ArrayLike, count: int) -> FloatArray:
    """Information matrices (count, d, d) as floats, made symmetric to the bit.

    Raises:
        PoseGraphError: a wrong shape, a number that is not finite, or a matrix that is zero, not symmetric or not
            positive semidefinite.
    """
    Omega = np.asarray(information, dtype=np.float64)
    if Omega.shape != (count, d, d):
        raise PoseGraphError(f"information matrices have shape {Omega.shape}; expected ({count}, {d}, {d})")
    if not np.isfinite(Omega).all():
        raise PoseGraphError("a number of an information matrix is not finite; expected symmetric finite matrices")
    transposed = np.swapaxes(Omega, -1, -2)
    scale = np.abs(Omega).max(axis=(1, 2), initial=0.0)
    skew = np.abs(Omega - transposed).max(axis=(1, 2), initial=0.0)
    Omega = 0.5 * (Omega + transposed)
    least = np.linalg.eigvalsh(Omega)[:, 0]
    for k in np.flatnonzero((skew > 1e-9 * scale) | (least < -1e-9 * scale) | (scale == 0.0))[:1]:
        raise PoseGraphError(
            f"information matrix {k} of those given is not symmetric and positive semidefinite (least eigenvalue "
            f"{least[k]:.3g})"
        )
    return Omega


def check_ends(i: NDArray[np.int64], j: NDArray[np.int64], node_count: int, first_edge: int) -> None:
    """Check that edges join two different nodes that exist.

    Raises:
        PoseGraphError: one does not.
    """
    for k in np.flatnonzero((np.minimum(i, j) < 0) | (np.maximum(i, j) >= node_count) | (i == j))[:1]:
        raise PoseGraphError(
            f"edge {first_edge + k} joins nodes {i[k]} and {j[k]}; expected two different ones of the {node_count} "
            "nodes"
        )


def check_joined(i: NDArray[np.int64], j: NDArray[np.int64], fixed: NDArray[np.bool_]) -> None:
    """Check that edges (i, j) join every node to a fixed one.

    Raises:
        PoseGraphError: a node is adrift.
    """
    n = fixed.size
    component = _components(i, j, n)
    held = np.zeros(n, dtype=np.bool_)
    held[component[fixed]] = True
    adrift = np.flatnonzero(~held[component])
    if adrift.size:
        raise PoseGraphError(
            f"node {adrift[0]} is not joined to a fixed node by enabled edges ({adrift.size} of {n} nodes are not); "
            "add edges or fix one of them"
        )


def _components(i: NDArray[np.int64], j: NDArray[np.int64], n: int) -> NDArray[np.intp]:
    """A number per node, shape (n,), the same for nodes that edges (i, j) join by whatever way."""
    if i.size > _FEW_EDGES:
        _, component = connected_components(coo_matrix((np.ones(i.size), (i, j)), shape=(n, n)), directed=False)
        return np.asarray(component, dtype=np.intp)
    # Union by the lesser number: scipy's would take longer for its matrix alone than a small graph for everything.
    leader = list(range(n))

    def leader_of(node: int) -> int:
        while leader[node] != node:
            leader[node] = node = leader[leader[node]]
        return node

    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        first, second = sorted((leader_of(a), leader_of(b)))
        leader[second] = first
    return np.array([leader_of(node) for node in range(n)])
