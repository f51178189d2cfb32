"""The back-end of the method `robust`: keyframes in, closures that agree with each other, an optimised graph out.

For each keyframe: its place is predicted from the last and the odometry between; earlier passes over that ground are
searched (`closure_search`); what passes every check waits until another closure of the last keyframes agrees with
it; then both enter the graph. After optimising, closures that the graph contradicts are taken back, and those that
it no longer contradicts return. Closures that agree with the present estimate move its last keyframes only; what the
map keeps is bounded (`bounded_map`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.slam import taking_back
from robominer_slam.slam.bias_walk import BiasWalk
from robominer_slam.slam.bounded_map import BoundedMap
from robominer_slam.slam.closure_agreement import agreeing
from robominer_slam.slam.closure_counters import ClosureCounters
from robominer_slam.slam.closure_search import Closure, ClosureSearch
from robominer_slam.slam.graph_marginals import TrackedCovariance
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.keyframe_edges import loop_edge, motion_of, odometry_edge, symmetric_inverse
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.patch import Patch, patch_of
from robominer_slam.slam.patch_memory import PatchMemory, PatchPages
from robominer_slam.slam.published_edges import PublishedEdges
from robominer_slam.slam.surface import SurfaceModel
from robominer_slam.slam.surface_registration import placed

FloatArray = NDArray[np.float64]

#: A patch of fewer touches is too small to be told from others.
LEAST_POINTS = 60
#: A patch as a whole is about its middle: of the drift from its oldest to its newest keyframe it has half.
PATCH_SHARE = 0.5


class RobustBackend:
    """Takes keyframes one after the other; deterministic. Use, and `release`, in one thread.

    Args:
        parameters: with units and reasons there.
        pages: where touches go that do not fit into memory; None keeps all there.

    Attributes:
        closures: counts of the closures found, and the last of them.
    """

    def __init__(self, parameters: RobustSlamSection, pages: PatchPages | None = None) -> None:
        self._parameters = parameters
        bounds = parameters.bounds
        self._search = ClosureSearch(parameters.closure, SurfaceModel.of(parameters.surface))
        self._graph = KeyframeGraph()
        self._patches = PatchMemory(bounds.max_points_in_memory, pages)
        self._map = BoundedMap(bounds, self._graph, self._patches)
        self._tracked = TrackedCovariance(self._graph, bounds.refresh)
        self._walk = BiasWalk()
        self._bias_covariance = np.zeros((0, 0))
        self._published = PublishedEdges()
        self._since_full = 0
        self._searched = self._closed = -1
        self._pending: list[Closure] = []
        self._recent: list[Closure] = []
        self._last: Keyframe | None = None
        self._covariance = np.zeros((3, 3))
        self._predicted = np.zeros((3, 3))
        self._version = 0
        self.closures = ClosureCounters()

    def process(self, keyframe: Keyframe) -> BackendResult:
        """Add a keyframe, search for loop closures, optimise."""
        self._map.begin(keyframe.id, keyframe.floor is None or bool(keyframe.floor.all()))
        self._add_node(keyframe)
        searched = keyframe.searched and self._is_searched(keyframe.id)
        accepted = self._agreed(self._found(keyframe)) if searched else []
        for closure in accepted:
            self._graph.edges.append(loop_edge(closure, self._graph.bias.size))
        if accepted:
            self._optimise(accepted)
        self._bound(keyframe.id, int(searched) + int(self._tracked.is_laborious))
        if self._last is not None:
            self._covariance = self._tracked.of_newest()
        self._last = keyframe
        self._version += 1
        return self._result(keyframe, len(accepted))

    def _add_node(self, keyframe: Keyframe) -> None:
        level, tilt = geometry.levelled(keyframe.T_odom_base)
        k = keyframe.id
        self._patches[k] = patch_of(keyframe, tilt, self._parameters.point_voxel)
        graph = self._graph
        if self._last is None:
            graph.nodes.append(k, level[:3], float(level[3]), tilt, keyframe.travelled)
            return
        motion = motion_of(keyframe)
        nb = motion.bias.size if self._parameters.bias_unknown else 0
        walk = None if motion.bias_walk is None else motion.bias_walk[:nb, :nb]
        self._walk.step(graph.edges, graph.bias, self._bias_covariance, walk)
        self._bias_covariance = motion.bias_covariance[:nb, :nb]
        edge = odometry_edge(self._last, keyframe, nb)
        graph.edges.append(edge)
        if len(graph.nodes) <= self._parameters.bounds.local_window:
            self._tracked.forget()
        posterior = motion.bias_posterior[:nb]
        # What the loops have taught of the biases stays; what the odometry has learned since is added.
        graph.bias = graph.bias + (posterior - graph.bias_prior) if graph.bias.size == nb else posterior.copy()
        graph.bias_prior = posterior
        graph.bias_prior_information = symmetric_inverse(motion.bias_covariance[:nb, :nb] + 1e-14 * np.eye(nb))
        step = geometry.se2_exp(edge.jacobian @ (graph.bias - edge.reference))
        pose = geometry.se2_compose(graph.nodes[self._last.id], geometry.se2_compose(edge.Z, step))
        graph.nodes.append(k, pose, graph.nodes.height(self._last.id) + edge.dz, tilt, keyframe.travelled)
        self._tracked.follow(edge, graph.bias, walk)

    def _source(self, keyframe: Keyframe) -> tuple[Patch, int]:
        """Touches of the last keyframes, in the level frame of the newest, and the id of the oldest."""
        parts, walls, oldest = [], [], keyframe.id
        for k in range(keyframe.id, -1, -1):
            patch = self._patches.get(k)
            if patch is None or keyframe.travelled - patch.travelled >= self._parameters.closure.patch:
                break
            pose = self._graph.relative(keyframe.id, k)
            dz = self._graph.nodes.height(k) - self._graph.nodes.height(keyframe.id)
            parts.append(placed(patch.points, np.append(pose, dz)))
            walls.append(placed(patch.walls, np.append(pose, dz)))
            oldest = k
        return Patch(np.concatenate(parts), keyframe.travelled, np.concatenate(walls)), oldest

    def _is_searched(self, key: int) -> bool:
        """Whether closures are searched at all, and this keyframe's turn has come."""
        if not self._parameters.closure.enabled:
            return False
        return key - self._searched >= self._parameters.bounds.sure_spacing or not self._is_sure(key)

    def _is_sure(self, key: int) -> bool:
        """Whether one closure now and then will do: the graph is large, and a closure has just held it here."""
        bounds = self._parameters.bounds
        return len(self._graph.nodes) > bounds.small_map and key - self._closed <= bounds.sure_span

    def _chosen(self, key: int, passes: list[list[int]]) -> list[list[int]]:
        """Passes to match with: all in a small map; else one, the nearest or, where that may not do, each in turn."""
        if len(self._graph.nodes) <= self._parameters.bounds.small_map or len(passes) < 2:
            return passes
        return passes[:1] if self._is_sure(key) else [passes[key % len(passes)]]

    def _found(self, keyframe: Keyframe) -> list[Closure]:
        """Closures of a keyframe that pass every check of their own."""
        self._searched = keyframe.id
        source, oldest = self._source(keyframe)
        if len(source.points) < LEAST_POINTS:
            return []
        k, graph, nodes = keyframe.id, self._graph, self._graph.nodes
        sigma = float(np.sqrt(np.linalg.eigvalsh(self._predicted_covariance()[:2, :2])[-1]))
        reach = self._parameters.closure.sigmas * sigma
        found = []
        self._predicted = np.zeros((3, 3))
        for ids in self._chosen(k, self._search.passes(k, self._outlines(reach), nodes, reach)):
            off = nodes.poses[nodes.rows(ids), :2] - nodes.poses[-1, :2]
            anchor = ids[int(np.argmin(np.hypot(off[:, 0], off[:, 1])))]
            covariance = self._tracked.relative(anchor)
            self._predicted = max(self._predicted, covariance, key=lambda P: float(np.trace(P[:2, :2])))
            closure = self._search.find(
                source,
                k,
                ids,
                self._patches,
                nodes,
                nodes.height(k) - nodes.height(anchor),
                graph.relative(anchor, k),
                covariance,
                PATCH_SHARE * graph.odometry_between(oldest, k),
                anchor,
            )
            if closure is not None:
                self.closures.found(closure, self._parameters.closure)
                if closure.good:
                    found.append(closure)
        return found

    def _outlines(self, reach: float) -> dict[int, Patch]:
        """Ways, without the touches, of the keyframes that `passes` may choose from, and of the newest."""
        p, nodes = self._parameters.closure, self._graph.nodes
        near = nodes.mapped & (nodes.travelled <= nodes.travelled[-1] - p.min_travel)
        near &= np.hypot(*(nodes.poses[:, :2] - nodes.poses[-1, :2]).T) <= p.target_radius + reach
        near[-1] = True
        nothing = np.zeros((0, 3))
        return {
            int(k): Patch(nothing, float(way)) for k, way in zip(nodes.ids[near], nodes.travelled[near], strict=True)
        }

    def _predicted_covariance(self) -> FloatArray:
        """Of the newest keyframe in its own frame: the last one's, grown by the odometry since."""
        edges = self._graph.edges
        if not len(edges):
            return self._covariance
        Ad = geometry.se2_adjoint(geometry.se2_inverse(edges.Z[-1]))
        grown: FloatArray = Ad @ self._covariance @ Ad.T + edges.covariance[-1]
        return grown

    def _agreed(self, found: list[Closure]) -> list[Closure]:
        """Closures that now have partners enough: new ones, and those that waited for them."""
        p = self._parameters.closure
        if not found:
            return []
        newest = found[0].j
        self._pending = [c for c in self._pending if newest - c.j <= p.partner_span]
        self._recent = [c for c in self._recent if newest - c.j <= p.partner_span]
        accepted: list[Closure] = []
        for closure in found:
            others = [c for c in (*self._recent, *self._pending) if c.j != closure.j]
            partners = agreeing(self._graph, others, closure, p.agreement)
            if len(partners) >= p.partners:
                accepted.append(closure)
                accepted += [c for c in partners if any(c is w for w in self._pending)]
                self._pending = [c for c in self._pending if not any(c is a for a in accepted)]
            else:
                self._pending.append(closure)
        self._recent += accepted
        return accepted

    def _optimise(self, accepted: list[Closure]) -> None:
        """Optimise as much of the graph as the new closures ask for."""
        bounds, graph = self._parameters.bounds, self._graph
        self.closures.counts["accepted"] += len(accepted)
        self._closed = max(closure.j for closure in accepted)
        self._since_full += 1
        large = self._since_full >= bounds.full_every or any(self._is_far(closure) for closure in accepted)
        if not large and len(graph.nodes) > bounds.local_window:
            graph.optimise_window(bounds.local_window)
            edges = graph.edges
            limit = taking_back.limit(edges, self._parameters.closure.take_back)
            if not (edges.loop & edges.enabled & (edges.chi2 > limit)).any():
                self._tracked.closed(len(accepted), self._predicted, self._parameters.closure.max_sigma)
                return
        self._since_full = 0
        self._optimise_whole()
        self._tracked.forget()

    def _optimise_whole(self) -> None:
        taking_back.optimise(self._graph, self._parameters.closure.take_back, self.closures)

    def _is_far(self, closure: Closure) -> bool:
        """Whether a closure moves its keyframe by more than the last keyframes can take."""
        bounds = self._parameters.bounds
        off = geometry.se2_compose(geometry.se2_inverse(self._graph.relative(closure.i, closure.j)), closure.Z)
        moved, turned = float(np.hypot(off[0], off[1])), abs(float(off[2]))
        return moved > bounds.local_distance or turned > np.deg2rad(bounds.local_angle_deg)

    def _bound(self, newest: int, load: int) -> None:
        """Let go of touches and keyframes that are too many."""
        p = self._parameters.closure
        self._map.settle(newest, p.patch, p.partner_span, p.min_travel)
        if self._map.shrink(load):
            nodes = self._graph.nodes
            self._pending = [c for c in self._pending if c.i in nodes and c.j in nodes]
            self._recent = [c for c in self._recent if c.i in nodes and c.j in nodes]
            self._tracked.shrunk()

    def release(self) -> None:
        """Let go of what must be freed in the thread that made it."""
        self._tracked.forget()

    def _result(self, keyframe: Keyframe, closures: int) -> BackendResult:
        nodes = self._graph.nodes
        poses = geometry.T_from_xyyaw(nodes.poses)
        poses[:, 2, 3] = nodes.heights
        poses[:, :3, :3] = poses[:, :3, :3] @ nodes.tilts
        yaw = nodes.poses[-1, 2]
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._published.follow(self._graph.edges, nodes)
        return BackendResult(
            keyframe=keyframe,
            T_map_odom=geometry.normalise_pose(poses[-1] @ geometry.inverse(keyframe.T_odom_base)),
            poses=poses,
            covariance=R @ self._covariance @ R.T,
            edges=tuple(self._published.edges),
            closures=closures,
            version=self._version,
            ids=tuple(nodes.ids.tolist()),
            added=tuple(self._published.added),
            dropped=tuple(self._published.dropped),
            removed=tuple(self._map.removed),
            merged=tuple(self._map.merged),
            bare=tuple(self._map.bare),
            counts={
                **{f"closures.{name}": count for name, count in self.closures.counts.items()},
                "loose_bridges": self._graph.loose_bridges,
                "points.in_memory": self._patches.points_in_memory,
                "points.fetched": self._patches.fetched,
            },
        )
