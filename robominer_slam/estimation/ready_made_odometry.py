"""A ready-made odometry's samples as measurements of the robust filter: velocity, a bias per axis, white noise.

While the whiskers feel that the robot stands (`standstill`), the pose stays, and samples from deep within the
standstill tell the biases alone.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.measurement import OdometrySample
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.contacts import Contacts
from robominer_slam.estimation import planar_start
from robominer_slam.estimation.planar_filter import PlanarFilter
from robominer_slam.estimation.planar_motion import VELOCITY
from robominer_slam.estimation.planar_start import ODOMETRY_BIAS
from robominer_slam.estimation.screw_speeds import MAX_INTERVAL_S
from robominer_slam.estimation.standstill import OdometryReading, Standstill

FloatArray = NDArray[np.float64]


class ReadyMadeOdometry:
    """Corrects the filter with samples in the order of their stamps.

    Args:
        settings: noise and limits, with units and reasons there.
        ekf: the filter.
        whiskers: how many there are; None where what they feel is not to be used.
        predict: moves the filter on to a time.
        rest: takes the filter to a time without moving it.

    Attributes:
        stale: samples left out: out of order, or after a gap.
    """

    def __init__(
        self,
        settings: RobustEstimationSection,
        ekf: PlanarFilter,
        whiskers: int | None,
        predict: Callable[[int], None],
        rest: Callable[[int], None],
    ) -> None:
        self._filter = ekf
        self._predict, self._rest = predict, rest
        self._standstill = None if whiskers is None else Standstill(settings, whiskers)
        self._H = planar_start.odometry_rows()
        self._variance = settings.sigma_odometry**2 / 30.0
        self._still_variance = settings.sigma_still**2
        self._stamp_ns: int | None = None
        self.stale = 0

    @property
    def holds(self) -> bool:
        """Whether the robot stands, as far as is known: the pose stays."""
        return self._standstill is not None and self._standstill.holds

    def add(self, sample: OdometrySample) -> None:
        """Take a sample."""
        previous, self._stamp_ns = self._stamp_ns, sample.stamp_ns
        if previous is None:
            return
        interval = (sample.stamp_ns - previous) * 1e-9
        if not 0.0 < interval <= MAX_INTERVAL_S:
            self.stale += 1
            return
        reading = OdometryReading(sample.stamp_ns, interval, sample.velocity)
        if self._standstill is None:
            self._move(reading)
            return
        self._standstill.add(reading, *self._bias())
        self._take_sorted(self._standstill)

    def feel(self, stamp_ns: int, contacts: Contacts) -> None:
        """Look whether the whiskers rest: the robot may have stopped, or what was taken for standing was motion."""
        if self._standstill is None:
            return
        if self._standstill.see(stamp_ns, contacts, *self._bias()):
            self._stand()
        self._take_sorted(self._standstill)

    def _take_sorted(self, standstill: Standstill) -> None:
        readings = standstill.sorted()
        for reading in readings.stood:
            self._rest(reading.stamp_ns)
            self._stand()
            # An odometry that says nothing at all while the robot stands, as wheels do, has another bias when it moves.
            if reading.velocity.any():
                self._measure(reading)
        if readings.rested:
            self._rest(readings.rested[-1].stamp_ns)
            self._stand()
        for reading in readings.moved:
            self._move(reading)

    def _move(self, reading: OdometryReading) -> None:
        """Take a reading of motion: a mean over the interval, which holds for its middle."""
        self._predict(reading.stamp_ns - round(0.5e9 * reading.interval))
        self._measure(reading)

    def _measure(self, reading: OdometryReading) -> None:
        innovation = reading.velocity - self._H @ self._filter.x
        self._filter.correct(innovation, self._H, self._variance / reading.interval * np.eye(3))

    def _stand(self) -> None:
        """Begin anew with a velocity of zero; what the velocity before told of the biases stays as it is.

        As a measurement, the last creeping before a stop, or the first after it, would pull the biases along.
        """
        x, P = self._filter.x, self._filter.P
        x[VELOCITY] = 0.0
        P[VELOCITY] = 0.0
        P[:, VELOCITY] = 0.0
        P[VELOCITY, VELOCITY] = np.eye(3) * self._still_variance

    def _bias(self) -> tuple[FloatArray, FloatArray]:
        """Biases and their variances, shape (3,) each."""
        return self._filter.x[ODOMETRY_BIAS], np.diag(self._filter.P)[ODOMETRY_BIAS]
