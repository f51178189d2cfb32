"""The map on the bus: what changed, the path, and the answers to queries about it."""

from __future__ import annotations

import secrets

import numpy as np

from robominer_slam import geometry
from robominer_slam.configuration.model import MapSection
from robominer_slam.frame_result import FrameResult
from robominer_slam.graph_json import closures_json, graph_json
from robominer_slam.mapping.height_grid import GridSizeError, height_grid, occupancy
from robominer_slam.mapping.keyframe_map import KeyframeMap
from robominer_slam.publisher import MAP
from robominer_slam.publishing import cloud_messages, pose_messages, report_messages
from robominer_slam.publishing.bus_messages import Query, QueryRefusedError, Reply
from robominer_slam.publishing.map_publisher import MapPublisher
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.wall_clock import WallClock

PATH_INTERVAL_NS = 1_000_000_000
#: Changes and path are told so often where the computer cannot keep up.
SPARING_INTERVAL_NS = 5_000_000_000


class MapService:
    """Publishes the map's changes and answers queries; the caller holds the state's lock.

    Args:
        bus: to publish on.
        clock: for stamps.
        keyframe_map: the map; this is the only place that changes it.
        section: cells of what is published.

    Attributes:
        section: as above; another one takes effect at the next answer, its stream_cell at the next new map.
    """

    def __init__(self, bus: ZenohBus, clock: WallClock, keyframe_map: KeyframeMap, section: MapSection) -> None:
        self.keyframe_map = keyframe_map
        self._bus = bus
        self._clock = clock
        self.section = section
        self._publisher = self._new_publisher()
        self._path_ns: int | None = None
        self._told_ns: int | None = None
        self._path_version = 0
        self._untold = False

    def frame(self, result: FrameResult, *, sparing: bool = False) -> None:
        """Take what the back-end found, and publish what changed; more seldom where it shall be sparing."""
        for backend_result in result.backend_results:
            self.keyframe_map.take(backend_result)
        self._untold = self._untold or bool(result.backend_results)
        pause_ns = SPARING_INTERVAL_NS if sparing else 0
        if self._untold and (self._told_ns is None or result.stamp_ns - self._told_ns >= pause_ns):
            self._told_ns, self._untold = result.stamp_ns, False
            self._publish_updates()
        pause_ns = max(PATH_INTERVAL_NS, pause_ns)
        due = self._path_ns is None or result.stamp_ns - self._path_ns >= pause_ns
        if due and self._path_version != self.keyframe_map.version:
            self._path_ns = result.stamp_ns
            self._path_version = self.keyframe_map.version
            self._bus.put("path", self.path(self._clock.unix_ns(result.stamp_ns)))

    def _publish_updates(self) -> None:
        whole = self.keyframe_map
        poses = geometry.to_vector7(whole.poses)
        self._publisher.update(whole.version, whole.keyframes, poses, self._clock.offset_ns)

    def _new_publisher(self) -> MapPublisher:
        return MapPublisher(self._bus, secrets.randbits(64), self.section.stream_cell)

    def load(self, known: SavedMap) -> None:
        """Start with a map that was saved."""
        self.keyframe_map.load(known)
        self._publish_updates()

    def new_map(self) -> None:
        """Start anew with an empty map, under another id."""
        self.keyframe_map.clear()
        self._publisher = self._new_publisher()
        self._publish_updates()

    @property
    def digest(self) -> str:
        """Digest of the map as the stream carries it."""
        return self._publisher.digest

    def path(self, stamp_ns: int) -> bytes:
        """nav_msgs/Path of the keyframes."""
        stamps = [self._clock.unix_ns(k.stamp_ns) for k in self.keyframe_map.keyframes]
        return pose_messages.path(stamp_ns, MAP, stamps, geometry.to_vector7(self.keyframe_map.poses))

    def snapshot(self, query: Query) -> list[Reply]:
        """The stream's state or what a copy of it lacks.

        Raises:
            QueryRefusedError: a parameter that means nothing.
        """
        return self._publisher.answer(query)

    def cloud(self) -> list[Reply]:
        """PointCloud2 of the map."""
        return [Reply(cloud_messages.map_cloud(self._clock.now_unix_ns(), MAP, self.keyframe_map.cloud()))]

    def grid(self) -> list[Reply]:
        """OccupancyGrid: steps as obstacles."""
        try:
            grid = height_grid(self.keyframe_map.cloud(), self.section.grid_cell)
        except GridSizeError as error:
            raise QueryRefusedError(str(error)) from error
        cells = np.ascontiguousarray(occupancy(grid, self.section.obstacle_height))
        message = report_messages.occupancy_grid(self._clock.now_unix_ns(), MAP, grid.cell, grid.origin, cells)
        return [Reply(message)]

    def closures(self, query: Query) -> list[Reply]:
        """The loop closures' ends as JSON, in portions: those from `first=` on.

        Raises:
            QueryRefusedError: a parameter that means nothing.
        """
        first = query.parameters.get("first", "0")
        if not first.isdecimal():
            raise QueryRefusedError("expected a whole number in first=")
        return [Reply(closures_json(self.keyframe_map, int(first)).encode())]

    def graph(self) -> list[Reply]:
        """The pose graph as JSON."""
        return [Reply(graph_json(self.keyframe_map, self._clock.offset_ns).encode())]
