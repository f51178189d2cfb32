"""Keeps a copy of a robot's map from its map stream, for who receives: recordings, viewers."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from robominer_slam.publishing import cloud_messages
from robominer_slam.publishing.bus_messages import QueryError
from robominer_slam.publishing.map_stream import MapStreamDecoder
from robominer_slam.publishing.zenoh_session import ZenohBus

log = logging.getLogger(__name__)

#: A snapshot that did not come is asked for again after this long, s: it may be large, and the link slow.
RETRY_S = 5.0
#: It goes into a file or to a program on this machine: far more than Zenoh would carry in a message.
MAX_POINTS = 500_000
MAP = "map"


class MapFollower:
    """Fed with `map/updates` in one thread, asked in another.

    Args:
        bus: to ask for snapshots.
        on_snapshot: called with every message that came by a snapshot.
    """

    def __init__(self, bus: ZenohBus, on_snapshot: Callable[[bytes], None] = lambda _: None) -> None:
        self._bus = bus
        self._on_snapshot = on_snapshot
        self._decoder = MapStreamDecoder()
        self._lock = threading.Lock()
        self._asked_s = 0.0
        self._shown: tuple[int, int] | None = None

    @property
    def version(self) -> tuple[int, int] | None:
        """Id and version of the map; None before the first."""
        with self._lock:
            state = self._decoder.state
        return None if state is None else (state.map_id, state.version)

    def feed(self, payload: bytes) -> None:
        """Take a message of `map/updates`."""
        with self._lock:
            self._decoder.feed(payload)

    def catch_up(self, timeout_s: float) -> None:
        """Ask for what the updates alone do not give, if it is due; waits for the answer."""
        with self._lock:
            wanted = self._decoder.state is None or self._decoder.needs_snapshot
            copy = {name: str(value) for name, value in self._decoder.copy.items()}
        now = time.monotonic()
        if not wanted or now < self._asked_s + RETRY_S:
            return
        self._asked_s = now
        try:
            replies = self._bus.get("map/snapshot", copy, timeout_s=timeout_s)
        except QueryError as error:
            log.debug("no snapshot of the map: %s", error)
            return
        for reply in replies:
            self._on_snapshot(reply.payload)
            self.feed(reply.payload)

    def changed_cloud(self, stamp_ns: int) -> bytes | None:
        """The whole map as sensor_msgs/PointCloud2; None if it is the one that was given last, or there is none."""
        with self._lock:
            state = self._decoder.state
        if state is None or (state.map_id, state.version) == self._shown:
            return None
        self._shown = state.map_id, state.version
        return cloud_messages.map_cloud(stamp_ns, MAP, state.cloud(), MAX_POINTS)
