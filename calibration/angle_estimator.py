"""Magnetic vectors of a frame to inclination and azimuth, live, for the whole array at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.polynomial import FloatArray, PolynomialEvaluator, PolynomialModel
from calibration.sample_tables import near_fold

#: A reading may lie this far beyond the largest inclination of the calibration before it is not trusted.
RANGE_MARGIN = np.deg2rad(3.0)
#: No rod stands more inclined than this, whatever a broken sensor says, rad.
MOST = np.deg2rad(85.0)
#: A change of what the neighbours add that is not worth another evaluation, mT: 0.06 deg.
NEGLIGIBLE_MT = 0.02
#: A rod's direction that has changed by less adds what it added: half a reading's noise, 0.0005 mT to a neighbour. (At
#: four times the noise the lag is seen: without a gyro the heading drifts a tenth faster.)
SAME_DIRECTION = 0.005
#: Evaluations at most: the second one's error is a hundredth of the neighbours' field.
ITERATIONS = 2
#: Step of the difference quotients at rest, mT: 0.3 deg, within which the field is as good as linear.
REST_STEP_MT = 0.1


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
    """Applies a calibration to readings; keeps the rest offsets of a re-zeroing.

    What the neighbours' magnets add is taken from the angles of the last call, which differ little from frame to
    frame; where they differ more, the readings are evaluated again.
    """

    def __init__(self, model: PolynomialModel, earth_mT: FloatArray | None = None) -> None:
        """Estimate by this model.

        Args:
            model: of the array.
            earth_mT: Earth's field in the map frame, shape (3,), mT; None leaves its turning with the robot out
                (0.02 mT, 0.05 deg).
        """
        self._model = model
        self._evaluator = PolynomialEvaluator(model)
        self._offset_mT = np.zeros_like(model.rest_mT)
        self._field_of_tilt: FloatArray | None = None
        self._largest = model.max_inclination + RANGE_MARGIN
        self._variance = None if model.variance is None else np.ascontiguousarray(model.variance.T)
        self._direction_only = model.representation == "Direction"
        # Directions alone do not tell how strong the neighbours are beside the whisker's own magnet.
        self._neighbours = None if self._direction_only else model.neighbours
        self._added_mT = np.zeros_like(model.rest_mT)
        self._moved = np.empty_like(model.rest_mT)
        #: Of each rod's change of direction, x, y, z, what it adds to all sensors, shape (n, 3, 3 n); and the changes
        #: of direction that are in `_added_mT`.
        self._adds = None if self._neighbours is None else _by_source(self._neighbours)
        self._counted = np.zeros_like(model.rest_mT)
        self._earth_mT = None if self._direction_only or model.base_to_sensor is None else earth_mT
        self.out_of_range = 0

    @property
    def count(self) -> int:
        """Number of whiskers in the array, holes included."""
        return len(self._model.rest_mT)

    @property
    def representation(self) -> str:
        """What the calibration is for: `Cartesian` fields or `Direction`s."""
        return self._model.representation

    def angles(
        self, field_mT: FloatArray, valid: NDArray[np.bool_], R_map_base: FloatArray | None = None
    ) -> WhiskerAngles:
        """Angles of one reading.

        Args:
            field_mT: shape (n, 3) or (rows, cols, 3), mT.
            valid: shape (n,) or (rows, cols), as the device says.
            R_map_base: attitude of the robot, shape (3, 3), for Earth's field; the calibration was made at identity.
        """
        model = self._model
        raw = field_mT.reshape(-1, 3)
        if self._direction_only:
            raw = raw / np.maximum(np.sqrt(np.square(raw).sum(axis=1, keepdims=True)), 1e-9)
        # A sensor that dropped off its bus reports all zeros (brief: sensor faults seen on the robot).
        usable = valid.reshape(-1) & model.fitted
        if np.count_nonzero(raw) < raw.size:
            usable &= raw.any(axis=1)
        if model.folded:
            usable &= ~near_fold(raw, model.representation)
        field = raw - self._offset_mT
        if R_map_base is not None and self._earth_mT is not None and model.base_to_sensor is not None:
            field -= model.base_to_sensor @ ((R_map_base.T - np.eye(3)) @ self._earth_mT)
        if self._adds is None:
            tilt = self._evaluator.tilt(field)
            inclination = np.sqrt(tilt[0] * tilt[0] + tilt[1] * tilt[1])
        else:
            tilt, inclination = self._without_neighbours(field, usable, self._adds)
        in_range = inclination <= self._largest
        well = usable & in_range
        self.out_of_range += int(np.count_nonzero(usable)) - int(np.count_nonzero(well))
        azimuth = np.arctan2(tilt[1], tilt[0])
        return WhiskerAngles(inclination, azimuth, self._sigma(inclination), well)

    def _without_neighbours(
        self, field: FloatArray, usable: NDArray[np.bool_], adds: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Tilts, shape (2, n), and inclinations, shape (n,), rad, with the neighbours' magnets taken out."""
        for _ in range(ITERATIONS):
            tilt = self._evaluator.tilt(field - self._added_mT)
            inclination = np.sqrt(tilt[0] * tilt[0] + tilt[1] * tilt[1])
            # A rod's direction less its rest direction; what a dead sensor's rod does, nobody knows.
            bent = np.minimum(inclination, MOST) * usable
            moved = self._moved
            moved[:, :2] = (tilt * (np.sin(bent) / np.maximum(inclination, 1e-9))).T
            moved[:, 2] = np.cos(bent) - 1.0
            # Rods change little from frame to frame, and most of them nothing: what the others add is known.
            step = moved - self._counted
            (changed,) = (np.maximum.reduce(np.abs(step), axis=1) > SAME_DIRECTION).nonzero()
            if not len(changed):
                break
            if 4 * len(changed) > len(step):
                # To pick so many rows out takes longer than to go through all.
                more = step.reshape(-1).dot(adds.reshape(step.size, -1))
                self._counted[:] = moved
            else:
                more = step[changed].reshape(-1).dot(adds[changed].reshape(3 * len(changed), -1))
                self._counted[changed] = moved[changed]
            self._added_mT = self._added_mT + more.reshape(-1, 3)
            if np.maximum.reduce(np.abs(more)) < NEGLIGIBLE_MT:
                break
        return tilt, inclination

    def _sigma(self, inclination: FloatArray) -> FloatArray:
        if self._variance is None:
            return self._model.sigma
        square = np.minimum(inclination, MOST)
        square = square * square
        constant, second, fourth = self._variance
        sigma: FloatArray = np.sqrt((fourth * square + second) * square + constant)
        return sigma

    def rezero(self, field_mT: FloatArray, valid: NDArray[np.bool_]) -> None:
        """Take a reading as the rest position: the operator says that nothing touches."""
        usable = valid.reshape(-1) & self._model.fitted
        offset = field_mT.reshape(-1, 3) - self._model.rest_mT
        self._offset_mT = np.where(usable[:, None], offset, self._offset_mT)

    def shift_rest(self, tilt: FloatArray) -> None:
        """Move the rest positions by tilts, shape (2, n), rad: readings that gave these tilts at rest give zero then.

        The smallest change of the field that does it: how the rest field's strength has changed, a tilt cannot tell.
        """
        inverse = self._field_of_tilt
        if inverse is None:
            rest = self._model.rest_mT
            ends = [self._model.tilt(rest + step) - self._model.tilt(rest - step) for step in REST_STEP_MT * np.eye(3)]
            inverse = np.asarray(np.linalg.pinv(np.stack(ends, axis=-1) / (2.0 * REST_STEP_MT)), dtype=np.float64)
            self._field_of_tilt = inverse
        self._offset_mT = self._offset_mT + (inverse @ tilt.T[:, :, None])[:, :, 0]


def _by_source(neighbours: FloatArray) -> FloatArray:
    """The neighbours' matrix, shape (3 n, 3 n), with the rods that add first: shape (n, 3, 3 n)."""
    n = len(neighbours) // 3
    return np.ascontiguousarray(neighbours.T).reshape(n, 3, 3 * n)
