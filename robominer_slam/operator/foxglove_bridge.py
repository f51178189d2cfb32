"""A robot in the Foxglove viewer: a WebSocket server that hands on what comes over Zenoh.

ROS messages go on as they are, in CDR with their definitions. The map goes as a point cloud that is made from the
map stream, and as the occupancy grid that the robot answers with. Where a slow link brings poses seldom, telemetry
stands in for them. Viewers may look and nothing else.

Protocol: https://github.com/foxglove/ws-protocol; it knows no passwords, so the server stays on this machine.
"""

from __future__ import annotations

import importlib.util
import ipaddress
import logging
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from drivers.ros_messages import MessageError, schema_text
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.operator import foxglove_telemetry
from robominer_slam.publishing import telemetry
from robominer_slam.publishing.bus_messages import QueryError, Received
from robominer_slam.publishing.keys import encoding_of
from robominer_slam.publishing.map_follower import MapFollower
from robominer_slam.publishing.ros_topics import ROS_KEYS, ros_name
from robominer_slam.publishing.zenoh_session import ZenohBus

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ServerListener

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
TICK_S = 0.2
CLOUD_INTERVAL_S = 1.0
GRID_INTERVAL_S = 2.0
QUERY_TIMEOUT_S = 3.0
#: Messages that wait for a viewer that is too slow; beyond, the oldest are let go.
BACKLOG = 256
CLOUD, GRID = "map/cloud", "map/grid"
#: Who begins to look gets the last of these at once; of the others the next is never far.
LATCHED = ("tf_static", "path", CLOUD, GRID)


class FoxgloveBridge:
    """Serves from `with` to its end.

    Attributes:
        port: that it listens on.
    """

    def __init__(self, bus: ZenohBus, port: int, host: str = HOST) -> None:
        """Begin to listen.

        Args:
            bus: a session that is open, and stays so for longer than this.
            port: 0 for any that is free.
            host: an address of this machine's own.

        Raises:
            ConfigurationError: foxglove-sdk is missing, the address is not this machine's own, or the port is taken.
        """
        if importlib.util.find_spec("foxglove") is None:
            raise ConfigurationError("--foxglove needs foxglove-sdk: pip install 'robominer-slam[operator]'")
        if not _is_own(host):
            raise ConfigurationError(
                f"Foxglove on {host}: anybody there could look; serve on 127.0.0.1 and tunnel, as with ssh -L {port}"
            )
        import foxglove

        self._bus = bus
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=bus.prefix,
                host=host,
                port=port,
                context=self._context,
                server_listener=_listener(self._subscribed),
                message_backlog_size=BACKLOG,
            )
        except RuntimeError as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise ConfigurationError(
                f"Foxglove on {host}:{port}: {reason}; is another viewer's server running?"
            ) from error
        self.port: int = self._server.port
        self._channels = {key: self._channel(key) for key in (*ROS_KEYS, CLOUD, GRID)}
        self._last: dict[str, bytes] = {}
        self._again: set[str] = set()
        self._lock = threading.Lock()
        self._map = MapFollower(bus)
        self._paces = {key: foxglove_telemetry.Pace() for key in ("pose", "tf")}
        self._T_map_odom = np.eye(4)
        self._cloud_s = self._grid_s = float("-inf")
        self._grid_of: tuple[int, int] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._tend, name="foxglove", daemon=True)

    def __enter__(self) -> FoxgloveBridge:
        for key in ROS_KEYS:
            self._bus.subscriber(key, self._on_ros, history=key == "tf_static")
        self._bus.subscriber("telemetry", self._on_telemetry)
        self._bus.subscriber("map/updates", lambda received: self._map.feed(received.payload), history=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(QUERY_TIMEOUT_S + 1.0)
        self._server.stop()

    def _channel(self, key: str) -> Channel:
        from foxglove import Channel, Schema

        typename = encoding_of(key).partition(";")[2]
        schema = Schema(name=typename, encoding="ros2msg", data=schema_text(typename).encode())
        topic = ros_name(self._bus.prefix, key)
        return Channel(topic, schema=schema, message_encoding="cdr", context=self._context)

    def _show(self, key: str, payload: bytes) -> None:
        if self._stop.is_set():
            return
        if key in LATCHED:
            with self._lock:
                self._last[key] = payload
        self._channels[key].log(payload, log_time=time.time_ns())

    def _subscribed(self, topic: str) -> None:
        """Somebody looks at a topic from now on; in the server's own thread, which must not wait."""
        with self._lock:
            self._again |= {key for key in LATCHED if ros_name(self._bus.prefix, key) == topic}

    def _on_ros(self, received: Received) -> None:
        pace = self._paces.get(received.key)
        if pace is not None:
            pace.came(time.monotonic())
        if received.key == "tf":
            try:
                T = foxglove_telemetry.map_to_odom(received.payload)
            except MessageError as error:
                log.warning("%s cannot be read: %s", received.key, error)
                return
            if T is not None:
                self._T_map_odom = T
        self._show(received.key, received.payload)

    def _on_telemetry(self, received: Received) -> None:
        now = time.monotonic()
        seldom = [key for key, pace in self._paces.items() if pace.seldom(now)]
        if not seldom:
            return
        try:
            state = telemetry.decode(received.payload)
        except telemetry.TelemetryError as error:
            log.warning("%s cannot be read: %s", received.key, error)
            return
        if "pose" in seldom:
            self._show("pose", foxglove_telemetry.pose(state))
        if "tf" in seldom:
            transforms = foxglove_telemetry.transforms(state, self._T_map_odom)
            if transforms is not None:
                self._show("tf", transforms)

    def _tend(self) -> None:
        while not self._stop.wait(TICK_S):
            with self._lock:
                again, self._again = self._again, set()
                known = {key: self._last[key] for key in again if key in self._last}
            for key, payload in known.items():
                self._show(key, payload)
            self._map.catch_up(QUERY_TIMEOUT_S)
            now = time.monotonic()
            if self._channels[CLOUD].has_sinks() and now >= self._cloud_s + CLOUD_INTERVAL_S:
                cloud = self._map.changed_cloud(time.time_ns())
                if cloud is not None:
                    self._cloud_s = now
                    self._show(CLOUD, cloud)
            version = self._map.version
            due = version is not None and version != self._grid_of and now >= self._grid_s + GRID_INTERVAL_S
            if due and self._channels[GRID].has_sinks():
                self._grid_s = now
                self._ask_grid(version)

    def _ask_grid(self, version: tuple[int, int] | None) -> None:
        try:
            [reply, *_] = self._bus.get(GRID, timeout_s=QUERY_TIMEOUT_S)
        except QueryError as error:
            log.debug("no grid: %s", error)
            return
        self._grid_of = version
        self._show(GRID, reply.payload)


def _listener(on_topic: Callable[[str], None]) -> ServerListener:
    """The server's callbacks: who subscribes to what; viewers can do nothing else."""
    from foxglove.websocket import ChannelView, Client, ServerListener

    class Subscriptions(ServerListener):
        def on_subscribe(self, _client: Client, channel: ChannelView) -> None:
            on_topic(channel.topic)

    return Subscriptions()


def serve_foxglove(
    bus: ZenohBus,
    host: str,
    port: int,
    stop: threading.Event,
    on_ready: Callable[[str], None] = lambda _: None,
) -> None:
    """Serve until `stop` is set.

    Args:
        bus: an open session.
        host, port: where viewers connect.
        stop: ends it.
        on_ready: called with the address.

    Raises:
        ConfigurationError: as `FoxgloveBridge`.
    """
    with FoxgloveBridge(bus, port, host) as bridge:
        on_ready(f"ws://{host}:{bridge.port}")
        stop.wait()


def _is_own(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
