"""Dead reckoning of the method `robust`: one extended Kalman filter, from IMU and screws or a ready-made odometry.

Both sources share pose, velocity and the drag of the whiskers (`drag_direction`); `planar_motion` has the state.

- `fused`: the gyro is an input and its bias a state; the screws measure the velocity, of which slip takes a share:
  screws = v / (1 - slip), slip = mean + varying part per axis, the latter a Gauss-Markov process in the distance
  driven. Screws that stand measure a velocity of zero.
- `odometry`: its samples measure the velocity plus a bias per axis and white noise (`ready_made_odometry`).
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import ImuSample, Measurement, OdometrySample, ScrewAngles, ScrewSpeeds
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.estimation import planar_start
from robominer_slam.estimation.drag_direction import DragDirection
from robominer_slam.estimation.imu_batch import ImuBatch
from robominer_slam.estimation.keyframe_motion import KeyframeMotion
from robominer_slam.estimation.odometry_state import OdometryState
from robominer_slam.estimation.planar_filter import PlanarFilter
from robominer_slam.estimation.planar_motion import (
    GYRO_BIAS,
    REL,
    VELOCITY,
    Inputs,
    MotionNoise,
    compose,
    compose_jacobian,
    given_bias,
    motion_ahead,
)
from robominer_slam.estimation.planar_start import MATCH_STATES, ODOMETRY_BIAS
from robominer_slam.estimation.ready_made_odometry import ReadyMadeOdometry
from robominer_slam.estimation.scan_match import match_measurement, relative_covariance
from robominer_slam.estimation.screw_speeds import MAX_INTERVAL_S, ScrewAngleSpeeds, ScrewSpeedAssembly
from robominer_slam.estimation.slow_walk import SlowWalk
from robominer_slam.estimation.spatial_pose import SpatialPose
from robominer_slam.estimation.turn_comparison import TurnComparison

FloatArray = NDArray[np.float64]
Source = Literal["fused", "odometry"]

#: Encoders may be read fifty or a hundred times a second: unless it is asked, the filter goes on less often than that.
LEAST_SCREW_INTERVAL_NS = 30_000_000
#: Squared deviations between screws and gyro beyond which the screws are trusted less.
DISAGREEMENT = 4.0


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
        x, variance = planar_start.fused(settings) if fused else planar_start.odometry(settings)
        self._match = slice(len(x) - MATCH_STATES, len(x))
        self._walk = SlowWalk(settings, fused, self._match, variance[self._match].tolist())
        self._bias = slice(GYRO_BIAS, GYRO_BIAS + 1) if fused else ODOMETRY_BIAS
        self._filter = PlanarFilter(x, np.diag(variance), settings.gate)
        self._R_screws = (screw_matrix[:3] @ screw_matrix[:3].T) * settings.sigma_screw_speed**2
        self._R_linear: list[float] = self._R_screws[:2, :2].ravel().tolist()
        self._speeds = ScrewSpeedAssembly()
        self._imu = ImuBatch()
        self._space = SpatialPose(settings, tilts=fused)
        self._comparison = TurnComparison(settings.sigma_still, float(self._R_screws[2, 2]))
        #: What a disagreement with the gyro makes of the screws' variance.
        self._distrust = 1.0
        self._stamp_ns: int | None = None
        self._marked_ns: int | None = None
        self._angles = ScrewAngleSpeeds(LEAST_SCREW_INTERVAL_NS)
        feels = drag.whiskers if drag is not None and settings.standstill else None
        self._odometry = ReadyMadeOdometry(settings, self._filter, feels, self._predict, self._rest_until)
        self._screws_ns: int | None = None
        self._input = np.zeros(2)
        #: Covariance of the screws' vx, vy: xx, xy, yy.
        self._Q_input = (0.0, 0.0, 0.0)
        self._state: OdometryState | None = None
        self._stale = 0

    def add(self, measurement: Measurement) -> None:
        """Take a measurement of the source; others are ignored."""
        self._state = None
        if self._source == "odometry":
            if isinstance(measurement, OdometrySample):
                self._odometry.add(measurement)
            return
        match measurement:
            case ImuSample():
                self._imu.add(measurement)
            case ScrewAngles():
                self._take_speed(measurement.stamp_ns, self._angles.add(measurement), self._angles.readings)
            case ScrewSpeeds():
                self._take_speed(measurement.stamp_ns, self._speeds.add(measurement), 1)

    def add_contacts(self, stamp_ns: int, contacts: Contacts) -> None:
        """Take the contacts of a whisker frame; `state_at` then knows of them."""
        if self._drag is None:
            return
        if self._source == "odometry":
            self._state = None
            self._odometry.feel(stamp_ns, contacts)
        self._go_on(stamp_ns)
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
        self._go_on(stamp_ns)
        if self._state is not None and self._state.stamp_ns == stamp_ns:
            return self._state
        x, P = self._filter.x, self._filter.P
        pose = compose(x)
        J = compose_jacobian(x)
        covariance = J.dot(P).dot(J.T)
        self._state = OdometryState(
            stamp_ns,
            *pose,
            x[VELOCITY].copy(),
            covariance,
            P[VELOCITY, VELOCITY].copy(),
            self._space.pose(pose),
            self._space.covariance(covariance),
        )
        return self._state

    def mark_keyframe(self, stamp_ns: int) -> KeyframeMotion:
        """Motion since the last mark (or the start); the present pose becomes the new reference."""
        self._go_on(stamp_ns)
        self._filter.walk(*self._walk.take())
        x, P, b = self._filter.x, self._filter.P, self._bias
        T, covariance, jacobian = self._space.motion(x[REL], *given_bias(x, P, b))
        marked, self._marked_ns = self._marked_ns, stamp_ns
        since = 0.0 if marked is None else (stamp_ns - marked) * 1e-9
        settings = self._settings
        walk = settings.gyro_bias_walk if self._source == "fused" else settings.odometry_bias_walk
        motion = KeyframeMotion(
            stamp_ns,
            T,
            covariance,
            jacobian,
            x[b].copy(),
            x[b].copy(),
            P[b, b].copy(),
            walk**2 * since * np.eye(b.stop - b.start),
        )
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
        self._go_on(stamp_ns)
        self._filter.walk(*self._walk.take())
        told = match_measurement(self._filter.x, self._match, offset, information)
        if told is not None:
            self._filter.correct(*told)
            self._state = None

    def relative_covariance(self) -> FloatArray:
        """Covariance of (x, y, yaw) since the last keyframe, in odom, shape (3, 3)."""
        return relative_covariance(self._filter.x, self._filter.P)

    @property
    def bias(self) -> FloatArray:
        """Estimated bias: the vertical gyro's, shape (1,), rad/s, or the ready-made odometry's, shape (3,)."""
        return self._filter.x[self._bias].copy()

    @property
    def stale(self) -> int:
        """Measurements of motion left out: out of order, after a gap, or faster than the robot is."""
        return self._stale + self._angles.stale + self._odometry.stale

    @property
    def outliers(self) -> int:
        """Measurements beyond the gate."""
        return self._filter.outliers

    def _rest_until(self, stamp_ns: int) -> None:
        """Let time pass while the robot stands."""
        self._stamp_ns = stamp_ns

    def _take_speed(self, stamp_ns: int, speed: FloatArray | None, readings: int) -> None:
        """Take the screws' speeds, the mean of so many readings."""
        if speed is None:
            return
        before, self._screws_ns = self._screws_ns, stamp_ns
        settings, comparison = self._settings, self._comparison
        screws = self._screw_matrix.dot(speed)
        vx, vy, wz, slip = screws.tolist()
        if math.hypot(vx, vy) > settings.fastest:
            self._stale += 1
            return
        still = max(map(abs, speed.tolist())) < settings.still_screw_speed
        self._input = screws[:2]
        if still:
            creep = settings.sigma_still**2 / readings
            self._Q_input = (creep, 0.0, creep)
        else:
            mode, distrust = (settings.slip_mode_weight * slip) ** 2 / readings, self._distrust / readings
            xx, xy, _, yy = self._R_linear
            self._Q_input = (xx * distrust + mode, xy * distrust, yy * distrust + mode)
        self._predict(stamp_ns)
        if before is None:
            return
        if not comparison.running:
            # Without a gyro, the screws are all that says how fast the body turns.
            self._filter.correct(*comparison.screws_alone(self._filter.x, wz, still, settings))
        elif comparison.add_screws(wz * (stamp_ns - before) * 1e-9, still, readings):
            distance = self._filter.correct(*comparison.measurement(self._filter.x))
            self._distrust = max(1.0, distance / DISAGREEMENT)
            comparison.start(running=True)

    def _go_on(self, stamp_ns: int) -> None:
        """Predict, with the screws' last reading, which may have waited for another."""
        waiting = self._angles.waiting()
        if waiting is not None:
            self._take_speed(*waiting, self._angles.readings)
        if self._source == "fused" or not self._odometry.holds:
            self._predict(stamp_ns)

    def _predict(self, stamp_ns: int) -> None:
        previous = self._stamp_ns
        if previous is None or stamp_ns <= previous:
            self._stamp_ns = stamp_ns if previous is None else previous
            return
        self._stamp_ns = stamp_ns
        settings, ekf = self._settings, self._filter
        dt = (stamp_ns - previous) * 1e-9
        vx, vy, wz = ekf.x[VELOCITY].tolist()
        way = math.hypot(vx, vy) * dt
        walked = self._walk.add(way, abs(wz) * dt, dt)
        walk = settings.acceleration_walk**2 * dt
        turn_walk = settings.angular_acceleration_walk**2 * dt
        Q_linear = (walk, 0.0, walk)
        gyro = screws = None
        if self._source == "fused":
            gyro, turn_walk = self._turn(previous, stamp_ns, dt, turn_walk)
            if self._screws_ns is not None and stamp_ns - self._screws_ns < MAX_INTERVAL_S * 1e9:
                screws = self._input
                Q_linear = self._Q_input
        noise = MotionNoise(*Q_linear, turn_walk, settings.position_walk**2 * way)
        (a, b, _), (c, d, _), _ = self._space.rotation
        ekf.move(Inputs(dt, gyro, screws, ((a, b), (c, d))), noise)
        if walked:
            ekf.walk(*self._walk.take())
        self._space.advance(ekf.x[VELOCITY], dt)

    def _turn(self, from_ns: int, until_ns: int, dt: float, walk: float) -> tuple[float | None, float]:
        """Take the IMU's samples of an interval; the turn rate with its bias, rad/s, and its variance.

        Without a gyro there is no rate, and the variance is that by which the turn rate walks.
        """
        imu, comparison = self._imu, self._comparison
        samples = max(imu.samples, 1)
        rate = imu.mean_rate(from_ns, until_ns)
        gyro = self._space.turn(imu, rate, self._filter.x[VELOCITY], dt)
        if gyro is None:
            comparison.start(running=False)
            return None, walk
        if not comparison.running:
            comparison.start(running=True)
        else:
            if comparison.begins:
                self._filter.begin_window()
            comparison.add_gyro(dt)
        return gyro, self._settings.sigma_gyro**2 / samples
