"""The Foxglove bridge as a viewer meets it: a WebSocket client of the protocol `foxglove.sdk.v1`."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as connect_to
from websockets.typing import Subprotocol

from drivers.ros_messages import deserialize
from robominer_slam.cli.operator import operator
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.operator import foxglove_telemetry
from robominer_slam.operator.foxglove_bridge import FoxgloveBridge, serve_foxglove
from robominer_slam.publishing import pose_messages, telemetry
from robominer_slam.publishing.pose_messages import StampedTransform
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
from sim_backend.demo import program
from tests.ros_node import MOUNTS, TOPICS, check_decoded
from tests.secured_robot import PREFIX, free_ports
from tests.shown_robot import ShownRobot, telemetry_message

LIMIT_S = 15.0
CLOUD, GRID = f"/{PREFIX}/map/cloud", f"/{PREFIX}/map/grid"
EXPECTED = {**TOPICS, CLOUD: "sensor_msgs/msg/PointCloud2", GRID: "nav_msgs/msg/OccupancyGrid"}
#: Opcode 1, subscription id u32, log time u64, then the message.
MESSAGE_HEAD = struct.Struct("<BIQ")


class Viewer:
    """A client: channels as they were advertised, and messages."""

    def __init__(self, port: int) -> None:
        self._open = contextlib.ExitStack()
        protocols = [Subprotocol("foxglove.sdk.v1")]
        connection = connect_to(f"ws://127.0.0.1:{port}", subprotocols=protocols)
        self._socket: ClientConnection = self._open.enter_context(connection)
        self.server = json.loads(self._socket.recv(LIMIT_S))
        self.channels: dict[str, dict[str, Any]] = {}
        while len(self.channels) < len(EXPECTED):
            message = json.loads(self._socket.recv(LIMIT_S))
            assert message["op"] == "advertise"
            self.channels |= {channel["topic"]: channel for channel in message["channels"]}

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def subscribe(self, *topics: str) -> None:
        wanted = [{"id": self.channels[topic]["id"], "channelId": self.channels[topic]["id"]} for topic in topics]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def next(self, timeout: float = LIMIT_S) -> tuple[str, int, bytes]:
        """Topic, log time, payload."""
        data = self._socket.recv(timeout)
        assert isinstance(data, bytes)
        opcode, subscription, log_time = MESSAGE_HEAD.unpack_from(data)
        assert opcode == 1
        [topic] = [topic for topic, channel in self.channels.items() if channel["id"] == subscription]
        return topic, log_time, data[MESSAGE_HEAD.size :]

    def decode(self, topic: str, payload: bytes) -> Any:
        """With nothing but what the server has said of the channel."""
        channel = self.channels[topic]
        package, _, name = channel["schemaName"].split("/")
        return generate_dynamic(f"{package}/{name}", channel["schema"])[f"{package}/{name}"](payload)


@pytest.fixture
def sessions() -> Iterator[tuple[ZenohBus, ZenohBus]]:
    [port] = free_ports(1)
    with (
        ZenohBus(ZenohSettings(listen=(f"tcp/127.0.0.1:{port}",)), PREFIX) as bus,
        ZenohBus(ZenohSettings(connect=(f"tcp/127.0.0.1:{port}",), mode="client"), PREFIX) as operator,
    ):
        yield bus, operator


def test_a_viewer_sees_every_topic_with_its_definition(sessions: tuple[ZenohBus, ZenohBus]) -> None:
    bus, console = sessions
    robot = ShownRobot(bus)
    try:
        with FoxgloveBridge(console, port=0) as bridge, Viewer(bridge.port) as viewer:
            assert viewer.server["name"] == PREFIX
            # Nothing that a viewer could do but look.
            assert viewer.server["capabilities"] == []
            assert {topic: channel["schemaName"] for topic, channel in viewer.channels.items()} == EXPECTED
            assert {(c["encoding"], c["schemaEncoding"]) for c in viewer.channels.values()} == {("cdr", "ros2msg")}
            viewer.subscribe(*EXPECTED)
            seen: dict[str, bytes] = {}
            end = time.monotonic() + LIMIT_S
            while seen.keys() != EXPECTED.keys():
                assert time.monotonic() < end, EXPECTED.keys() - seen.keys()
                topic, log_time, payload = viewer.next()
                assert abs(log_time - time.time_ns()) < 60e9
                seen[topic] = payload
    finally:
        robot.close()
    for topic in TOPICS:
        check_decoded(topic, seen[topic])
    pose = viewer.decode(f"/{PREFIX}/pose", seen[f"/{PREFIX}/pose"])
    assert pose.pose.pose.position.y == 2.0
    cloud = viewer.decode(CLOUD, seen[CLOUD])
    assert (cloud.header.frame_id, cloud.width) == ("map", 12)
    assert viewer.decode(GRID, seen[GRID]).info.width == 3


def test_the_map_comes_when_it_has_changed_and_not_too_often(sessions: tuple[ZenohBus, ZenohBus]) -> None:
    bus, console = sessions
    robot = ShownRobot(bus, frozenset())
    try:
        with FoxgloveBridge(console, port=0) as bridge, Viewer(bridge.port) as viewer:
            viewer.subscribe(CLOUD, GRID)
            arrivals: dict[str, list[tuple[float, int]]] = {CLOUD: [], GRID: []}
            begin = time.monotonic()
            while time.monotonic() - begin < 4.5:
                if len(robot.keyframes) < 30:
                    robot.grow()
                try:
                    topic, _, payload = viewer.next(0.1)
                except TimeoutError:
                    continue
                message = viewer.decode(topic, payload)
                size = message.width if topic == CLOUD else message.info.width
                if not arrivals[topic] or arrivals[topic][-1][1] != size:
                    arrivals[topic].append((time.monotonic(), size))
            # Whoever begins to look now gets what is there, though nothing changes any more.
            asked = robot.grids
            with Viewer(bridge.port) as late:
                late.subscribe(CLOUD, GRID)
                got = {late.next()[0] for _ in range(2)}
            assert got == {CLOUD, GRID}
            assert robot.grids == asked
    finally:
        robot.close()
    assert [size for _, size in arrivals[CLOUD]][-1] == 120
    assert [size for _, size in arrivals[GRID]][-1] == 30
    for topic, least_s in ((CLOUD, 0.9), (GRID, 1.8)):
        times = [at for at, _ in arrivals[topic]]
        assert 2 <= len(times) <= 6
        assert np.diff(times).min() > least_s


def test_telemetry_stands_in_where_poses_come_seldom(sessions: tuple[ZenohBus, ZenohBus]) -> None:
    bus, console = sessions
    robot = ShownRobot(bus, frozenset({"telemetry"}))
    try:
        with FoxgloveBridge(console, port=0) as bridge, Viewer(bridge.port) as viewer:
            bus.put(
                "tf", pose_messages.transforms([StampedTransform(1, "map", "odom", np.array([5.0, *[0.0] * 5, 1.0]))])
            )
            viewer.subscribe(f"/{PREFIX}/pose", "/tf")
            found: dict[str, Any] = {}
            end = time.monotonic() + LIMIT_S
            while len(found) < 2:
                assert time.monotonic() < end, found.keys()
                topic, _, payload = viewer.next()
                message = viewer.decode(topic, payload)
                if topic == "/tf" and len(message.transforms) < 2:
                    continue
                found[topic] = message
    finally:
        robot.close()
    pose = found[f"/{PREFIX}/pose"]
    assert pose.header.frame_id == "map"
    assert pose.pose.pose.position.x >= 1.0
    assert pose.pose.covariance[0] == pytest.approx(0.02**2)
    names = [(entry.header.frame_id, entry.child_frame_id) for entry in found["/tf"].transforms]
    assert names == [("map", "odom"), ("odom", "base_link")]


def test_the_chain_of_frames_leads_to_telemetrys_pose() -> None:
    state = telemetry.decode(telemetry_message(3))
    T_map_odom = np.eye(4)
    T_map_odom[:3, 3] = [5.0, -1.0, 0.25]
    message = deserialize(foxglove_telemetry.transforms(state, T_map_odom) or b"", "tf2_msgs/msg/TFMessage")
    translations = [entry.transform.translation for entry in message.transforms]
    assert sum(t.x for t in translations) == pytest.approx(state.pose[0], abs=1e-6)
    assert sum(t.y for t in translations) == pytest.approx(state.pose[1], abs=1e-6)
    assert foxglove_telemetry.map_to_odom(MOUNTS) is None


def test_telemetry_keeps_out_of_the_way_of_poses_at_rate() -> None:
    pace = foxglove_telemetry.Pace()
    assert pace.seldom(0.0)
    pace.came(10.0)
    assert pace.seldom(10.1)
    pace.came(10.04)
    assert not pace.seldom(10.1)
    assert pace.seldom(10.6)
    pace.came(11.0)
    assert pace.seldom(11.1)


def test_it_ends_when_it_is_told_to(sessions: tuple[ZenohBus, ZenohBus]) -> None:
    stop, addresses = threading.Event(), []

    def ready(address: str) -> None:
        addresses.append(address)
        with Viewer(int(address.rsplit(":", 1)[1])):
            stop.set()

    serve_foxglove(sessions[1], "127.0.0.1", 0, stop, ready)
    address = "127.0.0.1", int(addresses[0].rsplit(":", 1)[1])
    # The server's own threads close its socket a moment later.
    end = time.monotonic() + LIMIT_S
    while listens(address):
        assert time.monotonic() < end


def listens(address: tuple[str, int]) -> bool:
    try:
        socket.create_connection(address, timeout=2.0).close()
    except ConnectionRefusedError:
        return False
    except OSError:
        # Reset: it is about to close.
        return True
    return True


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.7.2", "robot.local"])
def test_it_serves_this_machine_only(sessions: tuple[ZenohBus, ZenohBus], host: str) -> None:
    with pytest.raises(ConfigurationError, match="anybody there could look"):
        FoxgloveBridge(sessions[1], 0, host)


def test_a_port_that_is_taken_is_one_line(sessions: tuple[ZenohBus, ZenohBus]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigurationError, match=f"Foxglove on 127.0.0.1:{port}: Failed to bind") as caught:
            FoxgloveBridge(sessions[1], port=port)
    assert "\n" not in str(caught.value)


def test_the_console_serves_foxglove_on_its_own_session() -> None:
    [port] = free_ports(1)
    with ZenohBus(ZenohSettings(listen=(f"tcp/127.0.0.1:{port}",)), PREFIX) as bus:
        robot = ShownRobot(bus)
        command = program(
            "operator", "--connect", f"tcp/127.0.0.1:{port}", "--port", "0", "--foxglove", "0", "--no-open"
        )
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as console:
            try:
                assert console.stdout is not None
                said = console.stdout.readline()
                assert said.startswith("Foxglove: ws://127.0.0.1:")
                with Viewer(int(said.rsplit(":", 1)[1])) as viewer:
                    viewer.subscribe(f"/{PREFIX}/pose")
                    topic, _, payload = viewer.next()
                    assert viewer.decode(topic, payload).pose.pose.position.y == 2.0
                # One session for both, so that a slow link carries everything once.
                assert bus.links() == 1
            finally:
                console.kill()
                robot.close()


def test_foxglove_is_not_for_recordings(tmp_path: Path) -> None:
    recording = tmp_path / "drive.mcap"
    recording.touch()
    with pytest.raises(ConfigurationError, match="Foxglove opens a recording"):
        operator.main(["--recording", str(recording), "--foxglove"], standalone_mode=False)
