"""Recordings: written, read back by us and by an independent decoder, cut, damaged, missing, made by others."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as IndependentWriter

from drivers.ground_truth import GroundTruth
from drivers.measurement import (
    HallFrame,
    ImuSample,
    Measurement,
    OdometrySample,
    ScrewAngles,
    ScrewSpeeds,
)
from drivers.measurement_messages import encode
from drivers.recording_format import RecordingError, resolve_topics
from drivers.recording_reader import Recording
from drivers.recording_writer import RecordingWriter
from drivers.ros_messages import schema_text

START = 1_700_000_000_000_000_000
FRAME_NS = 40_000_000
LAYOUT = b'{"name": "thesis-grid"}'


def measurements(frames: int = 50) -> list[tuple[int, Measurement]]:
    """(log time, measurement) as they arrive: whiskers a frame later than they were read."""
    rng = np.random.default_rng(1)
    found: list[tuple[int, Measurement]] = []
    valid = np.ones((8, 8), dtype=np.bool_)
    valid[3, 4] = False
    for k in range(frames):
        stamp = START + k * FRAME_NS
        field = np.round(rng.normal(0.0, 30.0, (8, 8, 3)) * 64) / 64
        field[~valid] = 0.0
        found.append((stamp + 10_000_000, HallFrame(stamp, field, valid, 156_000)))
        found.append((stamp + 1_000_000, ImuSample(stamp, rng.normal(size=3), rng.normal(size=3))))
        found.append((stamp + 2_000_000, ScrewAngles(stamp, rng.normal(size=4))))
        found.append((stamp + 3_000_000, OdometrySample(stamp, rng.normal(size=3))))
        speed = np.array([np.nan, float(k), np.nan, np.nan])
        found.append((stamp + 4_000_000, ScrewSpeeds(stamp, speed)))
    return found


def truth(k: int) -> GroundTruth:
    pose = np.array([0.01 * k, 0.5, -0.25, 0.0, 0.0, 0.6, 0.8])
    return GroundTruth(START + k * FRAME_NS, pose, np.arange(6.0) + k)


def write(path: Path, frames: int = 50, **options: object) -> list[tuple[int, Measurement]]:
    written = measurements(frames)
    with RecordingWriter(path, attachments={"layout.json": LAYOUT}, **options) as recording:
        for log_time, measurement in written:
            recording.write_measurement(measurement, log_time)
        for k in range(frames):
            recording.write_ground_truth(truth(k))
    return written


def assert_same(found: Measurement, expected: Measurement) -> None:
    assert type(found) is type(expected)
    assert found.stamp_ns == expected.stamp_ns
    match expected:
        case HallFrame():
            np.testing.assert_array_equal(found.field_mT, expected.field_mT)
            np.testing.assert_array_equal(found.valid, expected.valid)
            assert found.sensor_period_ns == expected.sensor_period_ns
        case ImuSample():
            np.testing.assert_array_equal(found.gyro, expected.gyro)
            np.testing.assert_array_equal(found.acceleration, expected.acceleration)
            assert found.orientation_xyzw is None
        case ScrewAngles():
            np.testing.assert_array_equal(found.angle, expected.angle)
        case OdometrySample():
            np.testing.assert_array_equal(found.velocity, expected.velocity)
        case ScrewSpeeds():
            np.testing.assert_allclose(found.speed, expected.speed, rtol=1e-6)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_recording_comes_back_in_the_order_of_log_time(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "run.mcap"
    # Small chunks, so that the order has to be found across them.
    written = write(path, compression=compression, chunk_bytes=4096)
    recording = Recording(path)
    found = list(recording)
    expected = sorted(written, key=lambda item: item[0])
    assert [log_time for log_time, _ in found] == [log_time for log_time, _ in expected]
    for (_, measurement), (_, original) in zip(found, expected, strict=True):
        assert_same(measurement, original)
    assert recording.complete
    assert recording.attachments() == {"layout.json": LAYOUT}
    assert recording.metadata == {"sensor_period_us": "156"}
    assert recording.sensor_period_ns == 156_000
    assert recording.message_count == 6 * 50
    assert recording.topics["rear_right/motor_module"].count == 50
    assert recording.duration_ns == 49 * FRAME_NS + 10_000_000
    assert recording.counters == {"messages": 250}


def test_ground_truth_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write(path, frames=3)
    for k, (log_time, found) in enumerate(Recording(path).ground_truth()):
        assert log_time == found.stamp_ns == truth(k).stamp_ns
        np.testing.assert_array_equal(found.pose, truth(k).pose)
        np.testing.assert_array_equal(found.twist, truth(k).twist)
    assert k == 2


def test_an_independent_decoder_reads_every_message(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written = write(path, frames=4)
    seen: dict[str, list[object]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            seen.setdefault(channel.topic, []).append((message, decoded))
    assert set(seen) == {
        "whiskers", "imu", "screws", "odometry/twist", "rear_right/motor_module", "ground_truth"
    }  # fmt: skip
    frames = [item for item in written if isinstance(item[1], HallFrame)]
    for (message, decoded), (log_time, frame) in zip(seen["whiskers"], frames, strict=True):
        assert message.log_time == log_time
        assert message.publish_time == frame.stamp_ns
        assert decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec == frame.stamp_ns
        assert (decoded.num_mux, decoded.num_sensors, decoded.representation) == (8, 8, "Cartesian")
        for whisker in decoded.whiskers:
            row, col = whisker.pos.row_num, whisker.pos.col_num
            assert whisker.has_error != frame.valid[row, col]
            assert [whisker.x, whisker.y, whisker.z] == frame.field_mT[row, col].tolist()
    _, last = seen["ground_truth"][-1]
    assert (last.header.frame_id, last.child_frame_id) == ("map", "base_link")
    assert last.pose.pose.orientation.w == 0.8
    _, motor = seen["rear_right/motor_module"][3]
    assert motor.motor_rpm == pytest.approx(3.0 * 60.0 / (2.0 * np.pi))


def test_a_recording_of_the_robots_own_software_is_read(tmp_path: Path) -> None:
    """Topics with a slash, motors named by number, an accelerometer only; written by another library."""
    path = tmp_path / "rm3.mcap"
    stamp = {"sec": 5, "nanosec": 7}
    zeros = [0.0] * 9
    whiskers = [
        {"pos": {"row_num": k // 2, "col_num": k % 2, "offset_y": 0.0}, "has_error": False, "x": k, "y": 2, "z": 3}
        for k in range(4)
    ]
    with path.open("wb") as file:
        writer = IndependentWriter(file)

        def add(topic: str, typename: str, message: dict[str, object], time: int) -> None:
            schema = writer.register_msgdef(typename, schema_text(typename))
            writer.write_message(topic, schema, message, time, time)

        head = {"stamp": stamp, "frame_id": "front_right"}
        add(
            "/front_right/motor_module", "robominer_msgs/msg/MotorModuleFeedback",
            {"header": head, "motor_id": "0", "motor_rpm": 60.0, "motor_current_ma": 0, "motor_voltage_v": 0}, 3
        )  # fmt: skip
        add(
            "/whiskers", "robominer_msgs/msg/WhiskerArray",
            {"header": head, "num_mux": 2, "num_sensors": 2, "representation": "Cartesian", "whiskers": whiskers}, 2
        )  # fmt: skip
        add(
            "/imu", "sensor_msgs/msg/Imu",
            {
                "header": head,
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}, "orientation_covariance": [-1.0, *zeros[1:]],
                "angular_velocity": {"x": 0.0, "y": 0.0, "z": 0.0}, "angular_velocity_covariance": [-1.0, *zeros[1:]],
                "linear_acceleration": {"x": 0.5, "y": 0.0, "z": 0.0}, "linear_acceleration_covariance": zeros,
            }, 1
        )  # fmt: skip
        add("/joy", "std_msgs/msg/Header", head, 4)
        writer.finish()
    recording = Recording(path, {"whiskers": "/whiskers"})
    (imu_time, imu), (_, hall), (_, speeds) = list(recording)
    assert isinstance(imu, ImuSample)
    assert (imu_time, imu.stamp_ns) == (1, 5 * 10**9 + 7)
    assert imu.gyro is None
    assert imu.orientation_xyzw is None
    assert imu.acceleration is not None
    assert imu.acceleration.tolist() == [0.5, 0.0, 0.0]
    assert isinstance(hall, HallFrame)
    assert hall.field_mT[1, 1].tolist() == [3.0, 2.0, 3.0]
    assert hall.sensor_period_ns == 0
    assert isinstance(speeds, ScrewSpeeds)
    assert speeds.speed[0] == pytest.approx(2 * np.pi)
    assert recording.counters["unknown_topic"] == 1


def test_topics_under_other_names_are_taken_from_the_mapping(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sample = OdometrySample(START, np.array([1.0, 2.0, 3.0]))
    with RecordingWriter(path) as recording:
        recording.write("/wheels/odom", "geometry_msgs/msg/TwistStamped", _twist(sample), START)
    assert list(Recording(path)) == []
    [(_, found)] = list(Recording(path, {"odometry": "wheels/odom"}))
    assert_same(found, sample)


def _twist(sample: OdometrySample) -> bytes:
    return encode(sample)[0][2]


def test_impossible_topic_mappings_are_refused() -> None:
    with pytest.raises(RecordingError, match=r"\[topics\] whisker: unknown; expected one of whiskers, imu"):
        resolve_topics({"whisker": "/whiskers"})
    with pytest.raises(RecordingError, match="both 'imu'"):
        resolve_topics({"whiskers": "/imu"})
    assert "imu" not in resolve_topics({"imu": ""})
    assert resolve_topics({"odometry/twist": "/vel"})["vel"] == "odometry"


def test_a_topic_of_another_type_is_warned_of_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as recording:
        for k in range(3):
            data = _twist(OdometrySample(START))
            recording.write("imu", "geometry_msgs/msg/TwistStamped", data, START + k)
    with caplog.at_level(logging.WARNING):
        recording = Recording(path)
        assert list(recording) == []
    assert recording.counters == {"wrong_type": 3}
    [warning] = caplog.messages
    assert "imu is geometry_msgs/msg/TwistStamped (cdr), expected sensor_msgs/msg/Imu" in warning


def test_a_file_cut_in_the_middle_gives_what_is_left_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.mcap"
    written = write(path, frames=100, chunk_bytes=8192)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 5])
    with caplog.at_level(logging.WARNING):
        recording = Recording(path)
        found = list(recording)
    assert "cut before its end" in caplog.text
    assert not recording.complete
    assert recording.sensor_period_ns == 156_000
    assert recording.attachments() == {"layout.json": LAYOUT}
    times = [log_time for log_time, _ in found]
    assert times == sorted(times)
    assert 0.4 * len(written) < len(found) < len(written)
    expected = {(t, type(m)): m for t, m in written}
    for log_time, measurement in found:
        assert_same(measurement, expected[log_time, type(measurement)])


@pytest.mark.parametrize("keep", [8, 9, 40, 200])
def test_a_file_cut_before_its_first_message_is_one_clear_error(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "run.mcap"
    write(path, frames=5)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError, match=r"run\.mcap: cut or damaged, and no message"):
        Recording(path)


def test_a_file_damaged_inside_is_an_error_and_never_wrong_data(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written = write(path, frames=100, chunk_bytes=8192, compression="none")
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 2] ^= 0x40
    path.write_bytes(whole)
    expected = {(t, type(m)): m for t, m in written}
    found: list[tuple[int, Measurement]] = []
    with pytest.raises(RecordingError, match="damaged inside"):
        found.extend(Recording(path))
    assert 0 < len(found) < len(written)
    for log_time, measurement in found:
        assert_same(measurement, expected[log_time, type(measurement)])


def test_missing_files_folders_and_other_files_are_one_clear_line(tmp_path: Path) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("not a recording")
    for path, text in (
        (tmp_path / "nothing.mcap", "No such file"),
        (tmp_path, "Is a directory"),
        (other, "expected an MCAP file"),
    ):
        with pytest.raises(RecordingError) as caught:
            Recording(path)
        assert str(path) in str(caught.value)
        assert text in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(RecordingError, match="cannot create the recording"):
        RecordingWriter(tmp_path / "nowhere" / "run.mcap")


def test_a_full_disk_is_one_clear_line() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")

    def fill() -> None:
        with RecordingWriter("/dev/full", chunk_bytes=1000) as recording:
            for k in range(100):
                recording.write_measurement(ImuSample(k, np.zeros(3), np.zeros(3)))

    with pytest.raises(RecordingError, match="/dev/full: cannot write the recording: No space left"):
        fill()


def test_messages_outside_chunks_are_read_too(tmp_path: Path) -> None:
    path = tmp_path / "flat.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start(profile="ros2")
        typename = "geometry_msgs/msg/TwistStamped"
        schema = writer.register_schema(typename, "ros2msg", schema_text(typename).encode())
        channel = writer.register_channel("odometry/twist", "cdr", schema)
        for k in (2, 1):
            writer.add_message(channel, k, _twist(OdometrySample(k)), k)
        writer.finish()
    assert [log_time for log_time, _ in Recording(path)] == [1, 2]


def test_an_impossible_sensor_period_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, metadata={"sensor_period_us": "soon"}):
        pass
    with pytest.raises(RecordingError, match="sensor_period_us is 'soon', expected microseconds"):
        Recording(path)


def test_a_changing_sensor_period_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    field, valid = np.zeros((1, 1, 3)), np.ones((1, 1), dtype=np.bool_)
    with RecordingWriter(tmp_path / "run.mcap", sensor_period_us=100) as recording:
        recording.write_measurement(HallFrame(0, field, valid, 100_000))
        assert caplog.messages == []
        recording.write_measurement(HallFrame(1, field, valid, 200_000))
        recording.write_measurement(HallFrame(2, field, valid, 200_000))
    assert len(caplog.messages) == 1
