"""The thesis's back-end: hdl_graph_slam with composite whisker scans, re-made.

For each new keyframe: keyframes within 0.75 m (estimated positions, x and y) that were made at least `min_travel`
of driving ago are candidates, unless a closure was added less than `closure_spacing` of driving ago; each is matched
from the current estimate; the one with the best fitness becomes a loop edge if its fitness is under 0.016 m2. Then
the whole graph is optimised. Sources: Nagel 2021, section 3.4.4; Koide et al. 2019, doi 10.1177/1729881419841532.
It accepts nearly every false pair (field trials in docs/slam.md): it is kept as the baseline.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.model import ThesisSection
from robominer_slam.slam.fitness_information import information_from_fitness
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe
from robominer_slam.slam.pose_graph import EdgeKind, PoseGraph
from robominer_slam.slam.registration import Match, ScanTarget, fitness, register
from robominer_slam.slam.robust_kernels import KernelName

FloatArray = NDArray[np.float64]

#: A scan of fewer points has no covariances worth the name: it becomes a keyframe, but is never matched.
MIN_POINTS = 20
KERNEL_WIDTH = 1.0


class ThesisBackend:
    """Keyframes in, optimised graph out; deterministic."""

    def __init__(self, parameters: ThesisSection) -> None:
        self._parameters = parameters
        self._graph = PoseGraph(dim=3)
        self._keyframes: list[Keyframe] = []
        self._targets: list[ScanTarget | None] = []
        self._edges: list[GraphEdge] = []
        self._poses = np.zeros((0, 4, 4))
        self._last_closure_travelled = -np.inf
        self._version = 0

    def process(self, keyframe: Keyframe) -> BackendResult:
        """Add a keyframe, search for a loop closure, optimise."""
        parameters = self._parameters
        target = None
        if len(keyframe.points) >= MIN_POINTS:
            target = ScanTarget(keyframe.points, parameters.matcher, parameters.resolution)
        if self._keyframes:
            last = self._keyframes[-1]
            T_last_new = geometry.inverse(last.T_odom_base) @ keyframe.T_odom_base
            T_map_new = self._poses[-1] @ T_last_new
            self._add_node(keyframe, target, T_map_new)
            self._add_edge("odometry", len(self._keyframes) - 2, T_last_new, self._odometry_information(T_last_new))
        else:
            self._add_node(keyframe, target, keyframe.T_odom_base)
        closures = 0
        found = self._search(keyframe, target) if keyframe.searched else None
        if found is not None:
            candidate, match = found
            self._add_edge("loop", candidate, match.T_target_source, information_from_fitness(match.fitness))
            self._last_closure_travelled = keyframe.travelled
            closures = 1
            self._optimise()
        self._version += 1
        pose = self._poses[-1]
        return BackendResult(
            keyframe=keyframe,
            T_map_odom=geometry.normalise_pose(pose @ geometry.inverse(keyframe.T_odom_base)),
            poses=self._poses.copy(),
            covariance=self._covariance(),
            edges=tuple(self._edges),
            closures=closures,
            version=self._version,
        )

    def _add_node(self, keyframe: Keyframe, target: ScanTarget | None, T_map_new: FloatArray) -> None:
        self._graph.add_node(T_map_new)
        self._keyframes.append(keyframe)
        self._targets.append(target)
        self._poses = np.concatenate([self._poses, T_map_new[None]])

    def _add_edge(self, kind: EdgeKind, i: int, T_i_new: FloatArray, information: FloatArray) -> None:
        j = len(self._keyframes) - 1
        kernel: KernelName = "none" if kind == "odometry" else self._parameters.kernel
        self._graph.add_edge(i, j, T_i_new, information, kind=kind, kernel=kernel, kernel_width=KERNEL_WIDTH)
        self._edges.append(GraphEdge(kind, i, j, T_i_new, information, 1.0))

    def _odometry_information(self, T_last_new: FloatArray) -> FloatArray:
        """Constant, or as hdl_graph_slam: from the fitness of neighbouring scans laid upon each other by odometry."""
        if self._parameters.odometry_sigma > 0.0:
            return np.eye(6) / self._parameters.odometry_sigma**2
        last, new = self._targets[-2], self._targets[-1]
        if last is None or new is None:
            return information_from_fitness(0.0)
        return information_from_fitness(fitness(last, new.points, T_last_new))

    def _search(self, keyframe: Keyframe, source: ScanTarget | None) -> tuple[int, Match] | None:
        parameters = self._parameters
        if source is None or keyframe.travelled - self._last_closure_travelled < parameters.closure_spacing:
            return None
        T_map_new = self._poses[-1]
        distance = np.hypot(*(self._poses[:-1, :2, 3] - T_map_new[:2, 3]).T)
        best: tuple[int, Match] | None = None
        for candidate in np.flatnonzero(distance <= parameters.search_radius):
            target = self._targets[candidate]
            travelled = keyframe.travelled - self._keyframes[candidate].travelled
            if target is None or travelled < parameters.min_travel:
                continue
            guess = geometry.inverse(self._poses[candidate]) @ T_map_new
            # hdl_graph_slam starts every match at equal height.
            guess[2, 3] = 0.0
            match = register(target, source, guess, parameters.matcher, parameters.correspondence_distance)
            if match.converged and (best is None or match.fitness < best[1].fitness):
                best = int(candidate), match
        if best is None or best[1].fitness >= parameters.max_fitness:
            return None
        return best

    def _optimise(self) -> None:
        result = self._graph.optimize()
        self._poses = np.array(self._graph.poses)
        self._edges = [
            GraphEdge(edge.kind, edge.i, edge.j, edge.T_i_j, edge.information, float(weight))
            for edge, weight in zip(self._edges, result.weights, strict=True)
        ]

    def _covariance(self) -> FloatArray:
        """Of the newest keyframe's (x, y, yaw) in map, shape (3, 3)."""
        if len(self._keyframes) == 1:
            return np.zeros((3, 3))
        covariance = self._graph.marginal_covariance([len(self._keyframes) - 1])[0]
        pick = [0, 1, 5]
        # The graph's tangent space is the keyframe's own frame; published is the map frame.
        R = np.eye(3)
        R[:2, :2] = self._poses[-1][:2, :2]
        in_map: FloatArray = R @ covariance[np.ix_(pick, pick)] @ R.T
        return in_map
