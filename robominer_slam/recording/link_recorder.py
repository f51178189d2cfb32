"""Records what comes over the link to a robot, as MCAP: ROS messages with their definitions, ours with words on them.

The log time is that of arrival here, the publish time the robot's own stamp: their difference is the link's delay,
if the clocks agree. The map goes in as its stream, and now and then, and at the end, as a whole point cloud.
"""

from __future__ import annotations

import logging
import queue
import struct
import time
from typing import NamedTuple

from drivers.recording_format import ForeignFormat
from drivers.recording_writer import RecordingWriter
from drivers.ros_definitions import DEFINITIONS
from drivers.ros_messages import CDR_LITTLE_ENDIAN, NANOSECONDS_PER_SECOND
from robominer_slam.publishing.bus_messages import Received
from robominer_slam.publishing.cloud_messages import POINT_CLOUD
from robominer_slam.publishing.keys import MAP_STREAM, TELEMETRY, encoding_of
from robominer_slam.publishing.map_follower import MapFollower
from robominer_slam.publishing.pose_messages import TF_MESSAGE
from robominer_slam.publishing.ros_topics import ROS_KEYS, ros_name
from robominer_slam.publishing.zenoh_session import ZenohBus

log = logging.getLogger(__name__)

#: Small, as a slow link brings 2 KB a second and what is in a chunk is lost with the program.
CHUNK_BYTES = 8 * 1024
QUEUE_LENGTH = 20_000
#: How often the whole map goes in as a cloud if it has changed, s.
CLOUD_INTERVAL_S = 30.0
SNAPSHOT_TIMEOUT_S = 3.0
#: Named one by one: a pattern wider than what a viewer may see is denied as a whole.
KEYS = (*ROS_KEYS, "telemetry", "map/updates")
_WITH_HISTORY = ("tf_static", "map/updates")

_ENCODING = "robominer_slam"
_FORMATS = {
    TELEMETRY: ForeignFormat(
        "robominer_slam/telemetry",
        _ENCODING,
        "Pose, sigmas, state, whiskers; little-endian. Layout: robominer_slam/publishing/telemetry.py",
    ),
    MAP_STREAM: ForeignFormat(
        "robominer_slam/map_stream",
        _ENCODING,
        "What changed in the map since a version, or all of it. Layout: docs/map-stream.md",
    ),
}
_STAMP = struct.Struct("<iI")
_TELEMETRY_STAMP = struct.Struct("<q")
_TELEMETRY_STAMP_AT = 6


class _Arrival(NamedTuple):
    received: Received
    time_ns: int


class LinkRecorder:
    """Subscribes at once; `step` writes what has come.

    Attributes:
        dropped: messages that came faster than the disk took them.
    """

    def __init__(self, bus: ZenohBus, writer: RecordingWriter) -> None:
        self._bus = bus
        self._writer = writer
        self._queue: queue.Queue[_Arrival] = queue.Queue(QUEUE_LENGTH)
        self._map = MapFollower(bus, self._on_snapshot)
        self._cloud_due_s = time.monotonic() + CLOUD_INTERVAL_S
        self._unknown: set[str] = set()
        self.dropped = 0
        for key in KEYS:
            bus.subscriber(key, self._arrived, history=key in _WITH_HISTORY)

    def step(self, timeout_s: float) -> None:
        """Write what has come, waiting at most so long for the first of it.

        Raises:
            RecordingError: the file cannot be written.
        """
        try:
            arrival = self._queue.get(timeout=timeout_s)
            while True:
                self._write(arrival)
                arrival = self._queue.get_nowait()
        except queue.Empty:
            pass

    def tend(self) -> None:
        """About once a second: ask for a map that is not known whole, put it in if it is due, hand all to the system.

        Raises:
            RecordingError: the file cannot be written.
        """
        if self._writer.counts:
            self._map.catch_up(SNAPSHOT_TIMEOUT_S)
        if time.monotonic() >= self._cloud_due_s:
            self._cloud_due_s = time.monotonic() + CLOUD_INTERVAL_S
            self._write_cloud()
        self._writer.flush()

    def finish(self) -> None:
        """Write the rest of what has come, and the whole map.

        Raises:
            RecordingError: the file cannot be written.
        """
        self.step(0.0)
        self._write_cloud()

    def _arrived(self, received: Received) -> None:
        try:
            self._queue.put_nowait(_Arrival(received, time.time_ns()))
        except queue.Full:
            self.dropped += 1

    def _on_snapshot(self, payload: bytes) -> None:
        self._write(_Arrival(Received("map/snapshot", payload, encoding_of("map/snapshot"), None), time.time_ns()))

    def _write(self, arrival: _Arrival) -> None:
        received, now_ns = arrival
        topic = ros_name(self._bus.prefix, received.key)
        stamp_ns = stamp_of(received) or now_ns
        form = _FORMATS.get(received.encoding)
        if form is not None:
            self._writer.write_foreign(topic, form, received.payload, now_ns, stamp_ns)
        elif received.schema in DEFINITIONS:
            self._writer.write(topic, received.schema, received.payload, now_ns, stamp_ns)
        elif received.key not in self._unknown:
            self._unknown.add(received.key)
            log.warning("%s: not recorded: nothing is known here of %r", topic, received.encoding)
        if received.key == "map/updates":
            self._map.feed(received.payload)

    def _write_cloud(self) -> None:
        now_ns = time.time_ns()
        cloud = self._map.changed_cloud(now_ns)
        if cloud is not None:
            self._writer.write(ros_name(self._bus.prefix, "map/cloud"), POINT_CLOUD, cloud, now_ns)


def stamp_of(received: Received) -> int | None:
    """The robot's stamp in a message, UNIX ns; None where it has none."""
    payload = received.payload
    if received.encoding == TELEMETRY:
        end = _TELEMETRY_STAMP_AT + _TELEMETRY_STAMP.size
        return _TELEMETRY_STAMP.unpack_from(payload, _TELEMETRY_STAMP_AT)[0] if len(payload) >= end else None
    if not payload.startswith(CDR_LITTLE_ENDIAN):
        return None
    # All begin with their header, but for a list of transforms, whose first begins with it.
    at = len(CDR_LITTLE_ENDIAN) + (4 if received.schema == TF_MESSAGE else 0)
    if len(payload) < at + _STAMP.size:
        return None
    seconds, nanoseconds = _STAMP.unpack_from(payload, at)
    return int(seconds) * NANOSECONDS_PER_SECOND + int(nanoseconds)
