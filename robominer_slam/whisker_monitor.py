"""Between angles and contacts: which whiskers can be believed, which are free though bent, where rest has moved to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator, WhiskerAngles
from drivers.measurement import HallFrame
from robominer_slam.estimation.odometry_state import OdometryState
from robominer_slam.flow_bend import FlowBend
from robominer_slam.rest_tracking import RestTracker
from robominer_slam.whisker_health import WhiskerHealth

BoolArray = NDArray[np.bool_]


class WhiskerMonitor:
    """Health, rest positions and flow, in the order in which they need one another.

    Attributes:
        health: states of the whiskers.
        rest: rest positions.
        flow: the common bend of free rods.
    """

    def __init__(self, health: WhiskerHealth, rest: RestTracker, flow: FlowBend) -> None:
        """Watch with these."""
        self.health, self.rest, self.flow = health, rest, flow

    def judge(
        self, frame: HallFrame, angles: WhiskerAngles, odometry: OdometryState, estimator: AngleEstimator
    ) -> tuple[BoolArray, BoolArray]:
        """Take a frame; the estimator's rest positions are moved where they have drifted.

        Returns:
            Whiskers whose angles can be believed, and those of them that may touch, shape (n,) each.
        """
        if frame.representation != "Cartesian":
            # Directions alone have no strength and no noise in mT to judge by.
            return angles.valid, angles.valid
        stamp, phi, azimuth = frame.stamp_ns, angles.inclination, angles.azimuth
        well = self.health.update(
            stamp,
            frame.field_mT.reshape(-1, 3),
            frame.valid.reshape(-1),
            phi,
            azimuth,
            (odometry.x, odometry.y),
        )
        well = well & angles.valid
        # Bent and drifting whiskers are watched on: that is how they come back.
        watched = angles.valid & self.health.watched
        shift = self.rest.update(stamp, watched, phi, azimuth, (odometry.x, odometry.y, odometry.yaw))
        if shift is not None:
            estimator.shift_rest(shift)
        self.health.set_rest_state(self.rest.state)
        free = self.flow.free(stamp, phi, azimuth, well, odometry.yaw, odometry.velocity)
        return well, well if free is None else well & ~free
