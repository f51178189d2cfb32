"""The robot at one moment as the console shows it, and how messages of the bus become one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.ros_messages import Message, deserialize, time_to_ns
from robominer_slam.publishing.cloud_messages import CONTACT_POINT, POINT_CLOUD
from robominer_slam.publishing.pose_messages import POSE_WITH_COVARIANCE
from robominer_slam.publishing.telemetry import Telemetry

FloatArray = NDArray[np.float64]

#: Places of xx, xy, yy and of the heading's variance in a 6 x 6 covariance, row-major.
_PLANAR_TERMS = [0, 1, 7, 35]


@dataclass(frozen=True, slots=True)
class LiveFrame:
    """The robot at one moment.

    Attributes:
        stamp_ns: UNIX time of the sensors.
        pose: T_map_base as x y z (m), qx qy qz qw; shape (7,).
        covariance: xx, xy, yy (m2) and of the heading (rad2); shape (4,).
        state: one of `telemetry.STATES`; "" while it is not known.
        inclination, azimuth: of all whiskers, row-major, rad; 0: free, NaN: no valid reading; empty: not known.
    """

    stamp_ns: int
    pose: FloatArray
    covariance: FloatArray
    state: str
    inclination: FloatArray
    azimuth: FloatArray

    @property
    def touching(self) -> int:
        """How many whiskers are bent."""
        return int(np.count_nonzero(self.inclination > 0.0))


def pose_of(payload: bytes) -> tuple[int, FloatArray, FloatArray]:
    """Stamp, pose (7,) and covariance (4,) of a PoseWithCovarianceStamped.

    Raises:
        MessageError: bytes that are none.
    """
    message = deserialize(payload, POSE_WITH_COVARIANCE)
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    pose = np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
    return time_to_ns(message.header.stamp), pose, np.asarray(message.pose.covariance)[_PLANAR_TERMS]


def contacts_of(payload: bytes, count: int) -> tuple[int, FloatArray, FloatArray]:
    """Stamp, inclination and azimuth, shape (count,), of `whiskers/points`; 0 where nothing touches.

    Raises:
        MessageError: bytes that are no such cloud.
    """
    message: Message = deserialize(payload, POINT_CLOUD)
    points = np.asarray(message.data, dtype=np.uint8).view(CONTACT_POINT)
    inclination, azimuth = np.zeros(count), np.zeros(count)
    points = points[points["index"] < count]
    inclination[points["index"]] = points["inclination"]
    azimuth[points["index"]] = points["azimuth"]
    return time_to_ns(message.header.stamp), inclination, azimuth


def covariance_of(telemetry: Telemetry) -> FloatArray:
    """The covariance that a telemetry message's sigmas stand for, shape (4,)."""
    x, y, yaw = np.square(telemetry.sigmas[[0, 1, 5]])
    return np.array([x, 0.0, y, yaw])
