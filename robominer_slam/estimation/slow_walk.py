"""How the robust filter's slow states change, added up over many intervals.

Biases, slip and what matches have in common walk by the way or the time, so little in one interval that the filter
need not be told each time: the sums are the same.
"""

from __future__ import annotations

import math

from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.estimation.planar_motion import GYRO_BIAS, SLIP
from robominer_slam.estimation.planar_start import ODOMETRY_BIAS

#: The filter is told after so much time, s, or so much of the length over which slip changes.
TOLD_AFTER_S = 0.2
TOLD_AFTER_SHARE = 0.02


class SlowWalk:
    """Sums of way, turning and time since the filter was told.

    Args:
        settings: noise, with units and reasons there.
        fused: with gyro and screws; else with a ready-made odometry.
        match: where in the state the offset is that matches have in common.
        match_variance: its variances, one of each.
    """

    def __init__(
        self, settings: RobustEstimationSection, fused: bool, match: slice, match_variance: list[float]
    ) -> None:
        self._settings = settings
        self._fused = fused
        self._match, self._match_variance = match, match_variance
        self._way = self._passed = self._time = 0.0

    def add(self, way: float, turned: float, dt: float) -> bool:
        """Go on by a way, m, and an angle, rad, in `dt` seconds; True when it is time to tell."""
        self._way += way
        self._passed += way + turned * self._settings.slip_turn_arm
        self._time += dt
        return self._time >= TOLD_AFTER_S or self._passed >= TOLD_AFTER_SHARE * self._settings.slip_length

    def take(self) -> tuple[list[float], float]:
        """Variances that the states have gained, and the factor by which the varying slip has faded; begins anew."""
        settings = self._settings
        way, passed, time = self._way, self._passed, self._time
        self._way = self._passed = self._time = 0.0
        q = [0.0] * self._match.stop
        again = 2.0 * way / settings.match_length
        q[self._match] = [variance * again for variance in self._match_variance]
        if not self._fused:
            q[ODOMETRY_BIAS] = [settings.odometry_bias_walk**2 * time] * 3
            return q, 1.0
        q[GYRO_BIAS] = settings.gyro_bias_walk**2 * time
        kept = math.exp(-passed / settings.slip_length)
        q[SLIP] = [settings.sigma_slip**2 * (1.0 - kept * kept)] * 3
        return q, kept
