"""`record --connect`: what comes over the link, read again by other people's readers of MCAP."""

from __future__ import annotations

import contextlib
import json
import signal
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from drivers.recording_writer import RecordingWriter
from robominer_slam.publishing import telemetry
from robominer_slam.publishing.bus_messages import Reply
from robominer_slam.publishing.map_stream import MapStreamDecoder, MapStreamEncoder
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
from robominer_slam.recording.link_recorder import LinkRecorder
from sim_backend.demo import program
from tests.ros_node import MESSAGES, STAMP_NS, TOPICS, check_decoded
from tests.secured_robot import PREFIX, SecuredRobot, free_ports
from tests.shown_robot import Keyframe, ShownRobot, telemetry_message

LIMIT_S = 60.0
TELEMETRY, UPDATES, SNAPSHOT = (f"/{PREFIX}/{key}" for key in ("telemetry", "map/updates", "map/snapshot"))
CLOUD = f"/{PREFIX}/map/cloud"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    [port] = free_ports(1)
    with ZenohBus(ZenohSettings(listen=(f"tcp/127.0.0.1:{port}",)), PREFIX) as bus:
        robot = ShownRobot(bus)
        yield f"tcp/127.0.0.1:{port}"
        robot.close()


def record(*arguments: str, expect: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(program("record", *arguments), capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == expect, done.stderr
    assert "Traceback" not in done.stderr
    return done


@pytest.fixture(scope="module")
def recorded(endpoint: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("link") / "seen.mcap"
    done = record("--connect", endpoint, "--out", str(out), "--max-time", "1.6", "--json")
    summary = json.loads(done.stdout)
    assert summary["messages"] == sum(summary["counts"].values())
    assert set(summary["counts"]) >= {*TOPICS, TELEMETRY, CLOUD}
    assert summary["dropped"] == 0
    assert summary["bytes"] == out.stat().st_size
    return out


def test_ros_messages_are_read_by_mcap_ros2_support(recorded: Path) -> None:
    seen = set()
    with recorded.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=[*TOPICS, CLOUD]):
            assert schema is not None
            if channel.topic == CLOUD:
                assert decoded.width == 12
                assert decoded.header.frame_id == "map"
            else:
                assert schema.name == TOPICS[channel.topic]
                if channel.topic not in seen:
                    check_decoded(channel.topic, message.data)
                assert message.publish_time == STAMP_NS
            assert abs(message.log_time - time.time_ns()) < 600e9
            seen.add(channel.topic)
    assert seen == {*TOPICS, CLOUD}


def test_rosbags_reads_it_as_a_bag(recorded: Path, tmp_path: Path) -> None:
    with recorded.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    # What `ros2 bag reindex` writes beside a file.
    topics = [
        {
            "topic_metadata": {
                "name": channel.topic,
                "type": summary.schemas[channel.schema_id].name,
                "serialization_format": channel.message_encoding,
                "offered_qos_profiles": [],
            },
            "message_count": summary.statistics.channel_message_counts[channel.id],
        }
        for channel in summary.channels.values()
        if channel.message_encoding == "cdr"
    ]
    information = {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": [recorded.name],
        "duration": {"nanoseconds": 1},
        "starting_time": {"nanoseconds_since_epoch": summary.statistics.message_start_time},
        "message_count": summary.statistics.message_count,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
    }
    (tmp_path / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": information}))
    (tmp_path / recorded.name).symlink_to(recorded)
    store = get_typestore(Stores.ROS2_JAZZY)
    seen = set()
    with Reader(tmp_path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in {*TOPICS, CLOUD}]
        for connection, _, data in reader.messages(connections):
            store.deserialize_cdr(data, connection.msgtype)
            seen.add(connection.topic)
    assert seen == {*TOPICS, CLOUD}


def test_what_is_ours_says_what_it_is_and_gives_the_map_again(recorded: Path) -> None:
    decoder = MapStreamDecoder()
    stamps = []
    with recorded.open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages(topics=[TELEMETRY, UPDATES, SNAPSHOT]):
            assert schema is not None
            assert channel.message_encoding == "robominer_slam"
            assert "ayout: " in channel.metadata["format"]
            if channel.topic == TELEMETRY:
                assert schema.name == "robominer_slam/telemetry"
                state = telemetry.decode(message.data)
                assert message.publish_time == state.stamp_ns
                stamps.append(state.stamp_ns)
            else:
                assert schema.name == "robominer_slam/map_stream"
                decoder.feed(message.data)
    assert len(stamps) > 15
    assert stamps == sorted(stamps)
    assert decoder.state is not None
    assert decoder.state.cloud().shape == (12, 3)


def test_ctrl_c_ends_it_with_a_whole_file(endpoint: str, tmp_path: Path) -> None:
    out = tmp_path / "seen.mcap"
    with subprocess.Popen(
        program("record", "--connect", endpoint, "--out", str(out)), stdout=subprocess.PIPE, text=True
    ) as process:
        wait_for_bytes(out, 9_000)
        process.send_signal(signal.SIGINT)
        text, _ = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0
    assert f"{PREFIX}/pose" in text
    with out.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert CLOUD in {channel.topic for channel in summary.channels.values()}


def test_what_a_killed_recorder_wrote_is_read_up_to_then(endpoint: str, tmp_path: Path) -> None:
    out = tmp_path / "seen.mcap"
    with subprocess.Popen(program("record", "--connect", endpoint, "--out", str(out))) as process:
        wait_for_bytes(out, 9_000)
        process.kill()
        process.wait(LIMIT_S)
    seen: set[str] = set()
    with out.open("rb") as file:
        messages = iter(NonSeekingReader(file).iter_messages(log_time_order=False))
        # The file ends in the middle of something.
        with contextlib.suppress(McapError, EOFError, struct.error):
            while True:
                _, channel, message = next(messages)
                if channel.topic in TOPICS and channel.topic not in seen:
                    check_decoded(channel.topic, message.data)
                seen.add(channel.topic)
    assert seen >= {*TOPICS, TELEMETRY}


def wait_for_bytes(path: Path, count: int) -> None:
    end = time.monotonic() + LIMIT_S
    while not path.exists() or path.stat().st_size < count:
        assert time.monotonic() < end, "nothing was written"
        time.sleep(0.05)


def test_a_viewer_records_by_tls_what_a_viewer_may_see(tmp_path: Path) -> None:
    secured = SecuredRobot(tmp_path)
    with secured.bus:
        robot = ShownRobot(secured.bus)
        out = tmp_path / "seen.mcap"
        try:
            done = record(
                "--connect", secured.tls, "--credentials", str(secured.bundle("bob")), "--out", str(out),
                "--max-time", "1.5", "--json",
            )  # fmt: skip
        finally:
            robot.close()
    counts = json.loads(done.stdout)["counts"]
    assert counts[TELEMETRY] > 10
    # One a second over TLS.
    assert 1 <= counts[f"/{PREFIX}/pose"] <= 4
    assert counts["/tf_static"] == 1
    assert counts[CLOUD] == 1


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["--out", "/dev/full", "--max-time", "20"], 1, "/dev/full: cannot write the recording: No space left"),
        (["--out", "{folder}/no/seen.mcap"], 2, "cannot create the recording: No such file"),
        (["--out", "{folder}/there.mcap"], 2, "there.mcap: is there already"),
        (["--out", "{folder}/none.mcap", "--robot", "other", "--max-time", "0.5"], 1, "is the robot's id right"),
        (["--out", "{folder}/new.mcap", "--config", "{folder}/there.mcap"], 2, "expected either --config FILE"),
    ],
)
def test_what_cannot_be_is_one_line(
    endpoint: str, tmp_path: Path, arguments: list[str], code: int, expected: str
) -> None:
    (tmp_path / "there.mcap").write_bytes(b"precious")
    texts = [text.format(folder=tmp_path) for text in arguments]
    done = record("--connect", endpoint, *texts, expect=code)
    assert expected in done.stderr
    assert len([line for line in done.stderr.splitlines() if "rror: " in line]) == 1
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"
    assert [path.name for path in tmp_path.iterdir()] == ["there.mcap"]


def test_a_message_that_nobody_knows_here_is_said_once_and_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    [port] = free_ports(1)
    endpoint = f"tcp/127.0.0.1:{port}"
    with (
        ZenohBus(ZenohSettings(listen=(endpoint,)), PREFIX) as robot,
        ZenohBus(ZenohSettings(connect=(endpoint,), mode="client"), PREFIX) as operator,
        RecordingWriter(tmp_path / "seen.mcap") as writer,
    ):
        recorder = LinkRecorder(operator, writer)
        end = time.monotonic() + LIMIT_S
        while writer.counts.get(f"/{PREFIX}/pose", 0) < 3:
            assert time.monotonic() < end
            robot.put("odom", b"\0\1\0\0" + bytes(8), "application/cdr;strange_msgs/msg/Odometry")
            robot.put("telemetry", b"\1")
            robot.put("pose", MESSAGES["pose"])
            recorder.step(0.05)
        recorder.finish()
    assert set(writer.counts) == {f"/{PREFIX}/pose", TELEMETRY}
    assert caplog.text.count("strange_msgs/msg/Odometry") == 1


def test_the_map_of_before_is_asked_for(tmp_path: Path) -> None:
    [port] = free_ports(1)
    endpoint = f"tcp/127.0.0.1:{port}"
    encoder = MapStreamEncoder(0x77)
    encoder.update(1, [Keyframe(0, STAMP_NS, np.eye(3))], np.array([[1.0, 0, 0, 0, 0, 0, 1.0]]))
    with (
        ZenohBus(ZenohSettings(listen=(endpoint,)), PREFIX) as robot,
        ZenohBus(ZenohSettings(connect=(endpoint,), mode="client"), PREFIX) as operator,
        RecordingWriter(tmp_path / "seen.mcap") as writer,
    ):
        robot.queryable("map/snapshot", lambda _: Reply(b"".join(encoder.snapshot())))
        assert operator.answered("map/snapshot", LIMIT_S)
        recorder = LinkRecorder(operator, writer)
        end = time.monotonic() + LIMIT_S
        while SNAPSHOT not in writer.counts:
            assert time.monotonic() < end
            robot.put("telemetry", telemetry_message(1))
            recorder.step(0.05)
            recorder.tend()
        recorder.finish()
    assert writer.counts[CLOUD] == writer.counts[SNAPSHOT] == 1
    with (tmp_path / "seen.mcap").open("rb") as file:
        [(_, _, _, cloud)] = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages([CLOUD])
    assert cloud.width == 3
