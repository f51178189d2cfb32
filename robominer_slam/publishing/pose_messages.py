"""Poses as ROS 2 messages in CDR: PoseWithCovarianceStamped, Odometry, TFMessage, Path.

The first three go out with every whisker frame, so they are packed by hand: what depends on the frames' names is
made once and kept. The tests hold the bytes against a general serialiser's.

Poses are x y z (m), qx qy qz qw; covariances 6x6 row-major, (x, y, z, rotation about x, y, z), m and rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers import cdr

FloatArray = NDArray[np.float64]

POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
PATH = "nav_msgs/msg/Path"

MAX_PATH_POSES = 500
_POSE_BYTES = 7 * 8
#: Made once: numpy takes as long to read a type's name as to copy the numbers.
_DOUBLE = np.dtype("<f8")
_FIRST_IN_SEQUENCE = cdr.UINT32.size


class StampedTransform(NamedTuple):
    """One transform of a TFMessage: pose of `child_frame` in `frame`, shape (7,)."""

    stamp_ns: int
    frame: str
    child_frame: str
    pose: FloatArray


@lru_cache(maxsize=64)
def _names(at: int, *names: str) -> bytes:
    """Strings from position `at` on, then padding up to the doubles that follow."""
    packed = b""
    for name in names:
        packed += cdr.string(name, at + len(packed))
    return packed + cdr.padding(at + len(packed), 8)


def pose_with_covariance(stamp_ns: int, frame: str, pose: FloatArray, covariance: FloatArray) -> bytes:
    """geometry_msgs/PoseWithCovarianceStamped.

    Args:
        stamp_ns: UNIX time.
        frame: the frame that the pose is in.
        pose: shape (7,).
        covariance: shape (6, 6).
    """
    head = cdr.CDR_LITTLE_ENDIAN + cdr.stamp(stamp_ns) + _names(8, frame)
    return head + _doubles(pose) + _doubles(covariance)


def odometry(
    stamp_ns: int,
    frame: str,
    child_frame: str,
    pose: FloatArray,
    pose_covariance: FloatArray,
    twist: FloatArray,
    twist_covariance: FloatArray,
) -> bytes:
    """nav_msgs/Odometry.

    Args:
        stamp_ns: UNIX time.
        frame: the frame that the pose is in.
        child_frame: the frame whose pose it is, and that the twist is in.
        pose: shape (7,).
        pose_covariance: shape (6, 6).
        twist: vx vy vz (m/s), wx wy wz (rad/s), shape (6,).
        twist_covariance: shape (6, 6).
    """
    head = cdr.CDR_LITTLE_ENDIAN + cdr.stamp(stamp_ns) + _names(8, frame, child_frame)
    return head + _doubles(pose) + _doubles(pose_covariance) + _doubles(twist) + _doubles(twist_covariance)


def transforms(content: Sequence[StampedTransform]) -> bytes:
    """tf2_msgs/TFMessage."""
    parts = [cdr.CDR_LITTLE_ENDIAN, cdr.UINT32.pack(len(content))]
    # Each transform ends with doubles, so every one but the first starts at a multiple of eight.
    at = _FIRST_IN_SEQUENCE
    for stamp_ns, frame, child_frame, pose in content:
        parts += (cdr.stamp(stamp_ns), _names(at + 8, frame, child_frame), _doubles(pose))
        at = 0
    return b"".join(parts)


def path(stamp_ns: int, frame: str, stamps_ns: Sequence[int], poses: FloatArray) -> bytes:
    """nav_msgs/Path of at most `MAX_PATH_POSES` poses: more are thinned evenly, the first and last stay.

    Args:
        stamp_ns: UNIX time of the message.
        frame: the frame that the poses are in.
        stamps_ns: UNIX time of each pose.
        poses: shape (n, 7).
    """
    if len(poses) > MAX_PATH_POSES:
        kept = np.linspace(0, len(poses) - 1, MAX_PATH_POSES).round().astype(np.intp)
        poses, stamps_ns = poses[kept], [stamps_ns[int(k)] for k in kept]
    head = cdr.stamp(stamp_ns) + cdr.string(frame, 8)
    head += cdr.padding(len(head), 4) + cdr.UINT32.pack(len(poses))
    parts = [cdr.CDR_LITTLE_ENDIAN, head]
    at = len(head) % 8
    for pose_stamp_ns, pose in zip(stamps_ns, poses, strict=True):
        parts += (cdr.stamp(pose_stamp_ns), _names(at + 8, frame), _doubles(pose))
        at = 0
    return b"".join(parts)


def _doubles(values: FloatArray) -> bytes:
    return np.asarray(values, _DOUBLE).tobytes()
