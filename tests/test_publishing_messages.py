"""Published ROS messages: hand-packed bytes equal a general serialiser's, and an independent decoder reads them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from drivers.ros_messages import deserialize, header, new, schema_text, serialize
from robominer_slam.publishing import cloud_messages, pose_messages, report_messages
from robominer_slam.publishing.pose_messages import StampedTransform
from robominer_slam.publishing.report_messages import Diagnostic, Level

STAMP = 1_700_000_000_123_456_789
frames = st.sampled_from(["", "m", "map", "odom", "base_link", "robominer/rm3/base_link"])
seeds = st.integers(0, 2**31)


def quaternion_pose(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return np.concatenate([rng.normal(size=3), q / np.linalg.norm(q)])


def decode_independently(data: bytes, typename: str) -> Any:
    schema = Schema(id=1, name=typename, encoding="ros2msg", data=schema_text(typename).encode())
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder(data)


def pose_message(pose: np.ndarray) -> Any:
    x, y, z, qx, qy, qz, qw = (float(value) for value in pose)
    return new(
        "geometry_msgs/msg/Pose",
        position=new("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def vector(values: np.ndarray) -> Any:
    return new("geometry_msgs/msg/Vector3", x=float(values[0]), y=float(values[1]), z=float(values[2]))


@settings(max_examples=30)
@given(frames, seeds)
def test_a_packed_pose_equals_the_serialised_one(frame: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, covariance = quaternion_pose(rng), rng.normal(size=(6, 6))
    inner = new("geometry_msgs/msg/PoseWithCovariance", pose=pose_message(pose), covariance=covariance.ravel())
    message = new(pose_messages.POSE_WITH_COVARIANCE, header=header(STAMP, frame), pose=inner)
    expected = serialize(message, pose_messages.POSE_WITH_COVARIANCE)
    assert pose_messages.pose_with_covariance(STAMP, frame, pose, covariance) == expected


@settings(max_examples=30)
@given(frames, frames, seeds)
def test_a_packed_odometry_equals_the_serialised_one(frame: str, child: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, twist = quaternion_pose(rng), rng.normal(size=6)
    pose_covariance, twist_covariance = rng.normal(size=(2, 6, 6))
    twist_message = new("geometry_msgs/msg/Twist", linear=vector(twist[:3]), angular=vector(twist[3:]))
    message = new(
        pose_messages.ODOMETRY,
        header=header(STAMP, frame),
        child_frame_id=child,
        pose=new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=pose_message(pose),
            covariance=pose_covariance.ravel(),
        ),
        twist=new(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=twist_message,
            covariance=twist_covariance.ravel(),
        ),
    )
    packed = pose_messages.odometry(STAMP, frame, child, pose, pose_covariance, twist, twist_covariance)
    assert packed == serialize(message, pose_messages.ODOMETRY)


@settings(max_examples=30)
@given(st.lists(st.tuples(frames, frames), max_size=5), seeds)
def test_packed_transforms_equal_the_serialised_ones(names: list[tuple[str, str]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    content = [
        StampedTransform(STAMP + k, frame, child, quaternion_pose(rng)) for k, (frame, child) in enumerate(names)
    ]
    messages = []
    for stamp, frame, child, pose in content:
        orientation = pose_message(pose).orientation
        transform = new("geometry_msgs/msg/Transform", translation=vector(pose[:3]), rotation=orientation)
        messages.append(
            new(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp, frame),
                child_frame_id=child,
                transform=transform,
            )
        )
    expected = serialize(new(pose_messages.TF_MESSAGE, transforms=messages), pose_messages.TF_MESSAGE)
    assert pose_messages.transforms(content) == expected


@settings(max_examples=30)
@given(frames, st.integers(0, 6), seeds)
def test_a_packed_path_equals_the_serialised_one(frame: str, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.array([quaternion_pose(rng) for _ in range(count)]).reshape(-1, 7)
    stamps = [STAMP + 10**8 * k for k in range(count)]
    messages = [
        new("geometry_msgs/msg/PoseStamped", header=header(stamp, frame), pose=pose_message(pose))
        for stamp, pose in zip(stamps, poses, strict=True)
    ]
    expected = serialize(new(pose_messages.PATH, header=header(STAMP, frame), poses=messages), pose_messages.PATH)
    assert pose_messages.path(STAMP, frame, stamps, poses) == expected


def test_a_long_path_is_thinned_and_keeps_its_ends() -> None:
    poses = np.zeros((1777, 7))
    poses[:, 0] = np.arange(1777)
    stamps = list(range(1777))
    message = deserialize(pose_messages.path(STAMP, "map", stamps, poses), pose_messages.PATH)
    assert len(message.poses) == 500
    positions = [pose.pose.position.x for pose in message.poses]
    assert (positions[0], positions[-1]) == (0.0, 1776.0)
    assert np.diff(positions).min() >= 3
    assert np.diff(positions).max() <= 4
    assert [pose.header.stamp.nanosec for pose in message.poses] == positions


def rows(cloud: Any) -> list[tuple[Any, ...]]:
    """The points as the message's own field descriptions say they lie."""
    kinds = {4: "<u2", 7: "<f4"}
    dtype = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert all(field.count == 1 for field in cloud.fields)
    assert (cloud.height, cloud.is_bigendian, cloud.is_dense) == (1, False, True)
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
    return np.frombuffer(bytes(cloud.data), dtype=dtype).tolist()


@pytest.mark.parametrize("frame", ["", "base_link", "ab", "map"])
@pytest.mark.parametrize("count", [0, 1, 40])
def test_contacts_are_read_by_both_decoders_and_serialise_to_the_same_bytes(frame: str, count: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3))
    index = rng.permutation(80)[:count]
    inclination, azimuth = rng.random(count), rng.normal(size=count)
    data = cloud_messages.contact_cloud(STAMP, frame, points, index, inclination, azimuth)
    message = deserialize(data, cloud_messages.POINT_CLOUD)
    assert serialize(message, cloud_messages.POINT_CLOUD) == data
    independent = decode_independently(data, cloud_messages.POINT_CLOUD)
    assert independent.header.frame_id == frame
    expected = [
        tuple(np.float32(value).item() if k != 3 else int(value) for k, value in enumerate(row))
        for row in zip(*points.T, index, inclination, azimuth, strict=True)
    ]
    names = ["x", "y", "z", "index", "inclination", "azimuth"]
    for cloud in (message, independent):
        assert [field.name for field in cloud.fields] == names
        assert cloud.point_step == 22
        assert rows(cloud) == expected


def test_a_map_cloud_is_thinned_to_its_limit() -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3))
    data = cloud_messages.map_cloud(STAMP, "map", points)
    message = deserialize(data, cloud_messages.POINT_CLOUD)
    assert serialize(message, cloud_messages.POINT_CLOUD) == data
    np.testing.assert_allclose(np.array(rows(message)), points, rtol=1e-6)
    thinned = deserialize(cloud_messages.map_cloud(STAMP, "map", points, max_points=100), cloud_messages.POINT_CLOUD)
    assert thinned.width == 100
    assert rows(thinned)[-1] == pytest.approx(points[-1], rel=1e-6)
    empty = cloud_messages.map_cloud(STAMP, "map", np.zeros((0, 3)))
    assert deserialize(empty, cloud_messages.POINT_CLOUD).width == 0


def test_the_largest_map_cloud_stays_under_one_mebibyte() -> None:
    points = np.zeros((cloud_messages.MAX_MAP_POINTS + 5, 3))
    assert len(cloud_messages.map_cloud(STAMP, "map", points)) < 1 << 20


def test_an_occupancy_grid_keeps_rows_along_y() -> None:
    cells = np.array([[0, 100, -1], [50, 1, 2]], dtype=np.int8)
    data = report_messages.occupancy_grid(STAMP, "map", 0.05, (-1.0, 2.0), cells)
    for message in (
        deserialize(data, report_messages.OCCUPANCY_GRID),
        decode_independently(data, report_messages.OCCUPANCY_GRID),
    ):
        assert (message.info.width, message.info.height) == (3, 2)
        assert message.info.resolution == pytest.approx(0.05)
        assert (message.info.origin.position.x, message.info.origin.position.y) == (-1.0, 2.0)
        assert list(message.data) == [0, 100, -1, 50, 1, 2]


def test_diagnostics_keep_levels_names_and_values() -> None:
    content = [
        Diagnostic("localization", Level.OK, "tracking", {"localization.state": "tracking", "x": "1"}),
        Diagnostic("whiskers", Level.ERROR, "no data for 3 s – check the cable", {}, "usb:1234"),
    ]
    data = report_messages.diagnostics(STAMP, content)
    message = deserialize(data, report_messages.DIAGNOSTIC_ARRAY)
    assert [int(entry.level) for entry in message.status] == [0, 2]
    independent = decode_independently(data, report_messages.DIAGNOSTIC_ARRAY)
    for found in (message, independent):
        assert [entry.name for entry in found.status] == ["localization", "whiskers"]
        assert found.status[1].message == content[1].message
        assert found.status[1].hardware_id == "usb:1234"
        values = {entry.key: entry.value for entry in found.status[0].values}
        assert values == content[0].values


@settings(max_examples=50)
@given(
    st.lists(
        st.builds(
            Diagnostic,
            st.text(max_size=9),
            st.sampled_from(Level),
            st.text(max_size=9),
            st.dictionaries(st.text(max_size=9), st.text(max_size=9), max_size=3),
            st.text(max_size=5),
        ),
        max_size=4,
    )
)
def test_packed_diagnostics_equal_the_serialised_ones(content: list[Diagnostic]) -> None:
    status = [
        new(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=int(entry.level),
            name=entry.name,
            message=entry.message,
            hardware_id=entry.hardware_id,
            values=[new("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in entry.values.items()],
        )
        for entry in content
    ]
    message = new(report_messages.DIAGNOSTIC_ARRAY, header=header(STAMP, ""), status=status)
    assert report_messages.diagnostics(STAMP, content) == serialize(message, report_messages.DIAGNOSTIC_ARRAY)


def test_poses_and_transforms_are_read_by_an_independent_decoder() -> None:
    rng = np.random.default_rng(7)
    pose, covariance = quaternion_pose(rng), rng.normal(size=(6, 6))
    data = pose_messages.pose_with_covariance(STAMP, "map", pose, covariance)
    found = decode_independently(data, pose_messages.POSE_WITH_COVARIANCE)
    assert found.header.stamp.sec * 10**9 + found.header.stamp.nanosec == STAMP
    assert list(found.pose.covariance) == covariance.ravel().tolist()
    assert found.pose.pose.orientation.w == pose[6]
    data = pose_messages.transforms(
        [StampedTransform(STAMP, "map", "odom", pose), StampedTransform(STAMP, "odom", "base_link", pose)]
    )
    second = decode_independently(data, pose_messages.TF_MESSAGE).transforms[1]
    assert (second.header.frame_id, second.child_frame_id) == ("odom", "base_link")
    assert second.transform.rotation.z == pose[5]


def test_a_whole_distributions_store_reads_the_packed_messages() -> None:
    """Not only our own reduced store."""
    humble = get_typestore(Stores.ROS2_HUMBLE)
    pose = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    data = pose_messages.odometry(STAMP, "odom", "base_link", pose, np.eye(6), np.arange(6.0), 2 * np.eye(6))
    message = humble.deserialize_cdr(data, pose_messages.ODOMETRY)
    assert (message.child_frame_id, message.twist.twist.angular.z) == ("base_link", 5.0)
    assert message.twist.covariance[7] == 2.0
