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
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.estimation.drag_direction import DragDirection
from robominer_slam.estimation.imu_batch import ImuBatch
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
    motion_ahead,
)
from robominer_slam.estimation.screw_speeds import ScrewSpeedAssembly
from robominer_slam.estimation.spatial_pose import SpatialPose
from robominer_slam.estimation.turn_comparison import TurnComparison

FloatArray = NDArray[np.float64]
Source = Literal["fused", "odometry"]

#: A gap in readings longer than this has no meaningful mean speed.
MAX_INTERVAL_S = 0.5
#: Slow states with a ready-made odometry: its biases of vx, vy, wz.
ODOMETRY_BIAS = slice(SLOW, SLOW + 3)
#: Squared deviations between screws and gyro beyond which the screws are trusted less.
DISAGREEMENT = 4.0
#: Less information about a direction, 1/m2 or 1/rad2, is none.
LEAST_INFORMATION = 1.0
#: Velocity at the start may be anything a robot does.
SIGMA_START = np.array([0.01, 0.01, 0.01])


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
        n = SLOW + (7 if fused else 3) + 3
        # What scan matches have in common: whiskers' errors, as an offset of each match, in the body's axes.
        self._match = slice(n - 3, n)
        variance = np.zeros(n)
        variance[VELOCITY] = SIGMA_START**2
        self._match_variance = np.square(
            [settings.sigma_match, settings.sigma_match, np.deg2rad(settings.sigma_match_yaw_deg)]
        )
        variance[self._match] = self._match_variance
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
        self._imu = ImuBatch()
        self._space = SpatialPose(settings, tilts=fused)
        self._comparison = TurnComparison(settings.sigma_still, float(self._R_screws[2, 2]))
        #: What a disagreement with the gyro makes of the screws' variance.
        self._distrust = 1.0
        self._stamp_ns: int | None = None
        self._screws: ScrewAngles | None = None
        self._odometry_ns: int | None = None
        self._screws_ns: int | None = None
        self._input, self._Q_input = np.zeros(2), np.zeros((2, 2))
        self._state: OdometryState | None = None
        self.stale = 0

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of the source; others are ignored."""
        self._state = None
        if self._source == "odometry":
            if isinstance(measurement, OdometrySample):
                self._add_odometry(measurement)
            return
        match measurement:
            case ImuSample():
                self._imu.add(measurement)
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
        self._state = None
        rows, innovation = found.compressed()
        H = np.zeros((len(rows), len(ekf.x)))
        H[:, VELOCITY] = rows
        screws = self._input if self._source == "fused" else None
        ekf.correct(innovation, H, np.eye(len(rows)), motion_ahead(ekf.x, found.ahead, screws))

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
        if self._state is not None and self._state.stamp_ns == stamp_ns:
            return self._state
        x, P = self._filter.x, self._filter.P
        pose = compose(x)
        J = compose_jacobian(x)
        covariance = J @ P @ J.T
        self._state = OdometryState(
            stamp_ns,
            float(pose[0]),
            float(pose[1]),
            float(pose[2]),
            x[VELOCITY].copy(),
            covariance,
            P[VELOCITY, VELOCITY].copy(),
            self._space.pose(pose),
            self._space.covariance(covariance),
        )
        return self._state

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
        T, covariance, jacobian = self._space.motion(x[REL], to_new @ conditional @ to_new.T, to_new @ by_bias)
        motion = KeyframeMotion(stamp_ns, T, covariance, jacobian, x[b].copy(), x[b].copy(), P_bias)
        self._filter.keyframe()
        self._state = None
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
        H[:, self._match] = rows
        innovation = rows @ (to_key @ offset - x[self._match])
        self._filter.correct(innovation, H, np.diag(1.0 / values[told]))
        self._state = None

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
        before, self._screws_ns = self._screws_ns, stamp_ns
        settings, comparison = self._settings, self._comparison
        screws = self._screw_matrix @ speed
        if math.hypot(screws[0], screws[1]) > settings.fastest:
            self.stale += 1
            return
        still = float(np.abs(speed).max()) < settings.still_screw_speed
        self._input = screws[:2]
        if still:
            self._Q_input = settings.sigma_still**2 * np.eye(2)
        else:
            doubt = (settings.slip_mode_weight * screws[3]) ** 2
            self._Q_input = self._R_screws[:2, :2] * self._distrust + doubt * np.eye(2)
        self._predict(stamp_ns)
        if before is None:
            return
        if not comparison.running:
            self._turn_by_screws(float(screws[2]), still)
        elif comparison.add_screws(float(screws[2]) * (stamp_ns - before) * 1e-9, still):
            distance = self._filter.correct(*comparison.measurement(self._filter.x))
            self._distrust = max(1.0, distance / DISAGREEMENT)
            comparison.start(running=True)

    def _turn_by_screws(self, rate: float, still: bool) -> None:
        """Without a gyro, the screws are all that says how fast the body turns."""
        ekf, settings = self._filter, self._settings
        share = 1.0 - settings.slip_mean
        H = np.zeros((1, len(ekf.x)))
        H[0, WZ] = 1.0
        slip = (settings.sigma_slip**2 + settings.sigma_slip_mean**2) * rate**2
        R = settings.sigma_still**2 if still else self._R_screws[2, 2] + slip
        ekf.correct(np.array([share * rate - ekf.x[WZ]]), H, np.array([[R]]))

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
        q[self._match] = self._match_variance * (2.0 * way / settings.match_length)
        walk = settings.acceleration_walk**2 * dt
        Q_velocity = np.zeros((3, 3))
        Q_velocity[0, 0] = Q_velocity[1, 1] = walk
        Q_velocity[2, 2] = settings.angular_acceleration_walk**2 * dt
        gyro = screws = None
        kept = 1.0
        if self._source == "fused":
            gyro = self._turn(previous, stamp_ns, dt, Q_velocity)
            if self._screws_ns is not None and stamp_ns - self._screws_ns < MAX_INTERVAL_S * 1e9:
                screws = self._input
                Q_velocity[:2, :2] = self._Q_input
            q[GYRO_BIAS] = settings.gyro_bias_walk**2 * dt
            turned = way + abs(float(x[WZ])) * dt * settings.slip_turn_arm
            kept = math.exp(-turned / settings.slip_length)
            q[SLIP] = settings.sigma_slip**2 * (1.0 - kept * kept)
        else:
            q[ODOMETRY_BIAS] = settings.odometry_bias_walk**2 * dt
        ekf.move(Inputs(dt, gyro, screws, self._space.rotation[:2, :2]), Q_velocity, q, kept)
        self._space.advance(ekf.x[VELOCITY], dt)

    def _turn(self, from_ns: int, until_ns: int, dt: float, Q_velocity: FloatArray) -> float | None:
        """Take the IMU's samples of an interval; returns the turn rate with its bias, rad/s."""
        imu, comparison = self._imu, self._comparison
        samples = max(imu.samples, 1)
        rate = imu.mean_rate(from_ns, until_ns)
        gyro = self._space.turn(imu, rate, self._filter.x[VELOCITY], dt)
        if gyro is None:
            comparison.start(running=False)
            return None
        variance = self._settings.sigma_gyro**2 / samples
        Q_velocity[2, 2] = variance
        if not comparison.running:
            comparison.start(running=True)
        else:
            comparison.add_gyro(gyro * dt, variance * dt * dt, dt)
        return gyro
