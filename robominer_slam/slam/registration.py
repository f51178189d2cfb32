"""Scan registration by small_gicp, and the fitness that hdl_graph_slam judges a match by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import small_gicp
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Matcher = Literal["ICP", "PLANE_ICP", "GICP", "VGICP"]

NEIGHBOURS = 10
#: small_gicp's default; matches that need more are false nearly always.
MAX_ITERATIONS = 20


class ScanTarget:
    """A keyframe's points prepared once: covariances, normals, tree, and the voxel map where the matcher needs one.

    Args:
        points: shape (m, 3), m.
        matcher: which of small_gicp's matchers will be used.
        resolution: of VGICP's voxels, m.
    """

    def __init__(self, points: FloatArray, matcher: Matcher, resolution: float) -> None:
        self.points = points
        self.cloud = small_gicp.PointCloud(points)
        self.tree = small_gicp.KdTree(self.cloud, num_threads=1)
        small_gicp.estimate_normals_covariances(self.cloud, self.tree, NEIGHBOURS, 1)
        self.voxels = None
        if matcher == "VGICP":
            self.voxels = small_gicp.GaussianVoxelMap(resolution)
            self.voxels.insert(self.cloud)


@dataclass(frozen=True, slots=True)
class Match:
    """Result of a registration.

    Attributes:
        T_target_source: shape (4, 4).
        fitness: mean squared distance from each source point to its nearest target point, m2.
        converged: as the matcher says.
        H: its Hessian, shape (6, 6); the eigenvalues tell which directions the ground constrains.
    """

    T_target_source: FloatArray
    fitness: float
    converged: bool
    H: FloatArray


def register(
    target: ScanTarget, source: ScanTarget, guess: FloatArray, matcher: Matcher, correspondence_distance: float
) -> Match:
    """Match two scans from a first guess T_target_source, shape (4, 4).

    Source: Koide, small_gicp (JOSS 2024), single-threaded so that results repeat bit for bit.
    """
    common = {
        "init_T_target_source": guess,
        "max_correspondence_distance": correspondence_distance,
        "num_threads": 1,
        "max_iterations": MAX_ITERATIONS,
    }
    if matcher == "VGICP":
        result = small_gicp.align(target.voxels, source.cloud, **common)
    else:
        result = small_gicp.align(target.cloud, source.cloud, target.tree, registration_type=matcher, **common)
    T = np.asarray(result.T_target_source, dtype=np.float64)
    return Match(T, fitness(target, source.points, T), bool(result.converged), np.asarray(result.H))


def fitness(target: ScanTarget, source_points: FloatArray, T_target_source: FloatArray) -> float:
    """Mean squared distance to the nearest target point over all source points, m2 (hdl_graph_slam's score)."""
    moved = source_points @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    _, squared = target.tree.batch_nearest_neighbor_search(moved, num_threads=1)
    return float(np.mean(squared))
