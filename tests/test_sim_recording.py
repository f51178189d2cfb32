"""Simulated drives as recordings: packed tight, read by others' libraries, with what the whiskers really did."""

from __future__ import annotations

import functools
import io
import json
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rich.console import Console
from rosbags.highlevel import AnyReader

from drivers import ground_truth
from drivers.measurement import HallFrame
from drivers.recording_format import RecordingError
from drivers.recording_reader import Recording
from drivers.recording_repack import repack
from drivers.recording_writer import RecordingWriter
from drivers.ros_messages import MessageError
from robominer_slam import layout as layouts
from sim_backend.configuration_writer import write_calibration
from sim_backend.demo import program
from sim_backend.physics import rod_direction
from sim_backend.recording_progress import progress_bar
from sim_backend.robot import RobotSettings, build_robot
from sim_backend.simulate import SimulationSettings, record_drive

SCENARIOS = Path(__file__).parent / "recordings"
GRID = layouts.thesis_grid()
TOPICS = {
    "whiskers": "robominer_msgs/msg/WhiskerArray",
    "imu": "sensor_msgs/msg/Imu",
    "screws": "sensor_msgs/msg/JointState",
    "odometry/twist": "geometry_msgs/msg/TwistStamped",
    "ground_truth": "nav_msgs/msg/Odometry",
    "ground_truth/whiskers": "sensor_msgs/msg/PointCloud2",
}


def settings(folder: Path, **changes: object) -> SimulationSettings:
    return SimulationSettings(out=folder, engine="quasi-static", **changes)


@pytest.fixture(scope="module", autouse=True)
def one_fit_per_array(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("calibration")
    fitted = functools.cache(lambda seed: write_calibration(folder, GRID, seed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sim_backend.simulate.write_calibration", lambda _folder, _layout, seed: fitted(seed))
        yield


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    record_drive(settings(folder, robot=RobotSettings(max_time=12.0)), folder / "drive.mcap")
    return folder / "drive.mcap"


@pytest.fixture(scope="module")
def compact(plain: Path) -> Path:
    repack(plain, plain.with_name("compact.mcap"))
    return plain.with_name("compact.mcap")


def everything(path: Path) -> list[tuple[object, ...]]:
    """All messages with all their times, whatever the order of those logged at the same time."""
    with path.open("rb") as file:
        messages = [
            (m.log_time, channel.topic, schema.name, m.sequence, m.publish_time, m.data)
            for schema, channel, m in SeekingReader(file, validate_crcs=True).iter_messages()
        ]
    times = [message[0] for message in messages]
    assert times == sorted(times)
    return sorted(messages)


def test_a_compact_recording_is_the_same_recording_in_less_space(plain, compact):
    assert everything(compact) == everything(plain)
    before, after = Recording(plain), Recording(compact)
    assert after.complete
    assert (after.metadata, after.attachments()) == (before.metadata, before.attachments())
    assert (after.topics, after.duration_ns) == (before.topics, before.duration_ns)


def test_what_the_sensors_deliver_takes_a_fifth_less_space(plain, tmp_path):
    recording = Recording(plain)
    sensors, packed = tmp_path / "sensors.mcap", tmp_path / "packed.mcap"
    with RecordingWriter(sensors) as writer:
        for raw in recording.raw_messages(set(TOPICS) - {"ground_truth/whiskers"}):
            writer.write(raw.topic, raw.typename, raw.data, raw.log_time_ns, raw.publish_time_ns)
    repack(sensors, packed)
    assert packed.stat().st_size < 0.8 * sensors.stat().st_size


def test_a_compact_recording_says_truly_where_everything_is(compact):
    """Offsets, counts and checksums of the summary, against the file as it lies there."""
    content = compact.read_bytes()
    records = list(StreamReader(io.BytesIO(content), emit_chunks=True, validate_crcs=True).records)
    chunks = [record for record in records if type(record).__name__ == "Chunk"]
    with compact.open("rb") as file:
        summary = SeekingReader(file).get_summary()
    assert summary.statistics.chunk_count == len(chunks) == len(summary.chunk_indexes)
    assert summary.statistics.message_count == len(everything(compact))
    for index, chunk in zip(summary.chunk_indexes, chunks, strict=True):
        assert (index.compressed_size, index.uncompressed_size) == (len(chunk.data), chunk.uncompressed_size)
        assert (index.message_start_time, index.message_end_time) == (
            chunk.message_start_time,
            chunk.message_end_time,
        )
        assert content[index.chunk_start_offset] == 0x06
        assert {content[offset] for offset in index.message_index_offsets.values()} == {0x07}
        assert len(index.message_index_offsets) == len(TOPICS)
    for record in records:
        if type(record).__name__ == "Chunk":
            data = zstandard.decompress(record.data)
        if type(record).__name__ == "MessageIndex":
            for log_time, at in record.records:
                # Opcode, length, channel, sequence, log time.
                opcode, _, channel, _, found = struct.unpack_from("<BQHIQ", data, at)
                assert (opcode, channel, found) == (0x05, record.channel_id, log_time)


def test_a_compact_recording_that_is_cut_gives_whole_chunks(compact, tmp_path, monkeypatch):
    monkeypatch.setattr("drivers.recording_repack.CHUNK_BYTES", 200_000)
    small = tmp_path / "small.mcap"
    repack(compact, small)
    assert everything(small) == everything(compact)
    content = small.read_bytes()
    small.write_bytes(content[: len(content) * 4 // 5])
    cut = Recording(small)
    assert not cut.complete
    assert 20 < sum(isinstance(m, HallFrame) for _, m in cut) < 300


def test_what_cannot_be_repacked_is_one_clear_error(plain, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(plain.read_bytes()[:100_000])
    with pytest.raises(RecordingError, match=r"cut\.mcap: .*recover it with"):
        repack(cut, tmp_path / "out.mcap")
    with pytest.raises(RecordingError, match="No such file"):
        repack(tmp_path / "nothing.mcap", tmp_path / "out.mcap")


@pytest.mark.parametrize("which", ["plain", "compact"])
def test_rosbags_reads_every_message(which, request):
    path = request.getfixturevalue(which)
    with AnyReader([path]) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == TOPICS
        assert reader.message_count == sum(c.msgcount for c in reader.connections) == len(everything(path))
        times = []
        for connection, time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            times.append(time)
            if connection.topic == "whiskers":
                assert len(message.whiskers) == 64
        assert times == sorted(times)
        assert len(times) == reader.message_count


@pytest.mark.parametrize("which", ["plain", "compact"])
def test_mcap_ros2_support_reads_every_message(which, request):
    path = request.getfixturevalue(which)
    counts = dict.fromkeys(TOPICS, 0)
    truths = [truth for _, truth in Recording(path).whisker_truth()]
    with path.open("rb") as file:
        reader = SeekingReader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, _, decoded in reader.iter_decoded_messages():
            assert schema.name == TOPICS[channel.topic]
            if channel.topic == "ground_truth/whiskers":
                truth = truths[counts[channel.topic]]
                assert (decoded.header.frame_id, decoded.width, decoded.point_step) == ("base_link", 64, 36)
                names = [field.name for field in decoded.fields]
                assert names == list(ground_truth.WHISKER_POINT.names)
                [arm] = [field for field in decoded.fields if field.name == "arm"]
                seen = np.ndarray(64, "<f4", bytes(decoded.data), arm.offset, (decoded.point_step,))
                np.testing.assert_array_equal(seen, truth.arm.astype(np.float32))
            counts[channel.topic] += 1
    assert min(counts.values()) >= 300


@pytest.mark.parametrize("engine", ["quasi-static", "physics"])
def test_the_whiskers_truth_is_that_of_the_engine_in_base_link(engine, tmp_path, plain):
    seconds = 12.0
    if engine == "physics":
        plain, seconds = tmp_path / "drive.mcap", 2.0
        record_drive(SimulationSettings(out=tmp_path, robot=RobotSettings(max_time=seconds)), plain)
    recording = Recording(plain)
    frames = [m for _, m in recording if isinstance(m, HallFrame)]
    truths = [truth for _, truth in recording.whisker_truth()]
    assert [truth.stamp_ns for truth in truths] == [frame.stamp_ns for frame in frames]
    duration = len(frames) * 0.04
    assert duration == pytest.approx(seconds, abs=0.05)
    robot = build_robot("thesis", 1, engine, RobotSettings(max_time=duration))
    events = [event for event in robot.events() if hasattr(event, "field_mT")]
    touched = 0
    for truth, event in zip(truths, events, strict=True):
        np.testing.assert_array_equal(truth.contact, event.truth.contact)
        np.testing.assert_allclose(truth.hinge, event.truth.hinge, atol=1e-6)
        np.testing.assert_allclose(truth.inclination, event.truth.inclination, atol=1e-6)
        np.testing.assert_array_equal(np.isnan(truth.point).any(axis=1), ~truth.contact)
        np.testing.assert_array_equal(np.isnan(truth.arm), ~truth.contact)
        who = np.flatnonzero(truth.contact)
        touched += len(who)
        # The rod's axis passes the contact within its radius, half a diameter of 3 mm, and what it moves in 5 ms.
        direction = np.einsum("nij,nj->ni", GRID.R_base_whisker, rod_direction(truth.hinge))
        axis = GRID.p_base + truth.arm[:, None] * direction
        assert np.linalg.norm(truth.point[who] - axis[who], axis=1).max() < 0.004
        assert truth.arm[who].min() > 0.02
        assert truth.arm[who].max() < 0.152
    assert touched > 20 * len(frames)


def test_whisker_truth_can_be_left_out_and_is_not_replayed(plain, tmp_path):
    path = tmp_path / "drive.mcap"
    record_drive(settings(tmp_path, robot=RobotSettings(max_time=1.0), whisker_truth=False), path)
    recording = Recording(path)
    assert set(recording.topics) == set(TOPICS) - {"ground_truth/whiskers"}
    assert list(recording.whisker_truth()) == []
    whole = Recording(plain)
    assert len(list(whole)) == sum(
        topic.count for name, topic in whole.topics.items() if not name.startswith("ground_truth")
    )
    assert "unknown_topic" not in whole.counters


def test_clouds_that_are_no_whisker_truth_are_refused():
    truth = ground_truth.WhiskerTruth(
        5, np.zeros(2, dtype=bool), np.full((2, 3), np.nan), np.full(2, np.nan), np.ones(2), np.ones(2), np.ones((2, 2))
    )
    data = ground_truth.encode_whiskers(truth)
    assert ground_truth.decode_whiskers(data).stamp_ns == 5
    with pytest.raises(MessageError, match="points are not of x, y, z"):
        ground_truth.decode_whiskers(data.replace(b"arm\0", b"leg\0"))
    with pytest.raises(MessageError):
        ground_truth.decode_whiskers(data[:-20])


def test_the_same_seed_is_the_same_file_on_the_command_line_too(tmp_path):
    done = subprocess.run(
        program("simulate", "--engine", "quasi-static", "--max-time", "2", "--out", str(tmp_path / "sim"),
                "--record", str(tmp_path / "one.mcap"), "--compact", "--no-whisker-truth", "--json"),
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "ground_truth/whiskers" not in json.loads(done.stdout)["messages"]

    def make(name: str, seed: int) -> bytes:
        robot = RobotSettings(seed=seed, max_time=2.0)
        record_drive(settings(tmp_path, robot=robot, whisker_truth=False, compact=True), tmp_path / name)
        return (tmp_path / name).read_bytes()

    assert make("two.mcap", 1) == (tmp_path / "one.mcap").read_bytes()
    assert make("three.mcap", 2) != (tmp_path / "one.mcap").read_bytes()
    assert not list(tmp_path.glob("*.part"))


def test_a_terminal_is_shown_how_far_the_recording_is(tmp_path):
    shown = io.StringIO()
    with progress_bar("recording drive.mcap", Console(file=shown, force_terminal=True, width=100)) as on_progress:
        assert on_progress is not None
        record_drive(settings(tmp_path, robot=RobotSettings(max_time=1.0)), tmp_path / "drive.mcap", on_progress)
    assert "recording drive.mcap" in shown.getvalue()
    assert "100 %" in shown.getvalue()
    with progress_bar("nobody looks", Console(file=io.StringIO())) as on_progress:
        assert on_progress is None


@pytest.fixture(scope="module")
def scenarios() -> list[Path]:
    found = sorted(SCENARIOS.glob("scenario-*.mcap"))
    if not found:
        pytest.skip("no recordings in tests/recordings; `make recordings` makes them")
    return found


def test_the_five_scenarios_are_there_and_small(scenarios):
    assert [path.name for path in scenarios] == [f"scenario-{k}.mcap" for k in range(1, 6)]
    assert sum(path.stat().st_size for path in scenarios) <= 20_000_000
    for number, path in enumerate(scenarios, start=1):
        recording = Recording(path)
        assert recording.complete
        made_by = {key: recording.metadata[key] for key in ("world", "scenario", "engine", "seed", "odometry_seed")}
        assert made_by == {
            "world": "thesis", "scenario": str(number), "engine": "physics", "seed": "1", "odometry_seed": "0"
        }  # fmt: skip
        assert set(recording.topics) == set(TOPICS) - {"ground_truth/whiskers"}
        assert recording.duration_ns * 1e-9 > 70.0
        with AnyReader([path]) as reader:
            assert reader.message_count == recording.message_count


def test_the_scenarios_are_replayed(scenarios, tmp_path):
    """The first five seconds of each, all at the same time."""
    runs = []
    for path in scenarios:
        recording, short = Recording(path), tmp_path / path.name
        with RecordingWriter(
            short, sensor_period_us=recording.sensor_period_ns / 1000, attachments=recording.attachments()
        ) as writer:
            first = None
            for raw in recording.raw_messages():
                first = raw.log_time_ns if first is None else first
                if raw.log_time_ns - first > 5_000_000_000:
                    break
                writer.write(raw.topic, raw.typename, raw.data, raw.log_time_ns, raw.publish_time_ns)
        command = program("replay", str(short), "--tum", str(short.with_suffix(".tum")), "--json")
        runs.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
    for run in runs:
        out, errors = run.communicate(timeout=120)
        assert run.returncode == 0, errors
        summary = json.loads(out)
        assert summary["frames"] >= 123
        assert (summary["late"], summary["dropped"]) == (0, 0)
