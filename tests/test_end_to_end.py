"""The whole daemon as a process, through pseudo-terminals and Zenoh, against the simulator's truth."""

from __future__ import annotations

import json
import os
import queue
import signal
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from drivers.ros_messages import deserialize, time_to_ns
from robominer_slam import geometry
from robominer_slam.cli.evaluate import read_tum
from robominer_slam.cli.main import cli
from robominer_slam.evaluation.metrics import trajectory_errors
from robominer_slam.evaluation.pose_graph_errors import closure_errors
from robominer_slam.evaluation.trajectory import Trajectory
from robominer_slam.operator import saved_maps
from robominer_slam.publishing import telemetry
from robominer_slam.publishing.map_state import MapState
from robominer_slam.publishing.map_stream import MapStreamDecoder
from robominer_slam.publishing.zenoh_session import QueryError, ZenohBus, ZenohSettings
from sim_backend.demo import free_port, program

DRIVE_S = 16.0
#: One for each quarter of a metre; starting takes its time.
LEAST_KEYFRAMES = 5


@dataclass
class Heard:
    """What came over Zenoh."""

    pose: list[tuple[int, np.ndarray, np.ndarray]] = field(default_factory=list)
    odom: list[tuple[int, np.ndarray]] = field(default_factory=list)
    latency_s: list[float] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    status: queue.Queue[dict[str, dict[str, str]]] = field(default_factory=queue.Queue)
    telemetry: list[telemetry.Telemetry] = field(default_factory=list)
    updates: list[bytes] = field(default_factory=list)

    def trajectory(self) -> Trajectory:
        return Trajectory(np.array([s for s, _, _ in self.pose]), np.array([T for _, T, _ in self.pose]))


def matrix(pose) -> np.ndarray:
    p, q = pose.position, pose.orientation
    return geometry.pose_matrix([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])


def subscribe(bus: ZenohBus, heard: Heard) -> None:
    def on_pose(received) -> None:
        message = deserialize(received.payload, "geometry_msgs/msg/PoseWithCovarianceStamped")
        stamp = time_to_ns(message.header.stamp)
        heard.latency_s.append(time.time() - stamp * 1e-9)
        heard.pose.append((stamp, matrix(message.pose.pose), np.array(message.pose.covariance).reshape(6, 6)))

    def on_odom(received) -> None:
        message = deserialize(received.payload, "nav_msgs/msg/Odometry")
        heard.odom.append((time_to_ns(message.header.stamp), matrix(message.pose.pose)))

    def on_points(received) -> None:
        heard.contacts.append(deserialize(received.payload, "sensor_msgs/msg/PointCloud2").width)

    def on_status(received) -> None:
        message = deserialize(received.payload, "diagnostic_msgs/msg/DiagnosticArray")
        heard.status.put(
            {s.name: {"": s.message, **{value.key: value.value for value in s.values}} for s in message.status}
        )

    bus.subscriber("pose", on_pose)
    bus.subscriber("odom", on_odom)
    bus.subscriber("whiskers/points", on_points)
    bus.subscriber("status", on_status)
    bus.subscriber("telemetry", lambda received: heard.telemetry.append(telemetry.decode(received.payload)))
    bus.subscriber("map/updates", lambda received: heard.updates.append(received.payload))


def wait_until(condition, seconds: float, what: str) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"{what} not within {seconds} s"
        time.sleep(0.02)


def connect(endpoint: str) -> ZenohBus:
    retry = {"connect/retry": {"period_init_ms": 50, "period_max_ms": 100, "period_increase_factor": 1}}
    return ZenohBus(
        ZenohSettings(connect=(endpoint,), mode="client", connect_timeout_s=30.0, further=retry), "robominer/rm3"
    )


@dataclass
class Drive:
    """A finished drive: what was heard, the truth, the answers to queries, and how the daemon ended."""

    heard: Heard
    truth: Trajectory
    graph: dict
    cloud_points: int
    snapshot: list[bytes]
    last_status: dict[str, dict[str, str]]
    closures: dict
    listed: list[saved_maps.SavedMapEntry]
    fetched: MapState
    folder: Path
    exit_code: int
    log: str
    commands: dict[str, dict]
    bad_query: str
    updates: list[bytes]
    new_graph: dict


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    folder = tmp_path_factory.mktemp("drive")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    simulate = program("simulate", "--max-time", str(DRIVE_S), "--out", str(folder), "--listen", endpoint, "--json")
    with (folder / "run.log").open("wb") as log:
        simulator = subprocess.Popen(simulate, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment)
        daemon = None
        try:
            assert simulator.stdout is not None
            ready = json.loads(simulator.stdout.readline())
            daemon = subprocess.Popen(program("run", "--config", ready["configuration"]), stderr=log, env=environment)
            heard = Heard()
            with connect(endpoint) as bus:
                subscribe(bus, heard)
                assert simulator.wait(DRIVE_S + 60) == 0
                # 25 frames a second; all but those before the subscription and the clock's first round trip.
                wait_until(lambda: len(heard.pose) >= 0.95 * 25 * DRIVE_S, 10, "the poses")
                wait_until(lambda: json.loads(ask(bus, "map/graph"))["version"] >= LEAST_KEYFRAMES, 10, "the map")
                graph = json.loads(ask(bus, "map/graph"))
                cloud = deserialize(ask(bus, "map/cloud"), "sensor_msgs/msg/PointCloud2")
                snapshot = [received.payload for received in bus.get("map/snapshot")]
                deserialize(ask(bus, "map/grid"), "nav_msgs/msg/OccupancyGrid")
                commands = {
                    name: json.loads(bus.get(f"cmd/{name}", parameters)[0].payload)
                    for name, parameters in (
                        ("pause", {"id": "1"}),
                        ("resume", {"id": "2"}),
                        ("save_map", {"name": "test", "id": "3"}),
                        ("localize", {"x": "40", "y": "0", "yaw": "0"}),
                        ("dance", {}),
                    )
                }
                while not heard.status.empty():
                    heard.status.get()
                last_status = heard.status.get(timeout=5)
                updates = list(heard.updates)
                closures = json.loads(ask(bus, "map/closures"))
                listed = saved_maps.listed(bus)
                fetched = saved_maps.fetch(bus, listed[0].number)
                with pytest.raises(QueryError, match="the robot has none such"):
                    saved_maps.fetch(bus, 99)
                assert json.loads(bus.get("cmd/new_map", {"id": "4"})[0].payload)["ok"]
                assert json.loads(bus.get("cmd/new_map", {"id": "4"})[0].payload)["ok"]
                new_graph = json.loads(ask(bus, "map/graph"))
                with pytest.raises(QueryError) as bad_query:
                    bus.get("map/nothing", timeout_s=1.0)
            daemon.send_signal(signal.SIGTERM)
            exit_code = daemon.wait(20)
        finally:
            for process in (simulator, daemon):
                if process is not None and process.poll() is None:
                    process.kill()
                    process.wait()
    return Drive(
        heard, read_tum(Path(ready["truth"])), graph, int(cloud.width), snapshot, last_status, closures, listed,
        fetched, folder, exit_code,
        (folder / "run.log").read_text(), commands, str(bad_query.value), updates, new_graph,
    )  # fmt: skip


def ask(bus: ZenohBus, key: str) -> bytes:
    return bus.get(key, timeout_s=10.0)[0].payload


def test_saved_maps_are_listed_and_fetched_and_closures_told(drive: Drive):
    [entry] = drive.listed
    assert (entry.name, entry.present) == ("test", True)
    assert entry.keyframes >= len(drive.graph["keyframes"])
    # Read back from the disk it is the map that was heard, in the same frame.
    heard = {one["id"]: np.array(one["pose"][:3]) for one in drive.graph["keyframes"]}
    assert drive.fetched.keyframes.keys() >= heard.keys()
    assert max(np.abs(drive.fetched.keyframes[key].vector7()[:3] - place).max() for key, place in heard.items()) < 0.02
    assert len(drive.fetched.cloud()) > 0.1 * drive.cloud_points
    loops = [[edge["i"], edge["j"]] for edge in drive.graph["edges"] if edge["kind"] == "loop"]
    assert drive.closures["pairs"][: len(loops)] == loops
    assert drive.closures["total"] >= len(loops)


def test_poses_are_near_the_truth_and_every_frame_has_one(drive: Drive):
    errors = trajectory_errors(drive.heard.trajectory(), drive.truth)
    # 14 s of driving at 0.15 m/s with slip: dead reckoning alone errs by centimetres.
    assert errors.position.mean() < 0.10
    assert np.rad2deg(errors.heading).max() < 2.0
    stamps = np.diff([stamp for stamp, _, _ in drive.heard.pose]) * 1e-6
    assert np.percentile(stamps, 99) < 45.0


def test_stamps_are_those_of_the_frames_first_sensor(drive: Drive):
    """Truth is stamped when the simulated instant occurs: the published stamps must fall on the same instants."""
    stamps = np.array([stamp for stamp, _, _ in drive.heard.pose])
    nearest = np.abs(stamps[:, None] - drive.truth.stamps_ns[None, :]).min(axis=1)
    assert np.median(nearest) < 2_000_000
    # A frame takes 38 ms to read; poses come soon after.
    assert np.median(drive.heard.latency_s) < 0.15


def test_the_covariance_is_a_covariance(drive: Drive):
    for _, _, covariance in drive.heard.pose[:: len(drive.heard.pose) // 10]:
        assert np.linalg.eigvalsh(covariance).min() >= -1e-12
        # The first pose is the map's origin: known by definition.
        assert 0 <= covariance[0, 0] < 1.0
    assert drive.heard.pose[-1][2][0, 0] > 1e-6


def test_whiskers_touch_and_the_map_is_made_of_their_contacts(drive: Drive):
    assert np.median(drive.heard.contacts) > 48
    assert drive.cloud_points > 500
    assert len(drive.graph["keyframes"]) >= LEAST_KEYFRAMES
    assert {edge["kind"] for edge in drive.graph["edges"]} >= {"odometry"}
    assert len(closure_errors(drive.graph, drive.truth)) == sum(e["kind"] == "loop" for e in drive.graph["edges"])


def test_the_map_stream_and_the_snapshot_lead_to_the_robots_map(drive: Drive):
    from_snapshot, from_updates = MapStreamDecoder(), MapStreamDecoder()
    for message in drive.snapshot:
        from_snapshot.feed(message)
    for message in drive.updates:
        from_updates.feed(message)
    digest = drive.last_status["localization"]["map.digest"]
    assert from_snapshot.state is not None
    assert from_snapshot.state.digest().hex() == digest
    assert from_updates.state is not None
    assert from_updates.state.digest().hex() == digest


def test_status_and_telemetry_say_how_it_is(drive: Drive):
    assert drive.last_status["localization"]["localization.state"] == "tracking"
    assert drive.last_status["device/whiskers"]["count.packets"].isdigit()
    assert float(drive.last_status["device/imu"]["clock.uncertainty_us"]) < 50_000
    last = drive.heard.telemetry[-1]
    stamp, T, _ = min(drive.heard.pose, key=lambda entry: abs(entry[0] - last.stamp_ns))
    assert stamp == last.stamp_ns
    np.testing.assert_allclose(last.pose[:3], T[:3, 3], atol=1e-5)
    assert 3.0 < len(drive.heard.telemetry) / DRIVE_S < 4.5


def test_commands_are_answered(drive: Drive):
    assert {name: answer["ok"] for name, answer in drive.commands.items()} == {
        "pause": True, "resume": True, "save_map": True, "localize": False, "dance": False,
    }  # fmt: skip
    assert "unknown command 'dance'" in drive.commands["dance"]["message"]
    assert "no answer" in drive.bad_query


def test_a_new_map_is_empty_and_a_repeated_command_does_nothing_twice(drive: Drive):
    assert drive.new_graph["keyframes"] == []
    assert drive.new_graph["version"] > drive.graph["version"]


def test_the_daemon_ends_cleanly_and_the_keyframes_are_in_the_database(drive: Drive):
    assert drive.exit_code == 0, drive.log
    assert "Traceback" not in drive.log
    connection = sqlite3.connect(drive.folder / "map.db")
    try:
        (stored,) = connection.execute("SELECT count(*) FROM keyframes").fetchone()
        names = connection.execute("SELECT name FROM maps").fetchall()
    finally:
        connection.close()
    assert stored >= len(drive.graph["keyframes"])
    # The map that was saved, and the one that new_map began (once, though the command came twice).
    assert names == [("test",), ("",)]


def test_the_demo_without_slam_gives_exactly_the_odometry(tmp_path: Path):
    command = program("demo", "--method", "none", "--max-time", "8", "--json", "--out", str(tmp_path))
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["slam"]["position_m"]["mean"] < 0.1
    assert (report["keyframes"], report["loop_closures"]) == (0, 0)
    slam, odometry = (read_tum(tmp_path / name) for name in ("slam.tum", "odometry.tum"))
    common = np.intersect1d(slam.stamps_ns, odometry.stamps_ns)
    assert len(common) >= len(slam) - 2
    np.testing.assert_array_equal(
        slam.T[np.isin(slam.stamps_ns, common)], odometry.T[np.isin(odometry.stamps_ns, common)]
    )
    for picture in ("path.png", "height_map.png", "pose_graph.png"):
        assert (tmp_path / picture).stat().st_size > 10_000


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.replace("[robot]", "[robots]"), "robots: unknown key"),
        (lambda t: t.replace('layout = "thesis-grid"', 'layout = "rm3"'), "the robot's layout is 'rm3' (10 x 8)"),
        (lambda t: t.replace("calibration.json", "none.json"), "none.json: the calibration cannot be read"),
        (lambda t: t.replace('calibration = "calibration.json"', ""), "expected calibration = 'FILE.json'"),
        (lambda t: t.replace("/dev/whiskers", "/dev/x").replace('port = "/', 'port = "'), "expected an absolute path"),
        (lambda t: t.replace("map.db", "config.toml"), "[store] path"),
        (lambda t: t.replace("tcp/127.0.0.1", "tcp/192.0.2.1"), "zenoh.listen: expected a loopback address"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(drive: Drive, tmp_path: Path, change, expected):
    for name in ("calibration.json",):
        (tmp_path / name).write_text((drive.folder / name).read_text())
    text = (drive.folder / "config.toml").read_text()
    (tmp_path / "config.toml").write_text(change(text.replace(str(drive.folder / "map.db"), str(tmp_path / "map.db"))))
    done = subprocess.run(
        program("run", "--config", str(tmp_path / "config.toml")),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, done.stderr
    assert expected in lines[0]
    assert "Traceback" not in done.stderr


def test_a_second_daemon_on_the_same_endpoint_is_refused(drive: Drive, tmp_path: Path):
    port = free_port()
    config = tmp_path / "config.toml"
    text = (drive.folder / "config.toml").read_text()
    lines = [f'listen = ["tcp/127.0.0.1:{port}"]' if s.startswith("listen") else s for s in text.splitlines()]
    config.write_text("\n".join(lines).replace(str(drive.folder / "map.db"), str(tmp_path / "map.db")))
    (tmp_path / "calibration.json").write_text((drive.folder / "calibration.json").read_text())
    first = subprocess.Popen(program("run", "--config", str(config)), stderr=subprocess.PIPE, text=True)
    try:
        assert first.stderr is not None
        for line in first.stderr:
            # The ports of the drive are gone: reported, and the daemon goes on.
            if "is not there" in line:
                break
        second = subprocess.run(
            program("run", "--config", str(config)), capture_output=True, text=True, timeout=60, check=False
        )
        assert second.returncode == 2
        assert "another program listens there" in second.stderr
        assert first.poll() is None
    finally:
        first.terminate()
        assert first.wait(20) == 0


def commands(group: click.Group, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every command and group of commands below a group, by name."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        yield (*path, name)
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))


def test_help_has_an_example_everywhere():
    every = list(commands(cli))
    assert len(every) > 30
    for path in ((), *every):
        done = CliRunner().invoke(cli, [*path, "--help"])
        assert done.exit_code == 0, done.output
        assert "Example" in done.output, path
