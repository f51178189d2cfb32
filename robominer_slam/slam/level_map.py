"""A known map in the method's own terms: level poses, heights, tilts, touches and edges of its keyframes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from robominer_slam import geometry
from robominer_slam.slam.keyframe import GraphEdge
from robominer_slam.slam.keyframe_nodes import KeyframeNodes
from robominer_slam.slam.level_edges import LevelEdge
from robominer_slam.slam.patch import Patch, patch_of
from robominer_slam.slam.published_edges import PLANAR
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.slam.surface_registration import placed

FloatArray = NDArray[np.float64]

#: Sigmas of an edge that stands for one that is missing: x, y (m), heading (rad); and of its height, m.
CHAIN_SIGMAS = (0.1, 0.1, 0.1)
CHAIN_HEIGHT_SIGMA = 0.02


@dataclass
class LevelMap:
    """What is known of a map.

    Attributes:
        poses: x, y (m), heading (rad) of each keyframe in map, by id.
        heights: of each, m.
        tilts: R of each with R_map_base = R_z(heading) R, shape (3, 3).
        travelled: way driven up to each, m.
        patches: touches of those that have any, in their level frames.
        edges: between them.
    """

    poses: dict[int, FloatArray] = field(default_factory=dict)
    heights: dict[int, float] = field(default_factory=dict)
    tilts: dict[int, FloatArray] = field(default_factory=dict)
    travelled: dict[int, float] = field(default_factory=dict)
    patches: dict[int, Patch] = field(default_factory=dict)
    edges: list[LevelEdge] = field(default_factory=list)

    def touches(self) -> FloatArray:
        """All touches in map, shape (n, 3), m."""
        parts = [placed(p.points, np.append(self.poses[k], self.heights[k])) for k, p in self.patches.items()]
        return np.concatenate(parts) if parts else np.zeros((0, 3))

    def nearest(self, xy: FloatArray) -> int:
        """Id of the keyframe nearest to a place in map, m."""
        ids = list(self.poses)
        distance = np.hypot(*(np.array([self.poses[k][:2] for k in ids]) - xy).T)
        return ids[int(np.argmin(distance))]

    def nodes(self, shift: float) -> KeyframeNodes:
        """As nodes of a graph; `shift` is added to the ways driven, m."""
        nodes = KeyframeNodes()
        for k in sorted(self.poses):
            nodes.append(k, self.poses[k], self.heights[k], self.tilts[k], self.travelled[k] + shift)
        nodes.mapped[:] = [k in self.patches for k in nodes.ids.tolist()]
        return nodes

    def without(self, gone: Collection[int]) -> LevelMap:
        """The map without some keyframes."""
        left = [k for k in self.poses if k not in gone]
        return LevelMap(
            {k: self.poses[k] for k in left},
            {k: self.heights[k] for k in left},
            {k: self.tilts[k] for k in left},
            {k: self.travelled[k] for k in left},
            {k: self.patches[k] for k in left if k in self.patches},
            [e for e in self.edges if e.i not in gone and e.j not in gone],
        )


def from_saved(saved: SavedMap, voxel: float) -> LevelMap:
    """A saved map; touches closer than `voxel` (m) are one.

    Edges of odometry say what the saved poses say: the biases that they were corrected by are not saved. Where
    edges were lost, the parts hang together by a loose one.
    """
    known = LevelMap()
    for keyframe, T in zip(saved.keyframes, saved.poses, strict=True):
        level, tilt = geometry.levelled(T)
        k = keyframe.id
        known.poses[k], known.heights[k], known.tilts[k] = level[:3], float(level[3]), tilt
        known.travelled[k] = keyframe.travelled
        if len(keyframe.points):
            known.patches[k] = patch_of(keyframe, tilt, voxel)
    known.edges = [_levelled_edge(edge, known) for edge in saved.edges]
    known.edges += _chain(known)
    return known


def _levelled_edge(edge: GraphEdge, known: LevelMap) -> LevelEdge:
    information = edge.information[np.ix_(PLANAR, PLANAR)]
    dz_information = float(edge.information[2, 2])
    if edge.kind == "odometry":
        Z = geometry.se2_compose(geometry.se2_inverse(known.poses[edge.i]), known.poses[edge.j])
        dz = known.heights[edge.j] - known.heights[edge.i]
    else:
        T = edge.T_i_j.copy()
        T[:3, :3] = known.tilts[edge.i] @ T[:3, :3] @ known.tilts[edge.j].T
        T[:3, 3] = known.tilts[edge.i] @ T[:3, 3]
        level, _ = geometry.levelled(T)
        Z, dz = level[:3], float(level[3])
    return _edge(edge.kind, edge.i, edge.j, Z, information, dz, dz_information, edge.weight > 0.0)


def _edge(
    kind: str, i: int, j: int, Z: FloatArray, information: FloatArray, dz: float, dz_information: float, enabled: bool
) -> LevelEdge:
    return LevelEdge(
        "loop" if kind == "loop" else "odometry", i, j, Z, information, dz, dz_information,
        np.zeros((3, 0)), np.zeros(0), enabled,
    )  # fmt: skip


def _chain(known: LevelMap) -> list[LevelEdge]:
    """Loose edges between parts of the map that no edge connects."""
    ids = sorted(known.poses)
    place = {k: n for n, k in enumerate(ids)}
    pairs = np.array([(place[e.i], place[e.j]) for e in known.edges if e.enabled], dtype=np.int64).reshape(-1, 2)
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(ids), len(ids)))
    _, part = connected_components(links, directed=False)
    chain, seen = [], {part[0]}
    for before, k in pairwise(ids):
        if part[place[k]] in seen:
            continue
        seen.add(part[place[k]])
        Z = geometry.se2_compose(geometry.se2_inverse(known.poses[before]), known.poses[k])
        dz = known.heights[k] - known.heights[before]
        information = np.diag(1.0 / np.square(CHAIN_SIGMAS))
        chain.append(_edge("odometry", before, k, Z, information, dz, CHAIN_HEIGHT_SIGMA**-2, True))
    return chain
