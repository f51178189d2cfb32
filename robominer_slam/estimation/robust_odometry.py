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
    SLIP,
    SLIP_MEAN,
    SLOW,
    VELOCITY,
    VX,
    VY,
    WZ,
    YAW,
    Inputs,
    PlanarFilter,
    X,
    Y,
    compose,
    compose_jacobian,
)
from robominer_slam.estimation.screw_speeds import ScrewSpeedAssembly

FloatArray = NDArray[np.float64]
Source = Literal["fused", "odometry"]

#: A gap in readings longer than this has no meaningful mean speed.
MAX_INTERVAL_S = 0.5
#: Slow states with a ready-made odometry: its biases of vx, vy, wz.
ODOMETRY_BIAS = slice(SLOW, SLOW + 3)
#: Less information about a direction, 1/m2 or 1/rad2, is none.
LEAST_INFORMATION = 1.0
#: Screws and gyro are compared over so long, s.
TURN_WINDOW_S = 0.2
#: Velocity at the start may be anything a robot does.
SIGMA_START = np.array([0.01, 0.01, 0.01])
#: More slip than this is a robot that is stuck: the model ends there.
MAX_SLIP = 0.9
#: Deviations of what a level body is taken to have: z per keyframe (m), roll and pitch (rad).
SIGMA_Z, SIGMA_TILT = 0.005, 0.005


def screw_turn(state: FloatArray, gyro_angle: float, span: float) -> FloatArray:
    """Angle by which the screws seem to turn the body while the gyro reads `gyro_angle`, rad, shape (1,)."""
    grip = max(1.0 - state[SLIP_MEAN.stop - 1] - state[SLIP.stop - 1], 1.0 - MAX_SLIP)
    return np.array([(gyro_angle - state[GYRO_BIAS] * span) / grip])


def screw_turn_jacobian(state: FloatArray, gyro_angle: float, span: float) -> FloatArray:
    """Derivative of `screw_turn` by the state, shape (1, n)."""
    grip = max(1.0 - state[SLIP_MEAN.stop - 1] - state[SLIP.stop - 1], 1.0 - MAX_SLIP)
    H = np.zeros((1, len(state)))
    H[0, GYRO_BIAS] = -span / grip
    H[0, SLIP_MEAN.stop - 1] = H[0, SLIP.stop - 1] = (gyro_angle - state[GYRO_BIAS] * span) / grip**2
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
        self._R_screws = (screw_matrix[:3] @ screw_matrix[:3].T) * settings.sigma_screw_speed**2
        self._speeds = ScrewSpeedAssembly()
        self._gyro = GyroBatch()
        self._stamp_ns: int | None = None
        self._screws: ScrewAngles | None = None
        self._odometry_ns: int | None = None
        self._screws_ns: int | None = None
        self._input, self._Q_input = np.zeros(2), np.zeros((2, 2))
        self._turn_variance = 0.0
        self._turn_gyro: float | None = None
        self._turn_screws = self._turn_span = 0.0
        self._turn_readings, self._turn_still = 0, True
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
        ekf = self._filter
        found = self._drag.measure(stamp_ns, contacts, ekf.x[VELOCITY], ekf.P[VELOCITY, VELOCITY])
        if found is None:
            return
        rows, innovation = found.compressed()
        H = np.zeros((len(rows), len(self._filter.x)))
        H[:, VELOCITY] = rows
        ekf.correct(innovation, H, np.eye(len(rows)), self._along_motion())

    def _along_motion(self) -> FloatArray:
        """Combinations of states that are motion ahead, shape (k, n): the drag's angle must not move them.

        Its derivative by them is zero but for noise in the direction, which repeated updates would take for
        knowledge of the speed.
        """
        x = self._filter.x
        vx, vy = x[VX], x[VY]
        size = max(math.hypot(vx, vy), 1e-9)
        ahead = np.array([vx, vy]) / size
        c, s = math.cos(x[YAW]), math.sin(x[YAW])
        if self._source == "odometry":
            held = np.zeros((3, len(x)))
            held[2, SLOW : SLOW + 2] = ahead
        else:
            held = np.zeros((4, len(x)))
            by_slip = ahead * self._input
            by_slip = by_slip / max(math.hypot(by_slip[0], by_slip[1]), 1e-9)
            held[2, SLIP_MEAN.start : SLIP_MEAN.start + 2] = by_slip
            held[3, SLIP.start : SLIP.start + 2] = by_slip
        held[0, VX:WZ] = ahead
        held[1, X:YAW] = c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]
        return held

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
        before = self._screws_ns
        self._screws_ns = stamp_ns
        screws = self._screw_matrix @ speed
        still = float(np.abs(speed).max()) < self._settings.still_screw_speed
        self._use_screws(screws, still)
        self._predict(stamp_ns)
        if before is None or self._turn_gyro is None:
            self._start_turn_window()
            return
        dt = (stamp_ns - before) * 1e-9
        self._turn_screws += screws[2] * dt
        self._turn_readings += 1
        self._turn_still &= still
        if self._turn_span >= TURN_WINDOW_S:
            self._compare_turn()
            self._start_turn_window()

    def _use_screws(self, screws: FloatArray, still: bool) -> None:
        """Make a reading of all screws (vx, vy, wz, slip mode) the input from now on."""
        settings = self._settings
        self._input = screws[:2]
        if still:
            self._Q_input = np.eye(2) * settings.sigma_still**2
            return
        doubt = (settings.slip_mode_weight * screws[3]) ** 2
        self._Q_input = self._R_screws[:2, :2] + np.eye(2) * doubt

    def _compare_turn(self) -> None:
        ekf, settings = self._filter, self._settings
        gyro_angle, span = self._turn_gyro, self._turn_span
        assert gyro_angle is not None
        noise = self._turn_variance
        if self._turn_still:
            H = np.zeros((1, len(ekf.x)))
            H[0, GYRO_BIAS] = span
            R = noise + (settings.sigma_still * span) ** 2
            ekf.correct(np.array([gyro_angle - ekf.x[GYRO_BIAS] * span]), H, np.array([[R]]))
            return
        R = noise + self._R_screws[2, 2] * span**2 / self._turn_readings
        innovation = self._turn_screws - screw_turn(ekf.x, gyro_angle, span)
        ekf.correct(innovation, screw_turn_jacobian(ekf.x, gyro_angle, span), np.array([[R]]))

    def _start_turn_window(self) -> None:
        self._turn_gyro, self._turn_screws, self._turn_span = 0.0, 0.0, 0.0
        self._turn_variance, self._turn_readings, self._turn_still = 0.0, 0, True

    def _predict(self, stamp_ns: int) -> None:
        previous = self._stamp_ns
        if previous is None or stamp_ns <= previous:
            self._stamp_ns = stamp_ns if previous is None else previous
            return
        self._stamp_ns = stamp_ns
        settings, ekf = self._settings, self._filter
        dt = (stamp_ns - previous) * 1e-9
        x = ekf.x
        q = np.zeros(len(x))
        way = math.hypot(x[VX], x[VY]) * dt
        q[X] = q[Y] = settings.position_walk**2 * way
        walk = settings.acceleration_walk**2 * dt
        Q_velocity = np.diag([walk, walk, settings.angular_acceleration_walk**2 * dt])
        gyro = screws = None
        kept = 1.0
        if self._source == "fused":
            samples = max(self._gyro.samples, 1)
            rate = self._gyro.mean(previous, stamp_ns)
            if rate is not None:
                gyro = float(rate[2])
                Q_velocity[2, 2] = settings.sigma_gyro**2 / samples
                if self._turn_gyro is not None:
                    self._turn_gyro += gyro * dt
                    self._turn_span += dt
                    self._turn_variance += Q_velocity[2, 2] * dt * dt
            else:
                self._turn_gyro = None
            if self._screws_ns is not None and stamp_ns - self._screws_ns < MAX_INTERVAL_S * 1e9:
                screws = self._input
                Q_velocity[:2, :2] = self._Q_input
            q[GYRO_BIAS] = settings.gyro_bias_walk**2 * dt
            way += abs(float(x[WZ])) * dt * settings.slip_turn_arm
            kept = math.exp(-way / settings.slip_length)
            q[SLIP] = settings.sigma_slip**2 * (1.0 - kept * kept)
        else:
            q[ODOMETRY_BIAS] = settings.odometry_bias_walk**2 * dt
        ekf.move(Inputs(dt, gyro, screws), Q_velocity, q, kept)
