"""What the edges of keyframes that go know of those that stay, as edges between these.

Keyframes that go together, with the edges at them, are a small graph of their own. Linearised where the keyframes lie
now, its least squares give the poses of the keyframes around it, the first of them held, as x = G e, with e the errors
of its edges, and P the covariance of x. What it knows of the pose of q in p is thus

    Z = Z_now Exp(-A G r),   Sigma = A P A',   B = A G B_e,   A = [-Ad(Z_now^-1) at p, I at q],

with r the edges' residuals now and B_e their derivatives by the biases: the exact marginal for known biases. What it
knows of the biases themselves is lost. All pairs (p, q) together would know it all; a tree of them is kept. The tree
whose log det Sigma sums up to the least is the nearest to the marginal by Kullback and Leibler's divergence, since the
matrices from one tree's relative poses to another's have the determinant 1. Pairs that a closure joins already are
preferred, so that the graph stays sparse. Odometry stays a chain: the pairs that it has to join are in the tree.

A tree takes what its edges share for independent. So that the graph becomes surer of nothing, all its information is
divided by the greatest ratio, over all directions, of what the tree says to what the marginal says.

Sources: Mazuran, Burgard and Tipaldi, "Nonlinear factor recovery for long-term SLAM" (IJRR 2016), for relative poses
with the marginal's own covariances; Carlevaris-Bianco, Kaess and Eustice, "Generic node removal for factor-graph SLAM"
(T-RO 2014), for the tree; Carlevaris-Bianco and Eustice, "Conservative edge sparsification for graph SLAM node removal"
(ICRA 2014).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from robominer_slam import geometry
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.level_edges import LevelEdge

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

#: A pair that a closure joins already is taken before one of so much less log det Sigma: twice the sigma, three axes.
JOINED = 6.0 * float(np.log(2.0))
#: Edges that say less are as good as none, and only keep the odometry a chain: sigmas of x, y (m) and heading
#: (rad), and of the height (m).
LOOSE = np.array([3.0, 3.0, 1.0])
LOOSE_HEIGHT = 1.0
#: No closure is surer, m, m and rad, however many it stands for: each keyframe's touches have errors of their own.
SUREST = np.array([0.001, 0.001, 0.001])
#: Edges that want a pose so far from where it lies, m and rad, know nothing of it: it is left where it lies.
KNOWN = 0.1


def recovered(graph: KeyframeGraph, keys: list[int]) -> list[LevelEdge]:
    """Edges that say what those at the keyframes `keys` say of the others; edges taken back say nothing.

    Raises:
        ValueError: the first or the last keyframe of a chain of odometry is among `keys`.
    """
    edges = graph.edges
    gone = np.array(sorted(keys), dtype=np.int64)
    at_i, at_j = np.isin(edges.i, gone), np.isin(edges.j, gone)
    inner = np.flatnonzero(at_i & at_j & edges.enabled)
    ends = np.searchsorted(gone, edges.i[inner]), np.searchsorted(gone, edges.j[inner])
    links = coo_matrix((np.ones(len(inner)), ends), shape=(len(gone), len(gone)))
    count, part = connected_components(links, directed=False)
    rows = np.flatnonzero((at_i | at_j) & edges.enabled)
    part_of_row = part[np.searchsorted(gone, np.where(at_i[rows], edges.i[rows], edges.j[rows]))]
    found: list[LevelEdge] = []
    for k in range(count):
        part_rows = rows[part_of_row == k]
        try:
            found += _Marginal(graph, part_rows, gone).tree()
        except np.linalg.LinAlgError:
            # Out of numbers: a map that has lost what these edges knew is better than none.
            graph.loose_bridges += 1
            found += _bridges(graph, part_rows, gone)
    return found


def _bridges(graph: KeyframeGraph, rows: IndexArray, gone: IndexArray) -> list[LevelEdge]:
    """Edges that keep the odometry a chain where keyframes go, at the present poses, and say next to nothing."""
    begins, ends = _chain_ends(graph, rows, gone)
    nb, nodes = graph.bias.size, graph.nodes
    return [
        LevelEdge(
            "odometry",
            p,
            q,
            graph.relative(p, q),
            np.diag(LOOSE**-2.0),
            nodes.height(q) - nodes.height(p),
            LOOSE_HEIGHT**-2.0,
            np.zeros((3, nb)),
            graph.bias.copy(),
        )
        for p, q in zip(begins.tolist(), ends.tolist(), strict=True)
    ]


def _chain_ends(graph: KeyframeGraph, rows: IndexArray, gone: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Keyframes that stay before and after each stretch of odometry that goes, growing.

    Raises:
        ValueError: the first or the last keyframe of a chain of odometry goes.
    """
    i, j = graph.edges.i[rows], graph.edges.j[rows]
    steps = ~graph.edges.loop[rows]
    begins, ends = np.sort(i[steps & ~np.isin(i, gone)]), np.sort(j[steps & ~np.isin(j, gone)])
    if len(begins) != len(ends) or (begins >= ends).any():
        raise ValueError("the first and the last keyframe of a graph cannot be taken out of it")
    return begins, ends


def combined(graph: KeyframeGraph, one: LevelEdge, other: LevelEdge) -> LevelEdge:
    """Two closures between the same keyframes as one that says what both say."""
    now = graph.relative(one.i, one.j)
    information = one.information + other.information
    moved, jacobian, slack = np.zeros(3), np.zeros_like(one.jacobian), np.zeros((3, 3))
    for edge in (one, other):
        share = np.linalg.solve(information, edge.information)
        Z = geometry.se2_compose(edge.Z, geometry.se2_exp(edge.jacobian @ (graph.bias - edge.reference)))
        moved += share @ geometry.se2_log(geometry.se2_compose(geometry.se2_inverse(now), Z))
        jacobian += share @ edge.jacobian
        if edge.slack is not None:
            slack += share @ edge.slack @ share.T
    dz_information = one.dz_information + other.dz_information
    return LevelEdge(
        one.kind,
        one.i,
        one.j,
        geometry.se2_compose(now, geometry.se2_exp(moved)),
        _no_surer(information),
        (one.dz * one.dz_information + other.dz * other.dz_information) / dz_information,
        dz_information,
        jacobian,
        graph.bias.copy(),
        fade=min(one.fade, other.fade),
        slack=slack,
    )


class _Marginal:
    """What some connected edges say of the keyframes around those that go.

    Args:
        graph: the graph.
        rows: of the edges, shape (m,).
        gone: ids of all keyframes that go, growing.
    """

    def __init__(self, graph: KeyframeGraph, rows: IndexArray, gone: IndexArray) -> None:
        edges = graph.edges
        self._graph, self._rows = graph, rows
        i, j = edges.i[rows], edges.j[rows]
        self._ids = ids = np.unique(np.concatenate([i, j]))
        self._around = np.flatnonzero(~np.isin(ids, gone))
        self._begins, self._ends = _chain_ends(graph, rows, gone)
        relative = graph.relatives(i, j)
        a, b, m, n = np.searchsorted(ids, i), np.searchsorted(ids, j), len(rows), len(ids)
        self._r = geometry.se2_log(geometry.se2_compose(geometry.se2_inverse(graph.measured(rows)), relative))
        held = int(self._around[0])
        self._P, self._G = _least_squares(_differences(a, b, n, relative), edges.information[rows], 3 * held)
        z = graph.nodes.heights[graph.nodes.rows(ids)]
        self._r_z = z[b] - z[a] - edges.dz[rows]
        height_information = edges.dz_information[rows].reshape(m, 1, 1)
        self._P_z, self._G_z = _least_squares(_height_differences(a, b, n), height_information, held)

    def tree(self) -> list[LevelEdge]:
        """Edges over the keyframes around; those of odometry first."""
        p, q = (self._around[k] for k in np.triu_indices(len(self._around), 1))
        covariance = self._covariance(p, q)
        chain = self._is_chain(p, q)
        cost = np.linalg.slogdet(covariance)[1] - JOINED * self._is_joined(p, q)
        chosen = _spanning_tree(p, q, np.where(chain, -np.inf, cost))
        p, q, covariance, chain = p[chosen], q[chosen], covariance[chosen], chain[chosen]
        graph, edges, rows, n = self._graph, self._graph.edges, self._rows, len(self._ids)
        relative = graph.relatives(self._ids[p], self._ids[q])
        A, A_z = _differences(p, q, n, relative), _height_differences(p, q, n)
        variance = (A_z @ self._P_z @ A_z.transpose(0, 2, 1)).ravel()
        gain = (A @ self._G).reshape(len(p), 3, len(rows), 3).transpose(0, 2, 1, 3)
        moved = (gain @ self._r[:, :, None]).sum(axis=1)[:, :, 0]
        moved[np.abs(moved).max(axis=1) > KNOWN] = 0.0
        Z = geometry.se2_compose(relative, geometry.se2_exp(-moved))
        z = graph.nodes.heights[graph.nodes.rows(self._ids)]
        dz = z[q] - z[p] - A_z[:, 0] @ (self._G_z @ self._r_z)
        jacobian = (gain @ edges.jacobian[rows]).sum(axis=1)
        slack = (gain @ edges.slack[rows] @ gain.transpose(0, 1, 3, 2)).sum(axis=1)
        covariance = covariance * _excess(A, covariance, self._P)
        variance = variance * _excess(A_z, variance[:, None, None], self._P_z)
        if not (np.isfinite(covariance).all() and np.isfinite(variance).all() and np.isfinite(moved).all()):
            raise np.linalg.LinAlgError("what the edges say has no marginal")
        fade = float(edges.fade[rows].min())
        return [
            LevelEdge(
                "odometry" if chain[k] else "loop",
                int(self._ids[p[k]]),
                int(self._ids[q[k]]),
                Z[k],
                _inverse(covariance[k]) + np.diag(LOOSE**-2.0),
                float(dz[k]),
                1.0 / float(variance[k]) + LOOSE_HEIGHT**-2.0,
                jacobian[k],
                graph.bias.copy(),
                fade=fade,
                slack=slack[k],
            )
            for k in range(len(p))
        ]

    def _covariance(self, p: IndexArray, q: IndexArray) -> FloatArray:
        """Sigma of the pairs (p, q), shape (k, 3, 3)."""
        n = len(self._ids)
        P = self._P.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
        Ad = geometry.se2_adjoint(geometry.se2_inverse(self._graph.relatives(self._ids[p], self._ids[q])))
        across = Ad @ P[p, q]
        return np.asarray(P[q, q] + Ad @ P[p, p] @ Ad.transpose(0, 2, 1) - across - across.transpose(0, 2, 1))

    def _is_chain(self, p: IndexArray, q: IndexArray) -> NDArray[np.bool_]:
        """Which pairs odometry joins past keyframes that go."""
        if not len(self._begins):
            return np.zeros(len(p), dtype=np.bool_)
        at = np.minimum(np.searchsorted(self._begins, self._ids[p]), len(self._begins) - 1)
        return np.asarray((self._begins[at] == self._ids[p]) & (self._ends[at] == self._ids[q]))

    def _is_joined(self, p: IndexArray, q: IndexArray) -> NDArray[np.bool_]:
        """Which pairs a closure joins already."""
        edges, nodes = self._graph.edges, self._graph.nodes
        names = edges.i * (nodes.ids[-1] + 1) + edges.j
        return np.isin(self._ids[p] * (nodes.ids[-1] + 1) + self._ids[q], names[edges.loop & edges.enabled])


def _no_surer(information: FloatArray) -> FloatArray:
    """Information, shape (3, 3), that in no direction says more than `SUREST`."""
    values, vectors = np.linalg.eigh(SUREST[:, None] * information * SUREST)
    if values[-1] <= 1.0:
        return information
    return np.asarray((vectors * np.minimum(values, 1.0)) @ vectors.T) / np.outer(SUREST, SUREST)


def _differences(p: IndexArray, q: IndexArray, n: int, relative: FloatArray) -> FloatArray:
    """What moving n poses does to the poses (k, 3) of q in p, as twists in q's frame, shape (k, 3, 3 n)."""
    A = np.zeros((len(p), 3, n, 3))
    each = np.arange(len(p))
    A[each, :, p] = -geometry.se2_adjoint(geometry.se2_inverse(relative))
    A[each, :, q] = np.eye(3)
    return A.reshape(len(p), 3, 3 * n)


def _height_differences(p: IndexArray, q: IndexArray, n: int) -> FloatArray:
    """As `_differences`, of heights, shape (k, 1, n)."""
    A = np.zeros((len(p), 1, n))
    each = np.arange(len(p))
    A[each, 0, p], A[each, 0, q] = -1.0, 1.0
    return A


def _least_squares(D: FloatArray, information: FloatArray, held: int) -> tuple[FloatArray, FloatArray]:
    """Covariance P of the unknowns, and gain G by which the edges' errors move them; one node's are held.

    Args:
        D: derivatives of the edges' errors, shape (m, d, n d).
        information: of the edges, shape (m, d, d).
        held: first unknown of the node that is held.
    """
    m, d, size = D.shape
    free = np.delete(np.arange(size), np.arange(held, held + d))
    weighted = (information @ D[:, :, free]).reshape(m * d, -1)
    covariance = _inverse(D[:, :, free].reshape(m * d, -1).T @ weighted)
    P, G = np.zeros((size, size)), np.zeros((size, m * d))
    P[np.ix_(free, free)] = covariance
    G[free] = covariance @ weighted.T
    return P, G


def _spanning_tree(p: IndexArray, q: IndexArray, cost: FloatArray) -> IndexArray:
    """Which of the pairs (p, q) make the tree of least cost (Kruskal)."""
    part = np.arange(int(q.max(initial=0)) + 1)
    chosen = []
    for k in np.argsort(cost, kind="stable"):
        one, other = part[p[k]], part[q[k]]
        if one != other:
            part[part == other] = one
            chosen.append(int(k))
    return np.array(chosen, dtype=np.int64)


def _excess(A: FloatArray, covariance: FloatArray, P: FloatArray) -> float:
    """Greatest ratio of the information of a tree, A (k, d, n d) and covariance (k, d, d), to that of the marginal.

    With W = diag(covariance)^-1/2 it is the greatest eigenvalue of W A P A' W': of how far the tree's edges correlate.
    """
    k, d, _ = A.shape
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), A).reshape(k * d, -1)
    return max(1.0, float(np.linalg.eigvalsh(whitened @ P @ whitened.T)[-1]))


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a covariance or an information matrix, symmetric to the bit."""
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return 0.5 * (inverse + inverse.T)
