"""What the telemetry message says, as the ROS messages that a viewer draws: for links that bring poses too seldom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.ros_messages import deserialize
from robominer_slam import geometry
from robominer_slam.publishing import pose_messages
from robominer_slam.publishing.pose_messages import TF_MESSAGE, StampedTransform
from robominer_slam.publishing.telemetry import Telemetry

FloatArray = NDArray[np.float64]

MAP, ODOM, BASE = "map", "odom", "base_link"
#: A message that comes less often than this is taken to come too seldom, s; telemetry comes each 0.25 s.
SELDOM_S = 0.5
#: States in which the robot withholds map -> odom.
_PLACE_UNKNOWN = ("lost", "relocalizing")


class Pace:
    """How often a message comes."""

    def __init__(self) -> None:
        self._last_s = self._before_s = float("-inf")

    def came(self, now_s: float) -> None:
        """It has just come."""
        self._before_s, self._last_s = self._last_s, now_s

    def seldom(self, now_s: float) -> bool:
        """Whether telemetry should stand in for it."""
        return now_s - self._last_s > SELDOM_S or self._last_s - self._before_s > SELDOM_S


def pose(state: Telemetry) -> bytes:
    """geometry_msgs/PoseWithCovarianceStamped."""
    return pose_messages.pose_with_covariance(state.stamp_ns, MAP, state.pose, np.diag(np.square(state.sigmas)))


def transforms(state: Telemetry, T_map_odom: FloatArray) -> bytes | None:
    """tf2_msgs/TFMessage that puts base_link where telemetry has it; None while the place is not known.

    Through `odom`, as the robot's own: a frame with two parents would jump between them.

    Args:
        state: of the robot.
        T_map_odom: the last that the robot has sent, shape (4, 4).
    """
    if state.state in _PLACE_UNKNOWN:
        return None
    T_odom_base = np.linalg.inv(T_map_odom) @ geometry.from_vector7(state.pose)
    return pose_messages.transforms(
        [
            StampedTransform(state.stamp_ns, MAP, ODOM, geometry.to_vector7(T_map_odom)),
            StampedTransform(state.stamp_ns, ODOM, BASE, geometry.to_vector7(T_odom_base)),
        ]
    )


def map_to_odom(payload: bytes) -> FloatArray | None:
    """T_map_odom of a tf2_msgs/TFMessage, shape (4, 4); None if it has none.

    Raises:
        MessageError: no such message.
    """
    for entry in deserialize(payload, TF_MESSAGE).transforms:
        if (entry.header.frame_id, entry.child_frame_id) == (MAP, ODOM):
            t, q = entry.transform.translation, entry.transform.rotation
            T: FloatArray = geometry.from_vector7(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]))
            return T
    return None
