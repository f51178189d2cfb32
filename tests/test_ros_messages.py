"""ROS messages without ROS: definitions, stamps, and measurements to messages and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rosbags.typesys import Stores, get_typestore

from drivers import whisker_array
from drivers.counters import Counters
from drivers.measurement import HallFrame, ImuSample, OdometrySample, ScrewAngles, ScrewSpeeds
from drivers.measurement_messages import (
    IMU,
    JOINT_STATE,
    MOTOR_FEEDBACK,
    ODOMETRY,
    TWIST_STAMPED,
    WHISKER_ARRAY,
    decode,
    encode,
)
from drivers.ros_definitions import DEFINITIONS
from drivers.ros_messages import (
    MessageError,
    deserialize,
    header,
    new,
    schema_text,
    serialize,
    time_from_ns,
    time_to_ns,
    typestore,
)

STAMP = 1_700_000_000_123_456_789


def hall_frame(rows: int = 8, cols: int = 8, seed: int = 0, representation: str = "Cartesian") -> HallFrame:
    rng = np.random.default_rng(seed)
    # Multiples of 1/64 mT, so that float32 in the message loses nothing.
    field = np.round(rng.normal(0.0, 40.0, (rows, cols, 3)) * 64.0) / 64.0
    valid = rng.random((rows, cols)) > 0.2
    field[~valid] = 0.0
    return HallFrame(STAMP, field, valid, 0, representation)


def joint_state(names: list[str], position: list[float], velocity: list[float]) -> bytes:
    message = new(
        JOINT_STATE,
        header=header(STAMP, ""),
        name=names,
        position=np.array(position, dtype=np.float64),
        velocity=np.array(velocity, dtype=np.float64),
        effort=np.zeros(0),
    )
    return serialize(message, JOINT_STATE)


def motor_feedback(motor_id: str, frame_id: str = "", rpm: float = 30.0, volts: float = 0.0) -> bytes:
    message = new(
        MOTOR_FEEDBACK,
        header=header(STAMP, frame_id),
        motor_id=motor_id,
        motor_rpm=rpm,
        motor_current_ma=0.0,
        motor_voltage_v=volts,
    )
    return serialize(message, MOTOR_FEEDBACK)


def test_definitions_are_those_of_ros_humble() -> None:
    humble = get_typestore(Stores.ROS2_HUMBLE)
    standard = [name for name in DEFINITIONS if not name.startswith("robominer_msgs")]
    assert len(standard) == 26
    for name in standard:
        assert typestore().hash_rihs01(name) == humble.hash_rihs01(name), name


def test_schema_text_lists_every_contained_type_once() -> None:
    text = schema_text(WHISKER_ARRAY)
    parts = text.split("=" * 80 + "\n")
    assert parts[0].startswith("std_msgs/Header header\n")
    names = [part.splitlines()[0] for part in parts[1:]]
    assert sorted(names) == [
        "MSG: builtin_interfaces/Time",
        "MSG: robominer_msgs/Whisker",
        "MSG: robominer_msgs/WhiskerPosInGrid",
        "MSG: std_msgs/Header",
    ]


@given(st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9))
def test_stamps_keep_every_nanosecond(stamp_ns: int) -> None:
    assert time_to_ns(time_from_ns(stamp_ns)) == stamp_ns
    assert 0 <= time_from_ns(stamp_ns).nanosec < 10**9


@pytest.mark.parametrize("cut", [0, 3, 4, 11, 40, -4])
def test_bytes_that_are_no_message_raise_a_message_error(cut: int) -> None:
    data = encode(ImuSample(STAMP, np.zeros(3), np.zeros(3)))[0][2]
    with pytest.raises(MessageError, match="sensor_msgs/msg/Imu"):
        deserialize(data[:cut], IMU)


@given(st.binary(max_size=300), st.sampled_from([IMU, JOINT_STATE, MOTOR_FEEDBACK, WHISKER_ARRAY]))
def test_garbage_is_counted_and_never_raises(data: bytes, typename: str) -> None:
    for junk in (data, b"\x00\x01\x00\x00" + data, b"\x00\x00\x00\x00" + data):
        counters = Counters()
        decode(junk, typename, counters)
        assert counters["messages"] + counters["bad_message"] + counters["not_finite"] >= 1


def test_unknown_types_are_refused() -> None:
    counters = Counters()
    assert decode(b"\x00\x01\x00\x00", "std_msgs/msg/String", counters) is None
    assert counters["unknown_type"] == 1
    with pytest.raises(MessageError, match="not known"):
        new("std_msgs/msg/String", data="")


def test_a_value_out_of_range_cannot_be_serialised() -> None:
    with pytest.raises(MessageError, match="cannot serialise"):
        motor_feedback("0", rpm=1e300)


@pytest.mark.parametrize("representation", ["Cartesian", "Spherical"])
@pytest.mark.parametrize("shape", [(8, 8), (10, 8), (1, 1), (3, 5)])
def test_a_hall_frame_comes_back_as_it_was(shape: tuple[int, int], representation: str) -> None:
    frame = hall_frame(*shape, representation=representation)
    counters = Counters()
    [(topic, typename, data)] = encode(frame)
    assert (topic, typename) == ("whiskers", WHISKER_ARRAY)
    back = decode(data, typename, counters, sensor_period_ns=156_000)
    assert isinstance(back, HallFrame)
    np.testing.assert_array_equal(back.field_mT, frame.field_mT)
    np.testing.assert_array_equal(back.valid, frame.valid)
    assert (back.stamp_ns, back.sensor_period_ns, back.representation) == (STAMP, 156_000, representation)
    assert counters["messages"] == 1
    assert counters["not_finite"] == 0


@pytest.mark.parametrize("frame_id", ["", "w", "abc", "base_link"])
@pytest.mark.parametrize("representation", ["Cartesian", "Spherical", "x"])
def test_hand_packed_whisker_arrays_equal_those_of_rosbags(frame_id: str, representation: str) -> None:
    rng = np.random.default_rng(3)
    records = np.zeros(7, dtype=whisker_array.WHISKER)
    records["row_num"], records["col_num"] = rng.integers(0, 200, 7), rng.integers(0, 200, 7)
    records["has_error"] = rng.integers(0, 2, 7)
    for name in ("offset_y", "x", "y", "z"):
        records[name] = rng.normal(size=7)
    whiskers = [
        new(
            "robominer_msgs/msg/Whisker",
            pos=new(
                "robominer_msgs/msg/WhiskerPosInGrid",
                row_num=int(record["row_num"]),
                col_num=int(record["col_num"]),
                offset_y=float(record["offset_y"]),
            ),
            has_error=bool(record["has_error"]),
            x=float(record["x"]),
            y=float(record["y"]),
            z=float(record["z"]),
        )
        for record in records
    ]
    message = new(
        WHISKER_ARRAY,
        header=header(STAMP, frame_id),
        num_mux=201,
        num_sensors=202,
        representation=representation,
        whiskers=whiskers,
    )
    general = serialize(message, WHISKER_ARRAY)
    packed = whisker_array.encode(whisker_array.WhiskerArray(STAMP, frame_id, 201, 202, representation, records))
    assert packed == general
    big_endian = bytes(typestore().serialize_cdr(message, WHISKER_ARRAY, little_endian=False))
    for data in (general, big_endian):
        back = whisker_array.decode(data)
        assert (back.stamp_ns, back.frame_id, back.num_mux, back.num_sensors) == (STAMP, frame_id, 201, 202)
        assert back.representation == representation
        for name in records.dtype.names or ():
            np.testing.assert_array_equal(back.whiskers[name], records[name])


def test_a_whisker_that_is_not_finite_is_counted_and_becomes_invalid() -> None:
    frame = HallFrame(STAMP, np.ones((2, 2, 3)), np.ones((2, 2), dtype=np.bool_))
    frame.field_mT[0, 1, 2] = np.nan
    frame.field_mT[1, 0, 0] = np.inf
    counters = Counters()
    back = decode(encode(frame)[0][2], WHISKER_ARRAY, counters)
    assert isinstance(back, HallFrame)
    assert back.valid.tolist() == [[True, False], [False, True]]
    assert np.isfinite(back.field_mT).all()
    assert counters["not_finite"] == 2


def test_whiskers_outside_the_array_make_the_message_unusable() -> None:
    data = bytearray(encode(hall_frame(2, 2))[0][2])
    at = len(data) - 4 * whisker_array.WHISKER.itemsize
    data[at] = 7
    counters = Counters()
    assert decode(bytes(data), WHISKER_ARRAY, counters) is None
    assert counters["bad_message"] == 1


vectors = arrays(np.float64, 3, elements=st.floats(-1e6, 1e6))


@settings(max_examples=30)
@given(st.none() | vectors, st.none() | vectors, st.booleans())
def test_imu_samples_come_back_with_what_they_had(
    gyro: np.ndarray | None, acceleration: np.ndarray | None, oriented: bool
) -> None:
    orientation = np.array([0.1, -0.2, 0.3, np.sqrt(0.86)]) if oriented else None
    [(topic, typename, data)] = encode(ImuSample(STAMP, gyro, acceleration, orientation))
    assert topic == "imu"
    back = decode(data, typename, Counters())
    assert isinstance(back, ImuSample)
    for sent, received in (
        (gyro, back.gyro),
        (acceleration, back.acceleration),
        (orientation, back.orientation_xyzw),
    ):
        assert (sent is None) == (received is None)
        if sent is not None:
            np.testing.assert_array_equal(received, sent)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_measurements_that_are_not_finite_are_counted_and_dropped(value: float) -> None:
    bad = np.array([0.0, value, 0.0])
    for measurement in (
        ImuSample(STAMP, bad, np.zeros(3)),
        ImuSample(STAMP, None, bad),
        ImuSample(STAMP, None, None, np.array([0.0, value, 0.0, 1.0])),
        OdometrySample(STAMP, bad),
        ScrewAngles(STAMP, np.array([0.0, 1.0, value, 0.0])),
    ):
        counters = Counters()
        [(_, typename, data)] = encode(measurement)
        assert decode(data, typename, counters) is None
        assert counters == {"not_finite": 1}
    counters = Counters()
    assert decode(motor_feedback("0", rpm=value), MOTOR_FEEDBACK, counters) is None
    assert decode(motor_feedback("0", volts=value), MOTOR_FEEDBACK, counters) is None
    assert counters == {"not_finite": 2}


def test_an_orientation_of_zeros_is_no_orientation() -> None:
    sample = ImuSample(STAMP, np.zeros(3), np.zeros(3), np.zeros(4))
    back = decode(encode(sample)[0][2], IMU, Counters())
    assert isinstance(back, ImuSample)
    assert back.orientation_xyzw is None


def test_screw_angles_come_back_whatever_the_order_of_the_names() -> None:
    angles = ScrewAngles(STAMP, np.array([1.5, -2.0, 1000.25, 0.0]))
    [(topic, typename, data)] = encode(angles)
    assert topic == "screws"
    back = decode(data, typename, Counters())
    assert isinstance(back, ScrewAngles)
    np.testing.assert_array_equal(back.angle, angles.angle)
    mixed = joint_state(["front_left", "lid", "rear_left", "front_right", "rear_right"], [3.0, 9.0, 2.0, 0.0, 1.0], [])
    back = decode(mixed, JOINT_STATE, Counters())
    assert isinstance(back, ScrewAngles)
    np.testing.assert_array_equal(back.angle, [0.0, 1.0, 2.0, 3.0])


def test_joint_states_without_positions_give_speeds_of_the_screws_they_name() -> None:
    back = decode(joint_state(["rear_left", "front_right"], [], [2.0, -1.0]), JOINT_STATE, Counters())
    assert isinstance(back, ScrewSpeeds)
    np.testing.assert_array_equal(back.speed, [-1.0, np.nan, 2.0, np.nan])
    counters = Counters()
    assert decode(joint_state(["lid"], [1.0], [1.0]), JOINT_STATE, counters) is None
    assert decode(joint_state(["front_left"], [1.0], []), JOINT_STATE, counters) is None
    assert counters == {"bad_message": 2}


def test_screw_speeds_go_out_as_one_motor_module_each() -> None:
    speeds = ScrewSpeeds(
        STAMP,
        np.array([1.0, np.nan, -2.5, 0.0]),
        np.array([100.0, np.nan, 200.0, np.nan]),
        np.array([24.0, np.nan, 23.0, np.nan]),
    )
    messages = encode(speeds)
    assert [topic for topic, _, _ in messages] == [
        "front_right/motor_module",
        "rear_left/motor_module",
        "front_left/motor_module",
    ]
    merged = np.full(4, np.nan)
    for _, typename, data in messages:
        back = decode(data, typename, Counters())
        assert isinstance(back, ScrewSpeeds)
        merged = np.where(np.isnan(back.speed), merged, back.speed)
        if back.speed[2] < 0.0:
            assert back.current_mA is not None
            assert back.voltage_V is not None
            assert (back.current_mA[2], back.voltage_V[2]) == (200.0, 23.0)
    np.testing.assert_allclose(merged, speeds.speed, rtol=1e-6)


@pytest.mark.parametrize(
    ("motor_id", "frame_id", "screw", "index"),
    [
        ("2", "rear_left", None, 2),
        ("front_left", "", None, 3),
        ("?", "rear_right", None, 1),
        ("", "", "front_right", 0),
    ],
)
def test_a_motor_module_names_its_screw_by_number_name_frame_or_topic(
    motor_id: str, frame_id: str, screw: str | None, index: int
) -> None:
    back = decode(motor_feedback(motor_id, frame_id), MOTOR_FEEDBACK, Counters(), screw=screw)
    assert isinstance(back, ScrewSpeeds)
    assert np.flatnonzero(np.isfinite(back.speed)).tolist() == [index]
    assert back.speed[index] == pytest.approx(np.pi)
    # Neither current nor voltage: the module does not measure them.
    assert back.current_mA is None


def test_a_motor_module_of_no_screw_is_counted() -> None:
    counters = Counters()
    assert decode(motor_feedback("9"), MOTOR_FEEDBACK, counters) is None
    assert counters == {"bad_message": 1}


def test_odometry_comes_from_twist_and_from_odometry_messages() -> None:
    sample = OdometrySample(STAMP, np.array([0.1, -0.2, 0.3]))
    [(topic, typename, data)] = encode(sample)
    assert (topic, typename) == ("odometry/twist", TWIST_STAMPED)
    twist = deserialize(data, TWIST_STAMPED).twist
    zero = new("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)
    identity = new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    pose = new("geometry_msgs/msg/Pose", position=zero, orientation=identity)
    message = new(
        ODOMETRY,
        header=header(STAMP, "odom"),
        child_frame_id="base_link",
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
    for content, kind in ((data, TWIST_STAMPED), (serialize(message, ODOMETRY), ODOMETRY)):
        back = decode(content, kind, Counters())
        assert isinstance(back, OdometrySample)
        np.testing.assert_array_equal(back.velocity, sample.velocity)
        assert back.stamp_ns == STAMP
