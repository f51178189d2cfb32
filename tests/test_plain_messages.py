"""Messages unpacked in one go: the same numbers as the general decoder gives, whatever the bytes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from drivers import plain_messages
from drivers.ros_messages import Message, MessageError, deserialize, header, new, serialize, time_to_ns, typestore

numbers = st.floats(width=64)
names = st.text(max_size=9).filter(lambda text: "\0" not in text)
stamps = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9)


def vector(values: list[float]) -> Message:
    return new("geometry_msgs/msg/Vector3", **dict(zip("xyz", values, strict=True)))


def of(*parts: object) -> np.ndarray:
    return np.array([part for some in parts for part in (some if isinstance(some, tuple) else (some,))])


@given(stamps, names, st.lists(numbers, min_size=37, max_size=37), st.integers(0, 4))
def test_imu_messages_equal_those_of_rosbags(stamp_ns, frame_id, v, surplus):
    message = new(
        plain_messages.IMU,
        header=header(stamp_ns, frame_id),
        orientation=new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", v[:4], strict=True))),
        orientation_covariance=np.array(v[4:13]),
        angular_velocity=vector(v[13:16]),
        angular_velocity_covariance=np.array(v[16:25]),
        linear_acceleration=vector(v[25:28]),
        linear_acceleration_covariance=np.array(v[28:]),
    )
    little = serialize(message, plain_messages.IMU)
    big = bytes(typestore().serialize_cdr(message, plain_messages.IMU, little_endian=False))
    for data in (little, big):
        found = plain_messages.imu(data + bytes(surplus if surplus <= 3 else 0))
        assert found.stamp_ns == stamp_ns
        expected = of(*v[:4], *v[13:16], *v[25:28], v[4], v[16], v[28])
        assert_array_equal(of(found.orientation, found.gyro, found.acceleration, found.covariances), expected)
    if surplus == 4:
        with pytest.raises(MessageError):
            plain_messages.imu(little + bytes(4))


@given(stamps, names, st.lists(numbers, min_size=6, max_size=6))
def test_twists_equal_those_of_rosbags(stamp_ns, frame_id, v):
    parts = new("geometry_msgs/msg/Twist", linear=vector(v[:3]), angular=vector(v[3:]))
    message = new(plain_messages.TWIST_STAMPED, header=header(stamp_ns, frame_id), twist=parts)
    found_ns, found = plain_messages.twist(serialize(message, plain_messages.TWIST_STAMPED))
    assert found_ns == stamp_ns
    assert_array_equal(of(found), v)


arrays = st.lists(numbers, max_size=5)


@given(stamps, names, st.lists(names, max_size=5), arrays, arrays, arrays)
def test_joint_states_equal_those_of_rosbags(stamp_ns, frame_id, joint_names, position, velocity, effort):
    message = new(
        plain_messages.JOINT_STATE,
        header=header(stamp_ns, frame_id),
        name=joint_names,
        position=np.array(position, dtype=np.float64),
        velocity=np.array(velocity, dtype=np.float64),
        effort=np.array(effort, dtype=np.float64),
    )
    found = plain_messages.joints(serialize(message, plain_messages.JOINT_STATE))
    assert (found.stamp_ns, found.names) == (stamp_ns, joint_names)
    assert_array_equal(of(found.position), position)
    assert_array_equal(of(found.velocity), velocity)


@given(st.data(), st.sampled_from([plain_messages.IMU, plain_messages.TWIST_STAMPED, plain_messages.JOINT_STATE]))
def test_damaged_messages_say_what_rosbags_makes_of_them_or_are_refused_too(draw, typename):
    readers = {
        plain_messages.IMU: lambda data: plain_messages.imu(data).stamp_ns,
        plain_messages.TWIST_STAMPED: lambda data: plain_messages.twist(data)[0],
        plain_messages.JOINT_STATE: lambda data: plain_messages.joints(data).stamp_ns,
    }
    size = draw.draw(st.integers(0, 380))
    data = bytearray(b"\0\1\0\0" + bytes(8) + b"\2\0\0\0a\0" + bytes(size))
    for at, value in draw.draw(st.lists(st.tuples(st.integers(0, len(data) - 1), st.integers(0, 255)), max_size=3)):
        data[at] = value
    try:
        expected = time_to_ns(deserialize(bytes(data), typename).header.stamp)
    except MessageError:
        with pytest.raises(MessageError):
            readers[typename](bytes(data))
    else:
        assert readers[typename](bytes(data)) == expected
