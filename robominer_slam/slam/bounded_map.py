"""Keeps the map of the method `robust` within its bounds: which touches are kept, and which keyframes.

Touches on ground that the map has already are not kept, once closures have tied their keyframe to it; in a full map
they are judged again wherever the robot comes. When keyframes are too many, those without touches go first (from the
inside of covered stretches, oldest first); then neighbours far from the robot are merged, the touches of one moved into
the other's frame; at last the farthest are forgotten. When closures are too many, those that say least go.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.configuration.bounded_map_section import BoundedMapSection
from robominer_slam.slam.closure_leverage import drop_least_needed
from robominer_slam.slam.composite_scan import voxel_filter
from robominer_slam.slam.covered_ground import covered_share
from robominer_slam.slam.keyframe import Merge
from robominer_slam.slam.keyframe_graph import KeyframeGraph
from robominer_slam.slam.keyframe_removal import (
    covered,
    farthest,
    interior_of_covered,
    mergeable,
    remove_keyframes,
)
from robominer_slam.slam.patch import Patch
from robominer_slam.slam.patch_memory import PatchMemory
from robominer_slam.slam.surface_registration import placed

FloatArray = NDArray[np.float64]

#: Keyframes that leave at once where too many are there: what each costs is shared by these.
BATCH = 16
#: They may leave when half of that room is left yet, if the keyframe does none of so many things that take time.
LOADS = 2
#: Keyframes whose touches are judged at one keyframe at most: those of a small map wait until it is large.
DECISIONS = 2
#: Where closures are more than keyframes may be, this part of them goes, too: leverages are computed seldom.
CLOSURE_BATCH = 16
#: In a full map touches this near the robot are judged again, m: they are in memory, and the map is surest there.
AGAIN = 1.5
#: Ground is looked for among keyframes this much farther than the touches reach, m: as far as others' touches reach.
GROUND_REACH = 0.6


class BoundedMap:
    """Decides what stays; the graph and the patches are changed here.

    Args:
        bounds: with units and reasons there.
        graph: of all keyframes.
        patches: their touches in their level frames.

    Attributes:
        removed: ids of keyframes that have left the graph since `begin`.
        merged: which of these handed their touches to a neighbour, in order.
        bare: ids of keyframes that have lost their touches since `begin`.
    """

    def __init__(self, bounds: BoundedMapSection, graph: KeyframeGraph, patches: PatchMemory) -> None:
        self._bounds = bounds
        self._graph = graph
        self._patches = patches
        self._undecided: deque[int] = deque()
        self._spans: dict[int, float] = {}
        self._judged: dict[int, int] = {}
        self.removed: list[int] = []
        self.merged: list[Merge] = []
        self.bare: list[int] = []

    def begin(self, key: int, floor_only: bool) -> None:
        """A keyframe was added; what the attributes said of the one before is forgotten.

        Args:
            key: its id.
            floor_only: whether all its touches are patches of ground: others are kept, since nothing covers them.
        """
        if floor_only:
            self._undecided.append(key)
        self.removed, self.merged, self.bare = [], [], []

    def joined(self, spacing: float) -> None:
        """The graph was joined to a map made before: keyframes that were merged there span the way to the next.

        Args:
            spacing: way between keyframes that were not, m.
        """
        nodes = self._graph.nodes
        for key, way in zip(nodes.ids[:-1].tolist(), np.diff(nodes.travelled).tolist(), strict=True):
            if way > 1.5 * spacing:
                self._spans[key] = max(self._spans.get(key, 0.0), way - spacing)

    def settle(self, newest: int, patch: float, partner_span: int, min_travel: float) -> None:
        """Drop touches of keyframes that need not be kept any longer for the next patches.

        Args:
            newest: id of the newest keyframe.
            patch: way back over which touches are merged for a match, m.
            partner_span: keyframes back to which closures may still come.
            min_travel: way since which ground counts as mapped before, m.
        """
        nodes = self._graph.nodes
        if len(nodes) <= self._bounds.small_map:
            return
        if len(nodes) > self._bounds.max_keyframes - BATCH:
            self._judge_again(newest, min_travel)
        for _ in range(min(DECISIONS, len(self._undecided))):
            key = self._undecided[0]
            row = nodes.row(key)
            if newest - key <= partner_span or nodes.travelled[-1] - nodes.travelled[row] < patch:
                return
            self._undecided.popleft()
            self._judge(key, newest, min_travel)

    def _judge_again(self, newest: int, min_travel: float) -> None:
        """Judge one of the keyframes near the robot again, the one judged longest ago: later passes may cover it."""
        nodes = self._graph.nodes
        near = nodes.mapped & (nodes.travelled <= nodes.travelled[-1] - min_travel)
        near &= np.hypot(*(nodes.poses[:, :2] - nodes.poses[-1, :2]).T) <= AGAIN
        keys = [k for k in nodes.ids[near].tolist() if k in self._judged]
        if keys:
            key = min(keys, key=lambda k: (self._judged[k], k))
            self._judge(key, newest, min_travel)

    def _judge(self, key: int, newest: int, min_travel: float) -> None:
        """Drop the touches of a keyframe if closures hold it and others cover it."""
        self._judged[key] = newest
        if self._closed(key) and self._covered(self._graph.nodes.row(key), min_travel):
            self._graph.nodes.mapped[self._graph.nodes.row(key)] = False
            self._patches.pop(key)
            self._judged.pop(key)
            self.bare.append(key)

    def shrink(self, load: int) -> bool:
        """Let keyframes go where they are too many, or are about to be and there is time for it; True if any went.

        Args:
            load: how many things that take much time this keyframe has done already, up to `LOADS`: the more, the
                longer it waits for another while there is room.
        """
        bounds, graph = self._bounds, self._graph
        room = min(BATCH, bounds.max_keyframes // 10)
        if len(graph.nodes) <= bounds.max_keyframes - room * (LOADS - load) // (2 * LOADS):
            return False
        target = bounds.max_keyframes - room
        window = min(bounds.local_window, bounds.max_keyframes // 2)
        robot = graph.nodes.poses[-1, :2].copy()
        self._remove(interior_of_covered(graph, window, bounds.tie_spacing)[: len(graph.nodes) - target])
        while len(graph.nodes) > target:
            merged = mergeable(graph, self._spans, bounds.merge_extent, window, robot)[: len(graph.nodes) - target]
            if not merged:
                break
            for key in merged:
                self._merge(key)
            self._remove(merged)
        self._remove(covered(graph, window)[: len(graph.nodes) - target])
        self._remove(farthest(graph, window, robot)[: len(graph.nodes) - target])
        excess = int(graph.edges.loop.sum()) - bounds.max_keyframes
        if excess > 0:
            drop_least_needed(graph, excess + bounds.max_keyframes // CLOSURE_BATCH, window)
        graph.update_chi2()
        return True

    def _closed(self, key: int) -> bool:
        """Whether a closure holds a keyframe, or one so near that odometry is as sure as closures are."""
        edges, span = self._graph.edges, self._bounds.sure_span
        if not len(edges):
            return False
        near = (np.abs(edges.i - key) <= span) | (np.abs(edges.j - key) <= span)
        return bool((edges.loop & edges.enabled & near).any())

    def _covered(self, row: int, min_travel: float) -> bool:
        """Whether the touches of a keyframe lie on ground that other passes have touched."""
        nodes = self._graph.nodes
        own = self._placed(int(nodes.ids[row]))
        if not len(own):
            return True
        xy = nodes.poses[row, :2]
        reach = float(np.hypot(*(own[:, :2] - xy).T).max()) + GROUND_REACH
        near = nodes.mapped & (np.abs(nodes.travelled - nodes.travelled[row]) >= min_travel)
        near &= nodes.travelled <= nodes.travelled[-1] - min_travel
        near &= np.hypot(*(nodes.poses[:, :2] - xy).T) <= reach
        if not near.any():
            return False
        ground = np.concatenate([self._placed(int(k)) for k in nodes.ids[near]])
        return covered_share(own, ground, self._bounds.covered_cell) >= self._bounds.covered_share

    def _placed(self, key: int) -> FloatArray:
        return placed(self._patches[key].points, np.append(self._graph.nodes[key], 0.0))

    def _merge(self, key: int) -> None:
        """Move a keyframe's touches into the frame of the one before it."""
        nodes = self._graph.nodes
        row = nodes.row(key)
        before = int(nodes.ids[row - 1])
        shift = np.append(self._graph.relative(before, key), nodes.heights[row] - nodes.heights[row - 1])
        kept, gone = self._patches[before], self._patches[key]
        points = np.concatenate([kept.points, placed(gone.points, shift)])
        walls = np.concatenate([kept.walls, placed(gone.walls, shift)])
        points, walls = voxel_filter(points, self._bounds.merge_voxel), voxel_filter(walls, self._bounds.merge_voxel)
        self._patches[before] = Patch(points, float(nodes.travelled[row - 1]), walls)
        T = geometry.T_from_xyyaw(shift[:3])
        T[2, 3] = shift[3]
        R_into, R_gone = np.eye(4), np.eye(4)
        R_into[:3, :3], R_gone[:3, :3] = nodes.tilts[row - 1], nodes.tilts[row]
        self.merged.append(Merge(key, before, R_into.T @ T @ R_gone, self._bounds.merge_voxel))
        step = float(nodes.travelled[row] - nodes.travelled[row - 1])
        self._spans[before] = step + self._spans.get(key, 0.0)
        if key not in self._judged:
            # Its touches may be of walls, which nothing covers: the keyframe that gets them keeps its own, too.
            self._judged.pop(before, None)

    def _remove(self, keys: list[int]) -> None:
        if not keys:
            return
        remove_keyframes(self._graph, keys)
        for key in keys:
            self._patches.pop(key)
            self._spans.pop(key, None)
            self._judged.pop(key, None)
        gone = set(keys)
        self._undecided = deque(key for key in self._undecided if key not in gone)
        self.removed += keys
