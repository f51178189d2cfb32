"""Where odom is in map: what the back-end has found, and how sure the pose in map is by it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.estimation.odometry_state import OdometryState
from robominer_slam.float_array import of_floats
from robominer_slam.slam.keyframe import BackendResult, Keyframe

FloatArray = NDArray[np.float64]


class MapPose:
    """The correction map -> odom of the last result that took effect.

    Attributes:
        T_map_odom: shape (4, 4).
    """

    def __init__(self) -> None:
        self.T_map_odom = np.eye(4)
        self._first_covariance = np.zeros((3, 3))
        self._last: BackendResult | None = None
        # Of the last result: its covariance in map, and odometry's variances at its keyframe.
        self._covariance_at_last = np.zeros((3, 3))
        self._odometry_at_last: list[float] | None = None
        self._odometry_of_keyframe: dict[int, FloatArray] = {}

    def begin(self) -> None:
        """A new map, whose frame is odom."""
        self.T_map_odom = np.eye(4)
        self._last = self._odometry_at_last = None
        self._odometry_of_keyframe.clear()

    def place(self, x: float, y: float, yaw: float, T_odom_base: FloatArray) -> None:
        """Put base_link, now at `T_odom_base`, to (x, y) with heading yaw in map, m and rad."""
        self.T_map_odom = geometry.T_from_xyyaw([x, y, yaw]) @ geometry.inverse(T_odom_base)

    def keyframe(self, keyframe: Keyframe, odometry: OdometryState) -> None:
        """A keyframe was made: its result will be of the odometry as it is now."""
        self._odometry_of_keyframe[keyframe.id] = odometry.covariance
        if keyframe.id == 0:
            self._first_covariance = odometry.covariance

    def take(self, result: BackendResult) -> None:
        """A result takes effect; the correction itself is taken by `correct`, if it is to count."""
        self._last = result
        self._odometry_at_last = self._odometry_of_keyframe.pop(result.keyframe.id).diagonal().tolist()
        self._covariance_at_last = self._first_covariance + result.covariance

    def correct(self, result: BackendResult) -> None:
        """Take a result's correction."""
        self.T_map_odom = result.T_map_odom

    @property
    def counts(self) -> Mapping[str, int]:
        """What the back-end had counted at its last result, by name."""
        return {} if self._last is None else self._last.counts

    def covariance(self, odometry: OdometryState) -> FloatArray:
        """Covariance of (x, y, yaw) in map, shape (3, 3): the keyframe's, grown by odometry since.

        The graph takes its first keyframe as exact; the way to it from the map's origin was odometry's.
        """
        c, s = self.T_map_odom[:2, 0].tolist()
        if self._last is None or self._odometry_at_last is None:
            R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            covariance: FloatArray = R @ odometry.covariance @ R.T
            return covariance
        x_then, y_then, yaw_then = self._odometry_at_last
        x, y, yaw = odometry.covariance.diagonal().tolist()
        x, y, yaw = max(x - x_then, 0.0), max(y - y_then, 0.0), max(yaw - yaw_then, 0.0)
        xy = c * s * (x - y)
        turned = of_floats([c * c * x + s * s * y, xy, 0.0, xy, s * s * x + c * c * y, 0.0, 0.0, 0.0, yaw])
        covariance = self._covariance_at_last + turned.reshape(3, 3)
        return covariance
