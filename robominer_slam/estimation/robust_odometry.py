"""Dead reckoning of the method `robust`: one extended Kalman filter, from IMU and screws or a ready-made odometry.

Both sources share pose, velocity and the drag of the whiskers (`drag_direction`); `planar_motion` has the state.

- `fused`: the gyro is an input and its bias a state; the screws measure the velocity, of which slip takes a share:
  screws = v / (1 - slip), slip = mean + varying part per axis, the latter a Gauss-Markov process in the distance
  driven. Screws that stand measure a velocity of zero.
- `odometry`: its samples measure the velocity plus a bias per axis and white noise; nothing else is used.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ImuSample, Measurement, OdometrySample, ScrewAngles, ScrewSpeeds
from robominer_slam import geometry
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.estimation.drag_direction import DragDirection
from robominer_slam.estimation.gyro_batch import GyroBatch
from robominer_slam.estimation.keyframe_motion import KeyframeMotion
from robominer_slam.estimation.odometry_state import OdometryState
from robominer_slam.estimation.planar_motion import (
    GYRO_BIAS,
    KEY_YAW,
    REL,
    SLOW,
    VELOCITY,
    VX,
    VY,
    WZ,
    X,
    Y,
    YAW,
    PlanarFilter,
    compose,
    compose_jacobian,
)
from robominer_slam.estimation.screw_speeds import ScrewSpeedAssembly

FloatArray = NDArray[np.float64]
Source = Literal["fused", "odometry"]

#: A gap in readings longer than this has no meaningful mean speed.
MAX_INTERVAL_S = 0.5
#: States of the sources after the common nine.
ODOMETRY_BIAS = slice(SLOW, SLOW + 3)
SLIP_MEAN, SLIP = slice(SLOW + 1, SLOW + 4), slice(SLOW + 4, SLOW + 7)
#: Less information about a direction, 1/m2 or 1/rad2, is none.
LEAST_INFORMATION = 1.0
#: Velocity at the start may be anything a robot does.
SIGMA_START = np.array([0.01, 0.01, 0.01])
#: More slip than this is a robot that is stuck: the model ends there.
MAX_SLIP = 0.9
#: Deviations of what a level body is taken to have: z per keyframe (m), roll and pitch (rad).
SIGMA_Z, SIGMA_TILT = 0.005, 0.005


def slipping_screws(state: FloatArray) -> FloatArray:
    """What the screws' kinematics say while the body moves as in `state`, shape (3,)."""
    grip = np.maximum(1.0 - state[SLIP_MEAN] - state[SLIP], 1.0 - MAX_SLIP)
    screws: FloatArray = state[VELOCITY] / grip
    return screws


def slipping_screws_jacobian(state: FloatArray) -> FloatArray:
    """Derivative of `slipping_screws` by the state, shape (3, n)."""
    grip = np.maximum(1.0 - state[SLIP_MEAN] - state[SLIP], 1.0 - MAX_SLIP)
    by_slip = state[VELOCITY] / grip**2
    H = np.zeros((3, len(state)))
    for k in range(3):
        H[k, VX + k] = 1.0 / grip[k]
        H[k, SLIP_MEAN.start + k] = H[k, SLIP.start + k] = by_slip[k]
    return H


class RobustOdometry:
    """Takes measurements and contacts in the order of their stamps.

    Args:
        settings: noise and limits, with units and reasons there.
        source: what measures the motion.
        drag: the whiskers' directions; None without whiskers that point down, or where it is not wanted.
        screw_matrix: from `screw_kinematics.forward_matrix`, shape (4, 4); for `fused`.
    """

    def __init__(
        self,
        settings: RobustEstimationSection,
        source: Source,
        drag: DragDirection | None,
        screw_matrix: FloatArray,
    ) -> None:
        self._settings = settings
        self._source = source
        self._drag = drag
        self._screw_matrix = screw_matrix
        fused = source == "fused"
        n = SLOW + (7 if fused else 3)
        variance = np.zeros(n)
        variance[VELOCITY] = SIGMA_START**2
        x = np.zeros(n)
        if fused:
            variance[GYRO_BIAS] = settings.sigma_gyro_bias**2
            variance[SLIP_MEAN] = settings.sigma_slip_mean**2
            variance[SLIP] = settings.sigma_slip**2
            x[SLIP_MEAN] = settings.slip_mean
        else:
            variance[ODOMETRY_BIAS] = settings.sigma_odometry_bias**2
        self._bias = slice(GYRO_BIAS, GYRO_BIAS + 1) if fused else ODOMETRY_BIAS
        self._filter = PlanarFilter(x, np.diag(variance), settings.gate)
        self._H_velocity = np.zeros((3, n))
        self._H_velocity[:, VELOCITY] = np.eye(3)
        self._H_odometry = self._H_velocity.copy()
        if not fused:
            self._H_odometry[:, ODOMETRY_BIAS] = np.eye(3)
        self._R_still = np.eye(3) * settings.sigma_still**2
        self._R_screws = (screw_matrix[:3] @ screw_matrix[:3].T) * settings.sigma_screw_speed**2
        self._speeds = ScrewSpeedAssembly()
        self._gyro = GyroBatch()
        self._stamp_ns: int | None = None
        self._screws: ScrewAngles | None = None
        self._odometry_ns: int | None = None
        self.stale = 0

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of the source; others are ignored."""
        if self._source == "odometry":
            if isinstance(measurement, OdometrySample):
                self._add_odometry(measurement)
            return
        match measurement:
            case ImuSample():
                self._add_imu(measurement)
            case ScrewAngles():
                self._add_angles(measurement)
            case ScrewSpeeds():
                speed = self._speeds.add(measurement)
                if speed is not None:
                    self._update_screws(measurement.stamp_ns, speed)
            case _:
                pass

    def add_contacts(self, stamp_ns: int, contacts: Contacts) -> None:
        """Take the contacts of a whisker frame; `state_at` then knows of them."""
        if self._drag is None:
            return
        self._predict(stamp_ns)
        found = self._drag.measure(stamp_ns, contacts, self._filter.x[VELOCITY])
        if found is None:
            return
        rows, innovation = found.compressed()
        H = np.zeros((len(rows), len(self._filter.x)))
        H[:, VELOCITY] = rows
        self._filter.correct(innovation, H, np.eye(len(rows)))

    def measures_motion(self, measurement: Measurement) -> bool:
        """Screws do if all four are heard of, or the ready-made odometry; a gyro alone does not."""
        if self._source == "odometry":
            return isinstance(measurement, OdometrySample)
        if isinstance(measurement, ScrewSpeeds):
            return bool(np.isfinite(measurement.speed).all()) or self._speeds.complete(measurement.stamp_ns)
        return isinstance(measurement, ScrewAngles)

    def state_at(self, stamp_ns: int) -> OdometryState:
        """The state at a time that is not before the last measurement's."""
        self._predict(stamp_ns)
        x, P = self._filter.x, self._filter.P
        pose = compose(x)
        J = compose_jacobian(x)
        return OdometryState(
            stamp_ns,
            float(pose[0]),
            float(pose[1]),
            float(pose[2]),
            x[VELOCITY].copy(),
            J @ P @ J.T,
            P[VELOCITY, VELOCITY].copy(),
        )

    def mark_keyframe(self, stamp_ns: int) -> KeyframeMotion:
        """Motion since the last mark (or the start); the present pose becomes the new reference."""
        self._predict(stamp_ns)
        x, P = self._filter.x, self._filter.P
        c, s = math.cos(x[YAW]), math.sin(x[YAW])
        to_new = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        b = self._bias
        P_bias = P[b, b].copy()
        by_bias = np.linalg.solve(P_bias + 1e-18 * np.eye(len(P_bias)), P[b, REL]).T
        conditional = P[REL, REL] - by_bias @ P[b, REL]
        covariance = np.diag([0.0, 0.0, SIGMA_Z**2, SIGMA_TILT**2, SIGMA_TILT**2, 0.0])
        planar = [0, 1, 5]
        covariance[np.ix_(planar, planar)] = to_new @ conditional @ to_new.T
        jacobian = np.zeros((6, len(P_bias)))
        jacobian[planar] = to_new @ by_bias
        motion = KeyframeMotion(
            stamp_ns,
            geometry.T_from_xyyaw(x[REL]),
            0.5 * (covariance + covariance.T),
            jacobian,
            x[b].copy(),
            x[b].copy(),
            P_bias,
        )
        self._filter.keyframe()
        return motion

    def correct_pose(self, stamp_ns: int, offset: FloatArray, information: FloatArray) -> None:
        """Take what a scan match says of the pose since the last keyframe.

        Args:
            stamp_ns: time of the scan.
            offset: of (x, y, yaw) in odom, measured less predicted, shape (3,).
            information: of it, shape (3, 3); directions without information are left alone.
        """
        self._predict(stamp_ns)
        x = self._filter.x
        c, s = math.cos(x[KEY_YAW]), math.sin(x[KEY_YAW])
        to_key = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        values, vectors = np.linalg.eigh(to_key @ information @ to_key.T)
        told = values > LEAST_INFORMATION
        if not told.any():
            return
        rows = vectors[:, told].T
        H = np.zeros((len(rows), len(x)))
        H[:, REL] = rows
        self._filter.correct(rows @ (to_key @ offset), H, np.diag(1.0 / values[told]))

    def relative_covariance(self) -> FloatArray:
        """Covariance of (x, y, yaw) since the last keyframe, in odom, shape (3, 3)."""
        x, P = self._filter.x, self._filter.P
        c, s = math.cos(x[KEY_YAW]), math.sin(x[KEY_YAW])
        to_odom = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        covariance: FloatArray = to_odom @ P[REL, REL] @ to_odom.T
        return covariance

    @property
    def bias(self) -> FloatArray:
        """Estimated bias: the vertical gyro's, shape (1,), rad/s, or the ready-made odometry's, shape (3,)."""
        return self._filter.x[self._bias].copy()

    @property
    def outliers(self) -> int:
        """Measurements beyond the gate."""
        return self._filter.outliers

    def _add_imu(self, sample: ImuSample) -> None:
        if sample.gyro is not None:
            self._gyro.add(sample.stamp_ns, sample.gyro)

    def _add_odometry(self, sample: OdometrySample) -> None:
        previous, self._odometry_ns = self._odometry_ns, sample.stamp_ns
        if previous is None:
            return
        interval = (sample.stamp_ns - previous) * 1e-9
        if not 0.0 < interval <= MAX_INTERVAL_S:
            self.stale += 1
            return
        # A mean over the interval holds for its middle.
        self._predict(sample.stamp_ns - round(0.5e9 * interval))
        variance = self._settings.sigma_odometry**2 / (30.0 * interval)
        x = self._filter.x
        self._filter.correct(sample.velocity - self._H_odometry @ x, self._H_odometry, variance * np.eye(3))

    def _add_angles(self, reading: ScrewAngles) -> None:
        previous, self._screws = self._screws, reading
        if previous is None:
            return
        interval = (reading.stamp_ns - previous.stamp_ns) * 1e-9
        if not 0.0 < interval <= MAX_INTERVAL_S:
            self.stale += 1
            return
        self._update_screws(reading.stamp_ns, (reading.angle - previous.angle) / interval)

    def _update_screws(self, stamp_ns: int, speed: FloatArray) -> None:
        self._predict(stamp_ns)
        ekf = self._filter
        if np.abs(speed).max() < self._settings.still_screw_speed:
            ekf.correct(-ekf.x[VELOCITY], self._H_velocity, self._R_still)
            return
        screws = self._screw_matrix @ speed
        R = self._R_screws + np.eye(3) * (self._settings.slip_mode_weight * screws[3]) ** 2
        ekf.correct(screws[:3] - slipping_screws(ekf.x), slipping_screws_jacobian(ekf.x), R)

    def _predict(self, stamp_ns: int) -> None:
        previous = self._stamp_ns
        if previous is None or stamp_ns <= previous:
            self._stamp_ns = stamp_ns if previous is None else previous
            return
        self._stamp_ns = stamp_ns
        settings, ekf = self._settings, self._filter
        dt = (stamp_ns - previous) * 1e-9
        x = ekf.x
        n = len(x)
        q = np.zeros(n)
        way = math.hypot(x[VX], x[VY]) * dt
        q[X] = q[Y] = settings.position_walk**2 * way
        q[VX] = q[VY] = settings.acceleration_walk**2 * dt
        gyro, fading = None, None
        if self._source == "fused":
            samples = max(self._gyro.samples, 1)
            rate = self._gyro.mean(previous, stamp_ns)
            gyro = None if rate is None else float(rate[2])
            q[GYRO_BIAS] = settings.gyro_bias_walk**2 * dt
            way += abs(float(x[WZ])) * dt * settings.slip_turn_arm
            kept = math.exp(-way / settings.slip_length)
            fading = (SLIP, kept)
            q[SLIP] = settings.sigma_slip**2 * (1.0 - kept * kept)
        else:
            q[ODOMETRY_BIAS] = settings.odometry_bias_walk**2 * dt
        Q = np.diag(q)
        if gyro is None:
            Q[WZ, WZ] = settings.angular_acceleration_walk**2 * dt
        else:
            variance = settings.sigma_gyro**2 / samples
            Q[WZ, WZ], Q[YAW, YAW] = variance, variance * dt * dt
            Q[WZ, YAW] = Q[YAW, WZ] = variance * dt
        ekf.move(dt, Q, gyro, fading=fading)
