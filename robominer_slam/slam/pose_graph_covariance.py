"""Covariances of a pose graph's nodes, from the inverse of the normal equations at the present poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robominer_slam.geometry import FloatArray
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.linear_system import LinearSystem
from robominer_slam.slam.pose_graph_optimizer import Kernels, edge_costs, normal_equations
from robominer_slam.slam.pose_graph_residuals import EdgeArrays

#: Pairs whose columns are solved for in one go: bounds the memory.
_PAIRS_AT_ONCE = 64


def joint_covariance(
    edges: EdgeArrays, kernels: Kernels, poses: FloatArray, system: LinearSystem, nodes: Sequence[int]
) -> FloatArray:
    """Joint covariance of chosen nodes, shape (k d, k d), each as a twist in its own frame; 0 for fixed nodes.

    Only the columns of these nodes are solved for. Edges count with the weights of their kernels.

    Raises:
        SingularSystemError: the edges leave a direction free.
    """
    d, k, f = system.block_size, len(nodes), system.free_nodes.size
    if f == 0:
        return np.zeros((k * d, k * d))
    pivot = residuals.pivot_of(edges.dim, poses)
    costs = edge_costs(edges, kernels, poses, "gtsam")
    _, blocks = normal_equations(edges, costs, poses, pivot, system, "gtsam")
    place = np.full(poses.shape[0], -1)
    place[system.free_nodes] = np.arange(f)
    to_node = residuals.world_to_node(edges.dim, poses[list(nodes)], pivot)
    selected = np.zeros((f, d, k, d))
    for column, node in enumerate(nodes):
        if place[node] >= 0:
            selected[place[node], :, column] = to_node[column].T
    columns = selected.reshape(f * d, k * d)
    covariance = columns.T @ system.factorise(blocks).solve(columns)
    return np.asarray(0.5 * (covariance + covariance.T))


def sampled_relative_covariances(
    edges: EdgeArrays,
    kernels: Kernels,
    poses: FloatArray,
    system: LinearSystem,
    pairs: NDArray[np.int64],
    samples: int,
    seed: int,
) -> FloatArray:
    """Covariances of X_i^-1 X_j for many pairs (i, j) at once, shape (k, d, d), as twists in the frame of j.

    From random draws of all poses instead of from columns of the inverse: perturbing every edge by its own noise and
    solving gives a draw from the poses' distribution (Papandreou and Yuille, "Gaussian sampling by local
    perturbations", 2010). The relative error of a variance is sqrt(2 / samples), whatever the number of pairs.

    Raises:
        SingularSystemError: the edges leave a direction free.
    """
    d, f = system.block_size, system.free_nodes.size
    if f == 0 or pairs.shape[0] == 0:
        return np.zeros((pairs.shape[0], d, d))
    pivot = residuals.pivot_of(edges.dim, poses)
    costs = edge_costs(edges, kernels, poses, "gtsam")
    to_node = residuals.world_to_node(edges.dim, poses, pivot)
    J = residuals.jacobians(edges.dim, costs.E, costs.e, poses, edges.j, pivot, "gtsam")
    information = costs.weights[:, None, None] * edges.information
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    # Random signs have the covariance of standard normal noise, and cost less.
    noise = np.random.default_rng(seed).integers(0, 2, size=(edges.i.size, d, samples), dtype=np.int8) * 2.0 - 1.0
    pushes = (np.swapaxes(J, -1, -2) @ root) @ noise
    right_side = system.gradient(pushes.reshape(edges.i.size, d * samples)).reshape(f * d, samples)
    factors = system.factorise(np.swapaxes(J, -1, -2) @ information @ J)
    drawn = np.zeros((poses.shape[0], d, samples))
    drawn[system.free_nodes] = factors.solve(right_side).reshape(f, d, samples)
    i, j = pairs.T
    relative = to_node[j] @ (drawn[j] - drawn[i])
    return np.asarray(relative @ np.swapaxes(relative, -1, -2) / samples)


def relative_covariances(
    edges: EdgeArrays, kernels: Kernels, poses: FloatArray, system: LinearSystem, pairs: NDArray[np.int64]
) -> FloatArray:
    """Covariances of X_i^-1 X_j, exact, shape (k, d, d), as twists in the frame of j: d columns are solved per pair.

    Raises:
        SingularSystemError: the edges leave a direction free.
    """
    d, f = system.block_size, system.free_nodes.size
    out = np.zeros((pairs.shape[0], d, d))
    if f == 0 or pairs.shape[0] == 0:
        return out
    pivot = residuals.pivot_of(edges.dim, poses)
    costs = edge_costs(edges, kernels, poses, "gtsam")
    _, blocks = normal_equations(edges, costs, poses, pivot, system, "gtsam")
    factors = system.factorise(blocks)
    to_node = residuals.world_to_node(edges.dim, poses, pivot)
    place = np.full(poses.shape[0], f)
    place[system.free_nodes] = np.arange(f)
    for first in range(0, pairs.shape[0], _PAIRS_AT_ONCE):
        i, j = pairs[first : first + _PAIRS_AT_ONCE].T
        k = np.arange(i.size)
        selected = np.zeros((f + 1, d, i.size, d))  # the last row is that of the fixed nodes
        at_j = np.swapaxes(to_node[j], -1, -2)
        selected[place[j], :, k] += at_j
        selected[place[i], :, k] -= at_j
        columns = selected[:f].reshape(f * d, i.size * d)
        solved = factors.solve(columns).reshape(f * d, i.size, d)
        P = np.einsum("aku,akv->kuv", columns.reshape(f * d, i.size, d), solved)
        out[first : first + i.size] = 0.5 * (P + np.swapaxes(P, -1, -2))
    return out
