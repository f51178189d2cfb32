"""A robot as those who listen to it know it: a session that publishes every key, with a map that grows."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from robominer_slam.publishing import report_messages, telemetry
from robominer_slam.publishing.bus_messages import Query, QueryRefusedError, Reply
from robominer_slam.publishing.map_stream import MapStreamEncoder
from robominer_slam.publishing.telemetry import Telemetry
from robominer_slam.publishing.zenoh_session import ZenohBus
from tests.ros_node import MESSAGES, MOUNTS, POSE, STAMP_NS


@dataclass(frozen=True)
class Keyframe:
    id: int
    stamp_ns: int
    points: np.ndarray


class ShownRobot:
    """Publishes everything each 40 ms until it is closed.

    Attributes:
        encoder: of the map's stream.
        keyframes: in the map.
        grids: how often the grid was asked for.
    """

    def __init__(self, bus: ZenohBus, keys: frozenset[str] | None = None) -> None:
        self.bus = bus
        self.encoder = MapStreamEncoder(0x1234)
        self.keyframes: list[Keyframe] = []
        self.grids = 0
        self._keys = keys
        self._lock = threading.Lock()
        self._stop = threading.Event()
        bus.latch("tf_static", MOUNTS)
        bus.queryable("map/snapshot", self._snapshot)
        bus.queryable("map/grid", self._grid)
        for _ in range(3):
            self.grow()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def grow(self) -> None:
        """One more keyframe, with a square of four points around it."""
        with self._lock:
            number = len(self.keyframes)
            square = np.array([[0.1, 0.1, 0.0], [0.1, -0.1, 0.0], [-0.1, 0.1, 0.0], [-0.1, -0.1, 0.05]])
            self.keyframes.append(Keyframe(number, STAMP_NS + number, square))
            poses = np.array([[float(k.id), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] for k in self.keyframes])
            for message in self.encoder.update(len(self.keyframes), self.keyframes, poses):
                self.bus.put("map/updates", message)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _snapshot(self, _: Query) -> Reply:
        with self._lock:
            return Reply(b"".join(self.encoder.snapshot()))

    def _grid(self, _: Query) -> Reply:
        self.grids += 1
        if not self.keyframes:
            raise QueryRefusedError("empty")
        cells = np.full((2, len(self.keyframes)), 100, dtype=np.int8)
        return Reply(report_messages.occupancy_grid(STAMP_NS, "map", 0.05, (0.0, 0.0), cells))

    def _publish(self) -> None:
        number = 0
        while not self._stop.wait(0.04):
            for key, message in MESSAGES.items():
                if self._keys is None or key in self._keys:
                    self.bus.put(key, message)
            if self._keys is None or "telemetry" in self._keys:
                self.bus.put("telemetry", telemetry_message(number))
            number += 1


def telemetry_message(number: int) -> bytes:
    """The robot at the pose of `MESSAGES`, one metre on with each message."""
    pose = POSE.copy()
    pose[0] += number
    nothing = np.zeros((8, 8))
    return telemetry.encode(
        Telemetry(number, STAMP_NS + number, "tracking", pose, np.full(6, 0.02), np.zeros(3), 0, nothing, nothing)
    )
