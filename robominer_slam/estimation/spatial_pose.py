"""Height, roll and pitch beside the planar filter: from its (x, y, yaw) to poses and covariances in space."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.estimation.imu_batch import ImuBatch
from robominer_slam.estimation.tilt import Rotation, Tilt, Vector
from robominer_slam.float_array import of_floats

FloatArray = NDArray[np.float64]

#: Rows of a twist (translation first) that the planar filter knows.
PLANAR = [0, 1, 5]
#: Of a level body.
LEVEL: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class SpatialPose:
    """Keeps what the planar filter lacks; the robot follows the ground, so the body's vertical velocity is zero.

    Args:
        settings: noise, with units and reasons there.
        tilts: False for a body without IMU: it is level.

    Attributes:
        rotation: from base_link to its levelled frame, row by row.
        z: in odom, m.
        way: driven so far, m.
    """

    def __init__(self, settings: RobustEstimationSection, tilts: bool) -> None:
        self._settings = settings
        self._tilt = Tilt(settings.tilt_time_constant) if tilts else None
        self._velocity = (0.0, 0.0)
        self.rotation = LEVEL
        self.z = self.way = 0.0
        self._key = (self.rotation, self.z, self.way)

    def turn(self, imu: ImuBatch, rate: Vector | None, velocity: FloatArray, dt: float) -> float | None:
        """Go on with the IMU's samples of an interval.

        Args:
            imu: the samples; its accelerations are taken.
            rate: mean of the gyro, rad/s; None without one.
            velocity: vx, vy (m/s), wz (rad/s), shape (3,).
            dt: length of the interval, s.

        Returns:
            The turn rate about the vertical as the gyro reads it, rad/s.
        """
        acceleration, tilt = imu.mean_acceleration(), self._tilt
        if tilt is None or (rate is None and acceleration is None):
            return None
        vx, vy, wz = velocity.tolist()
        before_x, before_y = self._velocity
        own = ((vx - before_x) / dt - wz * vy, (vy - before_y) / dt + wz * vx, 0.0)
        self._velocity = (vx, vy)
        tilt.move(dt, rate, acceleration, own, imu.orientation_xyzw)
        self.rotation = tilt.rotation()
        return None if rate is None else tilt.turn_rate(rate)

    def advance(self, velocity: FloatArray, dt: float) -> None:
        """Go on by the body velocity (vx, vy, wz)."""
        vx, vy, _ = velocity.tolist()
        up_x, up_y, _ = self.rotation[2]
        self.way += math.hypot(vx, vy) * dt
        self.z += (up_x * vx + up_y * vy) * dt

    def pose(self, planar: Sequence[float]) -> FloatArray | None:
        """Pose of base_link in odom, shape (4, 4), at (x, y, yaw); None for a level body."""
        return None if self._tilt is None else _pose(planar, self.z, self.rotation)

    def covariance(self, planar: FloatArray, way: float | None = None) -> FloatArray:
        """Covariance (6, 6) of x, y, z, roll, pitch, yaw from that of (x, y, yaw), after a way in m."""
        settings = self._settings
        driven = self.way if way is None else way
        tilt = math.radians(settings.sigma_tilt_deg) ** 2
        climbed = 0.0 if self._tilt is None else tilt * driven * driven
        height = settings.height_walk**2 * (driven + 0.01) + climbed
        (xx, xy, xw), (yx, yy, yw), (wx, wy, ww) = planar.tolist()
        rows = [
            *(xx, xy, 0.0, 0.0, 0.0, xw),
            *(yx, yy, 0.0, 0.0, 0.0, yw),
            *(0.0, 0.0, height, 0.0, 0.0, 0.0),
            *(0.0, 0.0, 0.0, tilt, 0.0, 0.0),
            *(0.0, 0.0, 0.0, 0.0, tilt, 0.0),
            *(wx, wy, 0.0, 0.0, 0.0, ww),
        ]
        return of_floats(rows).reshape(6, 6)

    def motion(
        self, planar: FloatArray, covariance: FloatArray, by_bias: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Motion since the keyframe, in space; the present pose becomes the keyframe.

        Args:
            planar: pose of the levelled base_link in the keyframe's levelled frame (x, y, yaw), shape (3,).
            covariance: of its error in its own axes, shape (3, 3).
            by_bias: derivative of that error by the biases, shape (3, nb).

        Returns:
            Pose of base_link in the keyframe (4, 4), covariance of its twist error (6, 6), derivative (6, nb).
        """
        rotation, z, way = self._key
        T = _pose(planar.tolist(), self.z - z, self.rotation)
        T[:3] = np.array(rotation).T @ T[:3]
        jacobian = np.zeros((6, by_bias.shape[1]))
        jacobian[PLANAR] = by_bias
        # From the levelled frame to base_link.
        to_base = np.kron(np.eye(2), np.array(self.rotation).T)
        spatial = to_base @ self.covariance(covariance, self.way - way) @ to_base.T
        self._key = (self.rotation, self.z, self.way)
        return T, 0.5 * (spatial + spatial.T), to_base @ jacobian


def _pose(planar: Sequence[float], z: float, rotation: Rotation) -> FloatArray:
    x, y, yaw = planar
    c, s = math.cos(yaw), math.sin(yaw)
    (ax, ay, az), (bx, by, bz), up = rotation
    ahead = [c * ax - s * bx, c * ay - s * by, c * az - s * bz, x]
    left = [s * ax + c * bx, s * ay + c * by, s * az + c * bz, y]
    return of_floats([*ahead, *left, *up, z, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
