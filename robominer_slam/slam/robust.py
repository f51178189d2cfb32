"""The back-end of the method `robust`: keyframes in, closures that agree with each other, an optimised graph out.

For each keyframe: its place is predicted from the last and the odometry between; earlier passes over that ground are
searched (`closure_search`); what passes every check waits until another closure of the last keyframes agrees with
it; then both enter the graph. After optimising, closures that the graph contradicts are taken back, and those that
it no longer contradicts return.

Sources: Mangelson et al., "Pairwise consistent measurement set maximization" (ICRA 2018) for agreement; Latif et
al., "Robust loop closing over time" (IJRR 2013) for taking closures back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.slam.closure_search import Closure, ClosureSearch, Patch
from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Keyframe
from robominer_slam.slam.keyframe_graph import KeyframeGraph, LevelEdge
from robominer_slam.slam.surface import SurfaceModel
from robominer_slam.slam.surface_registration import placed

FloatArray = NDArray[np.float64]

PLANAR = [0, 1, 5]
#: A patch of fewer touches is too small to be told from others.
LEAST_POINTS = 60
#: Least variance of an odometry edge in x, y (m2) and heading (rad2): a keyframe's instant is known to 5 ms or so.
EDGE_FLOOR = np.square([0.001, 0.001, 0.001])
#: Deviation of the height from one keyframe to the next, m, where the odometry does not say.
HEIGHT_WALK = 0.002
HEIGHT_SIGMA = 0.003
TILT_SIGMA = 0.005
#: A patch as a whole is about its middle: of the drift from its oldest to its newest keyframe it has half.
PATCH_SHARE = 0.5


class RobustBackend:
    """Takes keyframes one after the other; deterministic."""

    def __init__(self, parameters: RobustSlamSection) -> None:
        self._parameters = parameters
        s = parameters.surface
        self._search = ClosureSearch(
            parameters.closure, SurfaceModel(s.touch_sigma, s.curvature, s.slope_sigma, s.reach)
        )
        self._graph = KeyframeGraph()
        self._patches: dict[int, Patch] = {}
        self._tilts: dict[int, FloatArray] = {}
        self._pending: list[Closure] = []
        self._recent: list[Closure] = []
        self._last: Keyframe | None = None
        self._covariance = np.zeros((3, 3))
        self._version = 0
        self.log: list[Closure] = []

    def process(self, keyframe: Keyframe) -> BackendResult:
        """Add a keyframe, search for loop closures, optimise."""
        self._add_node(keyframe)
        accepted = self._agreed(self._found(keyframe)) if self._parameters.closure.enabled else []
        for closure in accepted:
            self._add_loop(closure)
        if accepted:
            self._optimise()
        self._update_covariance(keyframe.id)
        self._last = keyframe
        self._version += 1
        return self._result(keyframe, len(accepted))

    # ------------------------------------------------------------------------------------------------ nodes

    def _add_node(self, keyframe: Keyframe) -> None:
        level, tilt = levelled(keyframe.T_odom_base)
        points = voxel_filter(keyframe.floor_points @ tilt.T, self._parameters.point_voxel)
        k = keyframe.id
        self._patches[k] = Patch(points, keyframe.travelled)
        self._tilts[k] = tilt
        graph = self._graph
        if self._last is None:
            graph.poses[k], graph.heights[k] = level[:3], float(level[3])
            return
        last, _ = levelled(self._last.T_odom_base)
        Z = geometry.se2_compose(geometry.se2_inverse(last[:3]), level[:3])
        dz = float(level[3] - last[3])
        motion = keyframe.motion
        if motion is None:
            raise ValueError("the method needs the motion between keyframes; its odometry does not give it")
        nb = motion.bias.size if self._parameters.bias_unknown else 0
        covariance = motion.covariance[np.ix_(PLANAR, PLANAR)]
        if not nb:
            J = motion.bias_jacobian[PLANAR]
            covariance = covariance + J @ motion.bias_covariance @ J.T
        information = _inverse(covariance + np.diag(EDGE_FLOOR))
        edge = LevelEdge(
            "odometry",
            self._last.id,
            k,
            Z,
            information,
            dz,
            1.0 / HEIGHT_WALK**2,
            motion.bias_jacobian[PLANAR][:, :nb],
            motion.bias[:nb],
        )
        graph.edges.append(edge)
        posterior = motion.bias_posterior[:nb]
        # What the loops have taught of the biases stays; what the odometry has learned since is added.
        graph.bias = graph.bias + (posterior - graph.bias_prior) if graph.bias.size == nb else posterior.copy()
        graph.bias_prior = posterior
        graph.bias_prior_information = _inverse(motion.bias_covariance[:nb, :nb] + 1e-14 * np.eye(nb))
        step = geometry.se2_exp(edge.jacobian @ (graph.bias - edge.reference))
        graph.poses[k] = geometry.se2_compose(graph.poses[self._last.id], geometry.se2_compose(Z, step))
        graph.heights[k] = graph.heights[self._last.id] + dz

    def _source(self, keyframe: Keyframe) -> tuple[FloatArray, int]:
        """Touches of the last keyframes, in the level frame of the newest, and the id of the oldest."""
        parts, oldest = [], keyframe.id
        for k in range(keyframe.id, -1, -1):
            patch = self._patches.get(k)
            if patch is None or keyframe.travelled - patch.travelled >= self._parameters.closure.patch:
                break
            pose = self._graph.relative(keyframe.id, k)
            dz = self._graph.heights[k] - self._graph.heights[keyframe.id]
            parts.append(placed(patch.points, np.append(pose, dz)))
            oldest = k
        return np.concatenate(parts), oldest

    # --------------------------------------------------------------------------------------------- closures

    def _found(self, keyframe: Keyframe) -> list[Closure]:
        """Closures of a keyframe that pass every check of their own."""
        source, oldest = self._source(keyframe)
        if len(source) < LEAST_POINTS:
            return []
        k, graph = keyframe.id, self._graph
        sigma = float(np.sqrt(np.linalg.eigvalsh(self._predicted_covariance()[:2, :2])[-1]))
        reach = self._parameters.closure.sigmas * sigma
        found = []
        for ids in self._search.passes(k, self._patches, graph.poses, reach):
            anchor = min(ids, key=lambda i: float(np.hypot(*graph.relative(i, k)[:2])))
            covariance = graph.relative_covariance(anchor, k)
            closure = self._search.find(
                source,
                k,
                ids,
                self._patches,
                graph.poses,
                graph.heights[k] - graph.heights[anchor],
                graph.relative(anchor, k),
                covariance,
                PATCH_SHARE * self._between(oldest, k),
                anchor,
            )
            if closure is not None:
                self.log.append(closure)
                if closure.good:
                    found.append(closure)
        return found

    def _predicted_covariance(self) -> FloatArray:
        """Of the newest keyframe in its own frame: the last one's, grown by the odometry since."""
        edge = self._graph.edges[-1] if self._graph.edges else None
        if edge is None:
            return self._covariance
        Ad = geometry.se2_adjoint(geometry.se2_inverse(edge.Z))
        grown: FloatArray = Ad @ self._covariance @ Ad.T + _inverse(edge.information)
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
            partners = [c for c in others if self._agree(c, closure)]
            if len(partners) >= p.partners:
                accepted.append(closure)
                accepted += [c for c in partners if any(c is w for w in self._pending)]
                self._pending = [c for c in self._pending if not any(c is a for a in accepted)]
            else:
                self._pending.append(closure)
        self._recent += accepted
        return accepted

    def _agree(self, a: Closure, b: Closure) -> bool:
        """Whether two closures say the same of the way between their keyframes."""
        graph = self._graph
        # b predicted through a: anchor of b -> anchor of a -> keyframe of a -> keyframe of b.
        way = geometry.se2_compose(geometry.se2_compose(graph.relative(b.i, a.i), a.Z), graph.relative(a.j, b.j))
        error = geometry.se2_log(geometry.se2_compose(geometry.se2_inverse(way), b.Z))
        Ad = geometry.se2_adjoint(graph.relative(b.j, a.j))
        covariance = Ad @ a.covariance @ Ad.T + b.covariance + self._between(a.j, b.j)
        if a.i != b.i:
            covariance = covariance + self._between(a.i, b.i)
        return float(error @ np.linalg.solve(covariance, error)) <= self._parameters.closure.agreement

    def _between(self, a: int, b: int) -> FloatArray:
        """Covariance of the odometry between two keyframes, summed along the way; as of steps, arms left out."""
        low, high = min(a, b), max(a, b)
        steps = [e for e in self._graph.edges if e.kind == "odometry" and low < e.j <= high]
        total: FloatArray = sum((_inverse(e.information) for e in steps), np.zeros((3, 3)))
        return total

    def _add_loop(self, closure: Closure) -> None:
        nb = self._graph.bias.size
        information = _inverse(closure.covariance)
        self._graph.edges.append(
            LevelEdge(
                "loop",
                closure.i,
                closure.j,
                closure.Z,
                information,
                closure.dz,
                1.0 / HEIGHT_SIGMA**2,
                np.zeros((3, nb)),
                np.zeros(nb),
            )
        )

    # -------------------------------------------------------------------------------------------- optimising

    def _optimise(self) -> None:
        """Optimise; take back what the optimum contradicts, let return what it no longer does; until that settles."""
        limit = self._parameters.closure.take_back
        for _ in range(4):
            self._graph.optimise()
            loops = [e for e in self._graph.edges if e.kind == "loop"]
            worst = max((e for e in loops if e.enabled), key=lambda e: e.chi2, default=None)
            changed = False
            if worst is not None and worst.chi2 > limit:
                for edge in loops:
                    if edge.enabled and edge.chi2 > max(limit, 0.5 * worst.chi2):
                        edge.enabled, changed = False, True
            else:
                for edge in loops:
                    if not edge.enabled and edge.chi2 <= 0.5 * limit:
                        edge.enabled, changed = True, True
            if not changed:
                return
        self._graph.optimise()

    def _update_covariance(self, k: int) -> None:
        if self._last is None:
            return
        self._covariance = self._graph.covariance([k])

    # ------------------------------------------------------------------------------------------------ result

    def _result(self, keyframe: Keyframe, closures: int) -> BackendResult:
        graph = self._graph
        ids = sorted(graph.poses)
        poses = np.array([self._pose(k) for k in ids])
        pose = poses[-1]
        yaw = graph.poses[keyframe.id][2]
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return BackendResult(
            keyframe=keyframe,
            T_map_odom=geometry.normalise_pose(pose @ geometry.inverse(keyframe.T_odom_base)),
            poses=poses,
            covariance=R @ self._covariance @ R.T,
            edges=tuple(self._published(e) for e in graph.edges),
            closures=closures,
            version=self._version,
        )

    def _pose(self, k: int) -> FloatArray:
        T = geometry.T_from_xyyaw(self._graph.poses[k])
        T[2, 3] = self._graph.heights[k]
        T[:3, :3] = T[:3, :3] @ self._tilts[k]
        return T

    def _published(self, edge: LevelEdge) -> GraphEdge:
        T = geometry.T_from_xyyaw(edge.Z)
        T[2, 3] = edge.dz
        # From level frames to the keyframes' own.
        R_i, R_j = np.eye(4), np.eye(4)
        R_i[:3, :3], R_j[:3, :3] = self._tilts[edge.i], self._tilts[edge.j]
        information = np.diag([0.0, 0.0, edge.dz_information, TILT_SIGMA**-2, TILT_SIGMA**-2, 0.0])
        information[np.ix_(PLANAR, PLANAR)] = edge.information
        return GraphEdge(edge.kind, edge.i, edge.j, R_i.T @ T @ R_j, information, 1.0 if edge.enabled else 0.0)


def levelled(T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A pose as x, y, heading, z, shape (4,), and the tilt R with R_map_base = R_z(heading) R, shape (3, 3)."""
    yaw = float(np.arctan2(T[1, 0], T[0, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    R_yaw = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.array([T[0, 3], T[1, 3], yaw, T[2, 3]]), R_yaw.T @ T[:3, :3]


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a covariance or an information matrix, symmetric to the bit."""
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return 0.5 * (inverse + inverse.T)
