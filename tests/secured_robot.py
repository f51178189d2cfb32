"""A robot with real keys on a real TLS port of this machine, and those who want something from it."""

from __future__ import annotations

import queue
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from robominer_slam.configuration.zenoh_section import ZenohSection
from robominer_slam.publishing.bus_messages import Received
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.security.authority import Authority

PREFIX = "robominer/rm3"
#: Nothing here takes longer, except where it is broken.
LIMIT_S = 15.0
#: Zenoh only times out where it is refused: no need to wait long for that.
REFUSED_S = 1.5


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on, all different."""
    probes = [socket.socket() for _ in range(count)]
    try:
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]
    finally:
        for probe in probes:
            probe.close()


class SecuredRobot:
    """An authority, and a robot that listens on TLS and on loopback."""

    def __init__(
        self, folder: Path, *, remote_ros: bool = False, ros: Literal["none", "ros2dds", "rmw_zenoh"] = "none"
    ) -> None:
        self.authority = Authority.create(folder / "keys")
        for name, role, days in (
            ("rm3", "robot", 30),
            ("front-board", "robot", 30),
            ("alice", "operator", 30),
            ("bob", "viewer", 30),
            ("mallory", "operator", 30),
            ("late", "operator", 0),
        ):
            self.authority.issue(name, role, days)
        self.authority.revoke("mallory")
        self.foreign = Authority.create(folder / "foreign")
        self.foreign.issue("alice", "operator")
        tls, tcp = free_ports(2)
        self.tls, self.tcp = f"tls/localhost:{tls}", f"tcp/127.0.0.1:{tcp}"
        section = ZenohSection(
            credentials=str(self.bundle("rm3")),
            listen=(f"tls/127.0.0.1:{tls}", self.tcp),
            remote_ros=remote_ros,
            ros=ros,
        )
        self.settings = robot_settings(section, folder, PREFIX)
        self.bus = ZenohBus(self.settings, PREFIX)

    def bundle(self, name: str) -> Path:
        return self.authority.bundle(name)

    def client(self, name: str | None) -> ZenohBus:
        """A session by TLS with the bundle of a name; None: of a program on the robot, by TCP."""
        if name is None:
            return ZenohBus(client_settings(self.tcp, None, LIMIT_S), PREFIX)
        return ZenohBus(client_settings(self.tls, self.bundle(name), LIMIT_S), PREFIX)


class Inbox:
    """Messages as they come; waiting has an end.

    Attributes:
        seen: all that were looked at.
    """

    def __init__(self, bus: ZenohBus, *keys: str, history: bool = False) -> None:
        self._queue: queue.Queue[Received] = queue.Queue()
        self.seen: list[Received] = []
        for key in keys:
            bus.subscriber(key, self._queue.put, history=history)

    def until(self, wanted: Callable[[Received], bool]) -> list[Received]:
        """All messages up to a wanted one."""
        found = []
        while not found or not wanted(found[-1]):
            found.append(self._take(LIMIT_S))
        return found

    def insist(self, bus: ZenohBus, key: str, payload: bytes) -> None:
        """Repeat a message until it comes: a busy machine's link may be full for a millisecond, and drops it then."""
        end = time.monotonic() + LIMIT_S
        while time.monotonic() < end:
            bus.put(key, payload)
            try:
                while True:
                    received = self._take(timeout=0.2)
                    if (received.key, received.payload) == (key, payload):
                        return
            except queue.Empty:
                continue
        raise AssertionError(f"{key} did not come through")

    def _take(self, timeout: float) -> Received:
        self.seen.append(self._queue.get(timeout=timeout))
        return self.seen[-1]

    def waiting(self) -> list[Received]:
        """What has come and was not looked at."""
        return [self._queue.get_nowait() for _ in range(self._queue.qsize())]

    def synchronise(self, bus: ZenohBus) -> None:
        """Repeat a message until it comes through: from then on every subscription of this inbox is known."""
        for i in range(400):
            bus.put("telemetry", b"hello %d" % i)
            try:
                if self._take(0.05).key == "telemetry":
                    break
            except queue.Empty:
                continue
        else:
            raise AssertionError("nothing came through")
        self.marker(bus, b"synchronised")

    def marker(self, bus: ZenohBus, text: bytes) -> list[Received]:
        """Send a last message, and give all that came before it; of other keys some may still be on their way."""
        before = len(self.seen)
        self.insist(bus, "telemetry", text)
        return self.seen[before:-1]
