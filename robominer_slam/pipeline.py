"""The way of a measurement: field -> angles -> contacts -> pose and map. No I/O; replay and the daemon share it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator, WhiskerAngles
from drivers.measurement import HallFrame, ImuSample, Measurement
from drivers.spherical import cartesian_frame
from robominer_slam import geometry
from robominer_slam.contacts import ContactModel, at_frame_start
from robominer_slam.estimation.imu_mounts import ImuMounts
from robominer_slam.estimation.odometry_state import (
    DeadReckoning,
    FeelsMotion,
    OdometryState,
    TakesScanMatches,
    TellsMotion,
    planar_pose,
)
from robominer_slam.frame_result import FrameResult, LocalizationState
from robominer_slam.load_shedding import Shed
from robominer_slam.map_pose import MapPose
from robominer_slam.reorder import ReorderBuffer
from robominer_slam.slam.backend_runner import BackendRunner
from robominer_slam.slam.composite_scan import CompositeScan
from robominer_slam.slam.keyframe import BackendResult, Keyframe
from robominer_slam.slam.place_prior import PlacePrior
from robominer_slam.slam.scan_odometry import ScanOdometry, with_height
from robominer_slam.whisker_monitor import WhiskerMonitor

FloatArray = NDArray[np.float64]

#: Without contacts for this long there is nothing to localise on.
BLIND_NS = 2_000_000_000
#: Without odometry for this long the robot may be anywhere near: the pose is not known.
ODOMETRY_TIMEOUT_NS = 2_000_000_000
#: Of x, y, yaw while the place in the map is not known: 10 m, and any heading.
UNKNOWN_COVARIANCE = np.diag([100.0, 100.0, 10.0])


class Pipeline:
    """Takes measurements of any device in any order; gives a result for every whisker frame.

    Args:
        dead_reckoning: pose in odom.
        angle_estimator: the array's calibration.
        monitor: which whiskers can be believed.
        contact_model: who touches, where.
        composite_scan: makes keyframes; None for odometry alone.
        runner: of the back-end; None for odometry alone.
        imu_mounts: rotation of each device's IMU in base_link, shape (3, 3), by device name.
        reorder_window_ns: see `ReorderBuffer`.
        scan_odometry: scan matching, for the method that has it.
        points_down: which whiskers feel the floor, shape (n,); None: all.
    """

    def __init__(
        self,
        dead_reckoning: DeadReckoning,
        angle_estimator: AngleEstimator,
        monitor: WhiskerMonitor,
        contact_model: ContactModel,
        composite_scan: CompositeScan | None,
        runner: BackendRunner | None,
        imu_mounts: Mapping[str, FloatArray],
        reorder_window_ns: int,
        scan_odometry: ScanOdometry | None = None,
        points_down: NDArray[np.bool_] | None = None,
    ) -> None:
        self.reorder = ReorderBuffer(reorder_window_ns)
        self.angle_estimator = angle_estimator
        self.monitor = monitor
        self.runner = runner
        self.paused = False
        self.shed = Shed.NOTHING
        self.wrong_size_frames = 0
        self.stale_frames = 0
        self._dead_reckoning = dead_reckoning
        # Asked once: to ask a protocol at runtime takes longer than what it is asked for.
        self._feels = dead_reckoning if isinstance(dead_reckoning, FeelsMotion) else None
        self._tells = dead_reckoning if isinstance(dead_reckoning, TellsMotion) else None
        self._takes_matches = dead_reckoning if isinstance(dead_reckoning, TakesScanMatches) else None
        self._contact_model = contact_model
        self._composite = composite_scan
        self._imu_mounts = ImuMounts(imu_mounts)
        self._scan_odometry = scan_odometry
        self._points_down = np.ones(angle_estimator.count, dtype=np.bool_) if points_down is None else points_down
        self.localised = True
        self._prior: PlacePrior | None = None
        self._sought_from = -1
        self._breaks = 0
        self._map_pose = MapPose()
        self._contact_ns: int | None = None
        self._odometry_ns: int | None = None
        self._last_frame: HallFrame | None = None
        self._unmatched = False

    def add(self, device: str, measurement: Measurement) -> list[FrameResult]:
        """Take a measurement of a device; returns the results of the frames that it releases."""
        due = self.reorder.add(device, measurement)
        return self._process(due) if due else []

    def finish(self) -> list[FrameResult]:
        """Process what still waits for its turn, at the end of the measurements."""
        return self._process(self.reorder.flush())

    @property
    def backend_counts(self) -> Mapping[str, int]:
        """What the back-end had counted at its last result, by name."""
        return self._map_pose.counts

    def rezero(self) -> bool:
        """Take the last frame as the array's rest position; False if there was none."""
        if self._last_frame is None:
            return False
        self.angle_estimator.rezero(self._last_frame.field_mT, self._last_frame.valid)
        self.monitor.rest.reset()
        return True

    def localize(self, x: float, y: float, yaw: float) -> None:
        """Place the robot: map -> odom such that base_link is at (x, y) with heading yaw (m, rad) now."""
        stamp = self._last_frame.stamp_ns if self._last_frame is not None else 0
        self._map_pose.place(x, y, yaw, planar_pose(self._dead_reckoning.state_at(stamp)))

    def localize_by_touch(self, prior: PlacePrior) -> None:
        """Look for the place in the map from now on, near the prior first; it counts once touches confirm it."""
        self.localize(prior.x, prior.y, prior.yaw)
        self.localised, self._prior = False, prior
        if self._composite is not None:
            self._composite.restart()
        if self._scan_odometry is not None:
            self._scan_odometry.clear()

    def start_new_map(self, composite_scan: CompositeScan | None, runner: BackendRunner | None) -> None:
        """Begin anew with an empty map whose frame is odom; what the former back-end still computes is dropped."""
        if self.runner is not None:
            self.runner.close()
        self._composite, self.runner = composite_scan, runner
        self._map_pose.begin()
        self.localised, self._prior, self._sought_from = True, None, -1

    def _process(self, due: list[tuple[str, Measurement]]) -> list[FrameResult]:
        results = []
        for device, taken in due:
            measurement = taken
            if isinstance(measurement, HallFrame):
                result = self._frame(measurement)
                if result is not None:
                    results.append(result)
                continue
            if isinstance(measurement, ImuSample):
                measurement = self._imu_mounts.in_base(device, measurement)
            elif self._dead_reckoning.measures_motion(measurement):
                self._odometry_ns = measurement.stamp_ns
            self._dead_reckoning.add(measurement)
        return results

    def _frame(self, frame: HallFrame) -> FrameResult | None:
        if frame.valid.size != self.angle_estimator.count:
            self.wrong_size_frames += 1
            return None
        if self._last_frame is not None and frame.stamp_ns <= self._last_frame.stamp_ns:
            # A burst out of order, or a device clock that jumped back: poses only go forward in time.
            self.stale_frames += 1
            return None
        frame = cartesian_frame(frame)
        if frame.representation == "Direction" and self.angle_estimator.representation != "Direction":
            # A calibration of fields says nothing about directions alone: such a frame has no contacts.
            frame = replace(frame, valid=np.zeros_like(frame.valid))
        self._last_frame = frame
        stamp = frame.stamp_ns
        angles = self.angle_estimator.angles(frame.field_mT, frame.valid)
        odometry = self._dead_reckoning.state_at(stamp)
        well, may_touch = self.monitor.judge(frame, angles, odometry, self.angle_estimator)
        angles = WhiskerAngles(angles.inclination, angles.azimuth, angles.direction, well)
        contacts = self._contact_model.contacts(angles, may_touch)
        contacts = at_frame_start(contacts, odometry.velocity, frame.sensor_period_ns)
        if len(contacts.index):
            self._contact_ns = stamp
        if self._feels is not None:
            self._feels.add_contacts(stamp, contacts)
            odometry = self._dead_reckoning.state_at(stamp)
        floor = self._points_down[contacts.index]
        odometry = self._matched(stamp, odometry, contacts.points, floor)
        T_odom_base = planar_pose(odometry)
        backend_results = self.runner.due(stamp) if self.runner is not None else []
        for result in backend_results:
            self._take(result)
        keyframe = self._keyframe(stamp, T_odom_base, contacts.points, floor, odometry)
        state = self._state(stamp)
        T_map_odom = self._map_pose.T_map_odom
        return FrameResult(
            stamp_ns=stamp,
            odometry=odometry,
            T_odom_base=T_odom_base,
            T_map_odom=T_map_odom,
            T_map_base=T_map_odom.dot(T_odom_base),
            covariance=self._map_pose.covariance(odometry) if self.localised else UNKNOWN_COVARIANCE,
            angles=angles,
            whisker_states=self.monitor.health.states(),
            contacts=contacts,
            state=state,
            keyframe=keyframe,
            backend_results=backend_results,
        )

    def _matched(
        self, stamp: int, odometry: OdometryState, contacts: FloatArray, floor: NDArray[np.bool_]
    ) -> OdometryState:
        """The odometry after matching the scan with the ground touched lately."""
        scans, reckoning = self._scan_odometry, self._takes_matches
        if scans is None or reckoning is None:
            return odometry
        if self.shed >= Shed.MATCHING:
            self._unmatched = True
            return odometry
        if self._unmatched:
            # The ground touched before is far behind by now.
            scans.clear()
            self._unmatched = False
        if not scans.moved(odometry.x, odometry.y, odometry.yaw):
            return odometry
        level, tilt = geometry.levelled(planar_pose(odometry))
        points = contacts.compress(floor, axis=0).dot(tilt.T)
        walls = contacts.compress(~floor, axis=0).dot(tilt.T)
        correction = scans.match(level, with_height(reckoning.relative_covariance()), points)
        if correction is not None:
            reckoning.correct_pose(stamp, correction.offset, correction.information)
            odometry = self._dead_reckoning.state_at(stamp)
            level, _ = geometry.levelled(planar_pose(odometry))
        along = scans.match_walls(level, walls)
        if along is not None:
            reckoning.correct_pose(stamp, along.offset, along.information)
            odometry = self._dead_reckoning.state_at(stamp)
            level, _ = geometry.levelled(planar_pose(odometry))
        if scans.breaks > self._breaks:
            self._broken(scans.breaks)
        scans.add(level, points, walls)
        return odometry

    def _broken(self, breaks: int) -> None:
        """The ground is not that of a moment ago: the place counts as unknown until the back-end has judged it."""
        self._breaks = breaks
        if self._composite is not None and self.runner is not None:
            self._composite.restart()
            self.localised, self._sought_from = False, self._composite.next_id

    def _keyframe(
        self,
        stamp: int,
        T_odom_base: FloatArray,
        points: FloatArray,
        floor: NDArray[np.bool_],
        odometry: OdometryState,
    ) -> Keyframe | None:
        if self._composite is None or self.runner is None or self.paused:
            return None
        keyframe = self._composite.add(stamp, T_odom_base, points, floor)
        if keyframe is not None:
            if self._tells is not None:
                keyframe = replace(keyframe, motion=self._tells.mark_keyframe(stamp))
            if self.shed >= Shed.LOOP_SEARCH:
                keyframe = replace(keyframe, searched=False)
            if self._scan_odometry is not None:
                keyframe = replace(keyframe, breaks=self._scan_odometry.breaks)
            if self._prior is not None:
                # Told some way before the keyframe was complete.
                x, y, yaw, _ = geometry.levelled(self._map_pose.T_map_odom @ T_odom_base)[0].tolist()
                keyframe = replace(keyframe, prior=replace(self._prior, x=x, y=y, yaw=yaw))
                self._prior, self._sought_from = None, keyframe.id
            self._map_pose.keyframe(keyframe, odometry)
            self.runner.submit(keyframe)
        return keyframe

    def _take(self, result: BackendResult) -> None:
        self._map_pose.take(result)
        if self._prior is not None or result.keyframe.id < self._sought_from:
            # Computed before the operator told the place.
            return
        self.localised = result.localised
        if result.localised:
            self._map_pose.correct(result)

    def _state(self, stamp: int) -> LocalizationState:
        if self._odometry_ns is None:
            # The map starts at the first pose, which is known by definition.
            self._odometry_ns = stamp
        if stamp - self._odometry_ns > ODOMETRY_TIMEOUT_NS:
            return "lost"
        if not self.localised:
            return "relocalizing"
        if self.runner is None or self._contact_ns is None or stamp - self._contact_ns > BLIND_NS or self.paused:
            return "dead_reckoning"
        return "tracking"
