"""Covariances of a pose graph's nodes, from the inverse of the normal equations at the present poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robominer_slam.geometry import FloatArray
from robominer_slam.slam import pose_graph_residuals as residuals
from robominer_slam.slam.pose_graph_optimizer import Kernels, edge_costs, normal_equations
from robominer_slam.slam.pose_graph_residuals import EdgeArrays
from robominer_slam.slam.pose_graph_system import SystemPattern


def joint_covariance(
    edges: EdgeArrays, kernels: Kernels, poses: FloatArray, system: SystemPattern, nodes: Sequence[int]
) -> FloatArray:
    """Joint covariance of chosen nodes, shape (k d, k d), each as a twist in its own frame; 0 for fixed nodes.

    Only the columns of these nodes are solved for. Edges count with the weights of their kernels.

    Raises:
        SingularSystemError: the edges leave a direction free.
    """
    d, k, f = system.block_size, len(nodes), system.free_nodes.size
    if f == 0:
        return np.zeros((k * d, k * d))
    pivot = residuals.positions(edges.dim, poses).mean(axis=0)
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
