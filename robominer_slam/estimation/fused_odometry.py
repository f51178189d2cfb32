"""Dead reckoning from IMU and screws: an extended Kalman filter over pose, body velocity and gyro bias.

State (x, y, yaw, vx, vy, wz, b): pose in odom, body velocity, gyro bias. The velocity is a random walk; the gyro
measures wz + b, the screws (vx, vy, wz), and screws that stand still measure a velocity of zero (which makes the
gyro bias visible). Slip is not white: it enters as an error of the position that grows with the distance driven.
The body is taken as level.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ImuSample, Measurement, ScrewAngles, ScrewSpeeds
from robominer_slam.configuration.model import EstimationSection
from robominer_slam.estimation.kalman_filter import KalmanFilter
from robominer_slam.estimation.odometry_state import OdometryState
from robominer_slam.estimation.screw_speeds import ScrewAngleSpeeds, ScrewSpeedAssembly

FloatArray = NDArray[np.float64]

X, Y, YAW, VX, VY, WZ, BIAS = range(7)
VELOCITY = slice(VX, BIAS)
STATE = 7
#: Deviation of the velocity, m/s and rad/s, of a robot whose screws stand still: it may creep.
STILL_SIGMA = 0.002

H_GYRO = np.zeros((1, STATE))
H_GYRO[0, [WZ, BIAS]] = 1.0
H_VELOCITY = np.zeros((3, STATE))
H_VELOCITY[[0, 1, 2], [VX, VY, WZ]] = 1.0


def motion(state: FloatArray, dt: float) -> FloatArray:
    """The state `dt` seconds later at constant body velocity, shape (7,); midpoint in the heading."""
    heading = state[YAW] + 0.5 * state[WZ] * dt
    c, s = np.cos(heading), np.sin(heading)
    later = state.copy()
    later[X] += (c * state[VX] - s * state[VY]) * dt
    later[Y] += (s * state[VX] + c * state[VY]) * dt
    later[YAW] += state[WZ] * dt
    return later


def motion_jacobian(state: FloatArray, dt: float) -> FloatArray:
    """Derivative of `motion` by the state, shape (7, 7)."""
    heading = state[YAW] + 0.5 * state[WZ] * dt
    c, s = np.cos(heading), np.sin(heading)
    F = np.eye(STATE)
    dx_heading = (-s * state[VX] - c * state[VY]) * dt
    dy_heading = (c * state[VX] - s * state[VY]) * dt
    F[X, [YAW, VX, VY, WZ]] = dx_heading, c * dt, -s * dt, 0.5 * dt * dx_heading
    F[Y, [YAW, VX, VY, WZ]] = dy_heading, s * dt, c * dt, 0.5 * dt * dy_heading
    F[YAW, WZ] = dt
    return F


class FusedOdometry:
    """Fuses IMU (gyro) and screws; measurements come in the order of their stamps.

    Args:
        noise: the filter's noise, with units and reasons there.
        screw_matrix: from `screw_kinematics.forward_matrix`, shape (4, 4).
    """

    def __init__(self, noise: EstimationSection, screw_matrix: FloatArray) -> None:
        self._noise = noise
        self._screw_matrix = screw_matrix
        variance = [0.0, 0.0, 0.0, 1e-4, 1e-4, 1e-4, noise.sigma_gyro_bias_start**2]
        self._filter = KalmanFilter(np.zeros(STATE), np.diag(variance))
        self._stamp_ns: int | None = None
        self._angles = ScrewAngleSpeeds()
        self._speeds = ScrewSpeedAssembly()
        self._R_gyro = np.array([[noise.sigma_gyro**2]])
        self._R_screws = np.diag(np.square([noise.sigma_screws_vx, noise.sigma_screws_vy, noise.sigma_screws_wz]))
        self._slip = np.array([noise.screw_slip, noise.screw_slip, noise.screw_slip_turn])
        self._R_still = np.eye(3) * STILL_SIGMA**2

    def add(self, measurement: Measurement) -> None:
        """Take an IMU sample or a screws' reading; others are ignored."""
        match measurement:
            case ImuSample(gyro=gyro) if gyro is not None:
                self._predict(measurement.stamp_ns)
                self._filter.correct(gyro[2:3] - H_GYRO @ self._filter.x, H_GYRO, self._R_gyro)
            case ScrewAngles():
                speed = self._angles.add(measurement)
                if speed is not None:
                    self._predict(measurement.stamp_ns)
                    self._update_screws(speed)
            case ScrewSpeeds():
                speed = self._speeds.add(measurement)
                if speed is not None:
                    self._predict(measurement.stamp_ns)
                    self._update_screws(speed)
            case _:
                pass

    def measures_motion(self, measurement: Measurement) -> bool:
        """The screws do, if all four are heard of; a gyro alone does not."""
        if isinstance(measurement, ScrewSpeeds):
            return bool(np.isfinite(measurement.speed).all()) or self._speeds.complete(measurement.stamp_ns)
        return isinstance(measurement, ScrewAngles)

    def state_at(self, stamp_ns: int) -> OdometryState:
        """The state at a time that is not before the last measurement's."""
        self._predict(stamp_ns)
        x, P = self._filter.x, self._filter.P
        return OdometryState(
            stamp_ns,
            float(x[X]),
            float(x[Y]),
            float(x[YAW]),
            x[VELOCITY].copy(),
            P[:VX, :VX].copy(),
            P[VELOCITY, VELOCITY].copy(),
        )

    @property
    def stale(self) -> int:
        """Readings of the screws' angles out of order or after a gap."""
        return self._angles.stale

    @property
    def gyro_bias(self) -> float:
        """Estimated gyro bias, rad/s."""
        return float(self._filter.x[BIAS])

    def _update_screws(self, speed: FloatArray) -> None:
        if np.abs(speed).max() < self._noise.still_screw_speed:
            self._filter.correct(-self._filter.x[VELOCITY], H_VELOCITY, self._R_still)
        else:
            velocity = (self._screw_matrix @ speed)[:3]
            # Slip takes a share of what the screws do: fast motion is known less well than slow motion.
            R = self._R_screws + np.diag(np.square(self._slip * velocity))
            self._filter.correct(velocity - self._filter.x[VELOCITY], H_VELOCITY, R)

    def _predict(self, stamp_ns: int) -> None:
        previous = self._stamp_ns
        if previous is None or stamp_ns <= previous:
            self._stamp_ns = stamp_ns if previous is None else previous
            return
        self._stamp_ns = stamp_ns
        ekf, noise = self._filter, self._noise
        dt = (stamp_ns - previous) * 1e-9
        F = motion_jacobian(ekf.x, dt)
        driven = float(np.hypot(ekf.x[VX], ekf.x[VY])) * dt
        slip = noise.position_walk**2 * driven
        walk = noise.acceleration_walk**2 * dt
        turn = noise.angular_acceleration_walk**2 * dt
        ekf.x = motion(ekf.x, dt)
        ekf.P = F @ ekf.P @ F.T + np.diag([slip, slip, 0.0, walk, walk, turn, noise.gyro_bias_walk**2 * dt])
