"""Pose graphs for the tests: made ones, the public ones' optima, and the same problem for GTSAM."""

from __future__ import annotations

import numpy as np
import pytest

from robominer_slam import geometry as g
from robominer_slam.slam.pose_graph import PoseGraph

#: Optima of the public data sets: (full SE(n) log, g2o's convention), from their README.
PUBLIC_OPTIMA = {
    "noisyToyGraph.txt": (0.136685648, 0.13665202),
    "tinyGrid3D.g2o": (18.6278189, 6.7278816),
    "smallGrid3D.g2o": (1035.85066, 458.15378),
    "MIT.g2o": (770.238984, 770.6635),
    "intel.g2o": (45.0042331, 45.004696),
    "M3500.g2o": (137.914878, 137.91295),
    "sphere2500.g2o": (1351.40193, 727.14967),
}
#: GTSAM puts rotation first.
ROTATION_FIRST = [3, 4, 5, 0, 1, 2]


def exp(dim, xi):
    return g.se2_exp(xi) if dim == 2 else g.se3_exp(xi)


def log(dim, pose):
    return g.se2_log(pose) if dim == 2 else g.se3_log(pose)


def compose(dim, a, b):
    return g.se2_compose(a, b) if dim == 2 else a @ b


def invert(dim, a):
    return g.se2_inverse(a) if dim == 2 else g.inverse(a)


def random_information(rng, count, d):
    A = rng.normal(size=(count, d, d))
    return 50.0 * (A @ np.swapaxes(A, 1, 2) + np.eye(d))


def ring(noise: float = 0.05, seed: int = 0, turns: int = 2, per_turn: int = 20) -> PoseGraph:
    """Two rounds of a planar circle; the second round sees the first."""
    rng = np.random.default_rng(seed)
    n = turns * per_turn
    step = np.array([0.5, 0.0, 2.0 * np.pi / per_turn])
    graph = PoseGraph(2)
    pose = np.zeros(3)
    graph.add_node(pose)
    for k in range(1, n):
        measured = g.se2_exp(step + noise * rng.normal(size=3) * [1.0, 1.0, 0.3])
        pose = g.se2_compose(pose, measured)
        graph.add_node(pose)
        graph.add_edge(k - 1, k, measured, np.diag([400.0, 400.0, 4000.0]))
        if k >= per_turn:
            graph.add_edge(k - per_turn, k, g.se2_exp(0.02 * rng.normal(size=3)), 2500.0 * np.eye(3), kind="loop")
    return graph


def grid_3d(noise: float = 0.1, seed: int = 0, side: int = 4) -> PoseGraph:
    """A snake through a cube of poses with random attitudes; edges to all neighbours, poses from odometry."""
    rng = np.random.default_rng(seed)
    cells = [
        (x, y if x % 2 == 0 else side - 1 - y, z if (x * side + y) % 2 == 0 else side - 1 - z)
        for x in range(side) for y in range(side) for z in range(side)
    ]  # fmt: skip
    truth = g.pose_matrix(np.array(cells, dtype=float), rng.normal(size=(len(cells), 4)))
    sigma = noise * np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    information = np.diag(1.0 / sigma**2)
    graph = PoseGraph(3)
    pose = truth[0]
    graph.add_node(pose)
    for k in range(1, len(cells)):
        measured = g.inverse(truth[k - 1]) @ truth[k] @ g.se3_exp(sigma * rng.normal(size=6))
        pose = pose @ measured
        graph.add_node(pose)
        graph.add_edge(k - 1, k, measured, information)
        for j in range(k - 1):
            if np.abs(np.subtract(cells[j], cells[k])).sum() == 1:
                loop = g.inverse(truth[j]) @ truth[k] @ g.se3_exp(sigma * rng.normal(size=6))
                graph.add_edge(j, k, loop, information, kind="loop")
    return graph


MADE_GRAPHS = {"ring": ring, "grid_3d": grid_3d}


def import_gtsam():
    """The oracle; it has wheels for x86-64 only."""
    return pytest.importorskip("gtsam", reason="GTSAM, the oracle here, is not installed")


def gtsam_problem(graph: PoseGraph):
    """The same graph for GTSAM, first pose fixed by an equality."""
    gtsam = import_gtsam()
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose_of = (lambda p: gtsam.Pose2(*p)) if graph.dim == 2 else gtsam.Pose3
    between = gtsam.BetweenFactorPose2 if graph.dim == 2 else gtsam.BetweenFactorPose3
    equal = gtsam.NonlinearEqualityPose2 if graph.dim == 2 else gtsam.NonlinearEqualityPose3
    for k, pose in enumerate(graph.poses):
        values.insert(k, pose_of(pose))
    for (i, j), Z, Omega in zip(
        graph.edge_nodes.tolist(), graph.edge_measurements, graph.edge_information, strict=True
    ):
        ordered = Omega if graph.dim == 2 else Omega[np.ix_(ROTATION_FIRST, ROTATION_FIRST)]
        factors.add(between(i, j, pose_of(Z), gtsam.noiseModel.Gaussian.Information(ordered)))
    chi2 = gtsam.NonlinearFactorGraph(factors)
    factors.add(equal(0, pose_of(graph.poses[0])))
    return factors, values, chi2


def gtsam_optimum(graph: PoseGraph):
    gtsam = import_gtsam()
    factors, values, chi2 = gtsam_problem(graph)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-14)
    optimum = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    at = optimum.atPose2 if graph.dim == 2 else optimum.atPose3
    if graph.dim == 2:
        poses = np.array([[at(k).x(), at(k).y(), at(k).theta()] for k in range(graph.node_count)])
    else:
        poses = np.stack([at(k).matrix() for k in range(graph.node_count)])
    return poses, 2.0 * chi2.error(optimum), (factors, optimum)
