"""Magnetic vectors of a frame to inclination and azimuth, live, for the whole array at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.polynomial import FloatArray, PolynomialModel, angles_from_tilt

#: A reading may lie this far beyond the largest inclination of the calibration before it is not trusted.
RANGE_MARGIN = np.deg2rad(3.0)


@dataclass(frozen=True, slots=True)
class WhiskerAngles:
    """Angles of a frame, row-major, shape (n,) each.

    Attributes:
        inclination: from the whisker's z axis, rad.
        azimuth: from the whisker's x axis, rad; means little near zero inclination.
        sigma: one-sigma error of the rod's direction, rad.
        valid: False for a dead, uncalibrated or out-of-range whisker; its angles must not be used.
    """

    inclination: FloatArray
    azimuth: FloatArray
    sigma: FloatArray
    valid: NDArray[np.bool_]


class AngleEstimator:
    """Applies a calibration to readings; keeps the rest offsets of a re-zeroing."""

    def __init__(self, model: PolynomialModel) -> None:
        self._model = model
        self._offset_mT = np.zeros_like(model.rest_mT)
        self.out_of_range = 0

    @property
    def count(self) -> int:
        """Number of whiskers in the array, holes included."""
        return len(self._model.rest_mT)

    def angles(self, field_mT: FloatArray, valid: NDArray[np.bool_]) -> WhiskerAngles:
        """Angles of one reading.

        Args:
            field_mT: shape (n, 3) or (rows, cols, 3), mT.
            valid: shape (n,) or (rows, cols), as the device says.
        """
        model = self._model
        field = field_mT.reshape(-1, 3)
        # A sensor that dropped off its bus reports all zeros (brief: sensor faults seen on the robot).
        usable = valid.reshape(-1) & model.fitted & field.any(axis=1)
        inclination, azimuth = angles_from_tilt(model.tilt(field - self._offset_mT))
        in_range = inclination <= model.max_inclination + RANGE_MARGIN
        self.out_of_range += int(np.count_nonzero(usable & ~in_range))
        return WhiskerAngles(inclination, azimuth, model.sigma, usable & in_range)

    def rezero(self, field_mT: FloatArray, valid: NDArray[np.bool_]) -> None:
        """Take a reading as the rest position: the operator says that nothing touches."""
        usable = valid.reshape(-1) & self._model.fitted
        offset = field_mT.reshape(-1, 3) - self._model.rest_mT
        self._offset_mT = np.where(usable[:, None], offset, self._offset_mT)
