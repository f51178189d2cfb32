"""Each frame's result onto the bus: pose, odometry, transforms, contacts, telemetry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.float_array import of_floats
from robominer_slam.frame_result import FrameResult
from robominer_slam.layout import WhiskerLayout
from robominer_slam.publishing import cloud_messages, pose_messages
from robominer_slam.publishing.pose_messages import StampedTransform
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.wall_clock import WallClock

FloatArray = NDArray[np.float64]

MAP, ODOM, BASE = "map", "odom", "base_link"
#: Variances of what a level body is taken to have: z (m2), roll and pitch (rad2) are not estimated.
LEVEL_VARIANCE = (1e-4, 1e-4, 1e-4)
#: While the pose is not known, it carries a sigma of 10 m.
UNKNOWN_VARIANCE_M2 = 100.0
#: Contacts go out with each frame, or with one of so many where the computer cannot keep up.
SPARING_FRAMES = 5


#: Covariance in ROS order of a pose of which nothing else is known, and where in it that of x, y, yaw goes, flattened.
_LEVEL = np.diag([0.0, 0.0, *LEVEL_VARIANCE, 0.0])
_PLANAR = np.array([0, 1, 5, 6, 7, 11, 30, 31, 35])


def full_covariance(planar: FloatArray) -> FloatArray:
    """Covariance (6, 6) in ROS order of one over (x, y, yaw)."""
    covariance = _LEVEL.copy()
    covariance.put(_PLANAR, planar)
    return covariance


class Publisher:
    """Publishes the results of frames.

    Attributes:
        frames: how many.
    """

    def __init__(self, bus: ZenohBus, clock: WallClock, layout: WhiskerLayout) -> None:
        self._bus = bus
        self._clock = clock
        self.frames = 0
        # The correction changes with the back-end's results only.
        self._T_map_odom: FloatArray | None = None
        self._map_odom = np.zeros(7)
        now = clock.now_unix_ns()
        mounts = [
            StampedTransform(now, BASE, f"whisker_{i // layout.cols}_{i % layout.cols}", geometry.to_vector7(T))
            for i, T in enumerate(geometry.from_rotation_translation(layout.R_base_whisker, layout.p_base))
            if layout.present[i]
        ]
        bus.latch("tf_static", pose_messages.transforms(mounts))

    def frame(self, result: FrameResult, *, sparing: bool = False) -> None:
        """Publish one frame's result; the contacts of every fifth one only where it shall be sparing."""
        stamp = self._clock.unix_ns(result.stamp_ns)
        odometry = result.odometry
        odom_pose = geometry.to_vector7(result.T_odom_base)
        known = result.state not in ("lost", "relocalizing")
        covariance = full_covariance(result.covariance)
        if not known:
            covariance[[0, 1], [0, 1]] = np.maximum(covariance[[0, 1], [0, 1]], UNKNOWN_VARIANCE_M2)
        pose = geometry.to_vector7(result.T_map_base)
        self._bus.put("pose", pose_messages.pose_with_covariance(stamp, MAP, pose, covariance))
        vx, vy, wz = odometry.velocity.tolist()
        in_space = odometry.pose_covariance
        self._bus.put(
            "odom",
            pose_messages.odometry(
                stamp,
                ODOM,
                BASE,
                odom_pose,
                full_covariance(odometry.covariance) if in_space is None else in_space,
                of_floats([vx, vy, 0.0, 0.0, 0.0, wz]),
                full_covariance(odometry.velocity_covariance),
            ),
        )
        transforms = [StampedTransform(stamp, ODOM, BASE, odom_pose)]
        if known:
            if result.T_map_odom is not self._T_map_odom:
                self._T_map_odom, self._map_odom = result.T_map_odom, geometry.to_vector7(result.T_map_odom)
            transforms.insert(0, StampedTransform(stamp, MAP, ODOM, self._map_odom))
        self._bus.put("tf", pose_messages.transforms(transforms))
        contacts = result.contacts
        spared = sparing and self.frames % SPARING_FRAMES
        if not spared and self._bus.wanted("whiskers/points"):
            self._bus.put(
                "whiskers/points",
                cloud_messages.contact_cloud(
                    stamp, BASE, contacts.points, contacts.index, contacts.inclination, contacts.azimuth
                ),
            )
        self.frames += 1
