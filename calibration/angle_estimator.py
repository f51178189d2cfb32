"""Magnetic vectors of a frame to inclination and azimuth, live, for the whole array at once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

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
#: What rods add to their neighbours is brought up to date for one of so many blocks of rods per reading, in turn.
BLOCKS = 4
#: A rod whose direction has changed by more is not waited for: six times a reading's noise, 0.005 mT to a neighbour.
QUICK = 0.05
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
        direction: of the rod in its whisker's axes, unit vectors, shape (3, n).
        valid: False for a dead, uncalibrated or out-of-range whisker; its angles must not be used.
    """

    inclination: FloatArray
    azimuth: FloatArray
    direction: FloatArray
    valid: NDArray[np.bool_]


class AngleEstimator:
    """Applies a calibration to readings; keeps the rest offsets of a re-zeroing.

    What the neighbours' magnets add is taken from the angles of the last calls, which differ little from frame to
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
        #: Of each rod's change of direction, x, y, z, what it adds to all sensors, shape (n, 3, 3 n); the same by
        #: blocks of rods, (3 n, 3 of them); and the directions that are in `_added_mT`.
        self._adds = None if self._neighbours is None else _by_source(self._neighbours)
        self._blocks = [] if self._adds is None else _blocks(self._adds)
        self._turn = 0
        self._added_mT = np.zeros_like(model.rest_mT)
        self._counted = np.zeros((3, self.count))
        self._counted[2] = 1.0
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
            inclination = np.hypot(tilt[0], tilt[1])
            direction = _directions(tilt, inclination, usable)
        else:
            tilt, inclination, direction = self._without_neighbours(field, usable, self._adds)
        in_range = inclination <= self._largest
        well = usable & in_range
        self.out_of_range += int(np.count_nonzero(usable)) - int(np.count_nonzero(well))
        azimuth = np.arctan2(tilt[1], tilt[0])
        return WhiskerAngles(inclination, azimuth, direction, well)

    def _without_neighbours(
        self, field: FloatArray, usable: NDArray[np.bool_], adds: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Tilts (2, n) and inclinations (n,), rad, with the neighbours' magnets taken out, and directions (3, n)."""
        for _ in range(ITERATIONS):
            tilt = self._evaluator.tilt(field - self._added_mT)
            inclination = np.hypot(tilt[0], tilt[1])
            direction = _directions(tilt, inclination, usable)
            # Rods change little from frame to frame: most of what they add to each other may wait for its turn.
            step = direction - self._counted
            (quick,) = (np.maximum.reduce(np.abs(step)) > QUICK).nonzero()
            if 4 * len(quick) > step.shape[1]:
                # To pick so many rods out takes longer than to go through all.
                more = step.T.reshape(-1).dot(adds.reshape(step.size, -1))
                self._counted[:] = direction
            else:
                self._added_mT += self._next_block(step, direction)
                if not len(quick):
                    break
                step = direction[:, quick] - self._counted[:, quick]
                more = step.T.reshape(-1).dot(adds[quick].reshape(3 * len(quick), -1))
                self._counted[:, quick] = direction[:, quick]
            self._added_mT += more.reshape(-1, 3)
            if np.maximum.reduce(np.abs(more)) < NEGLIGIBLE_MT:
                break
        return tilt, inclination, direction

    def _next_block(self, step: FloatArray, direction: FloatArray) -> FloatArray:
        """What the rods whose turn it is add beyond what is counted of them, shape (n, 3), mT."""
        rods, adding = self._blocks[self._turn]
        self._turn = (self._turn + 1) % BLOCKS
        self._counted[:, rods] = direction[:, rods]
        more: FloatArray = adding.dot(step[:, rods].reshape(-1)).reshape(-1, 3)
        return more

    def sigma(self, inclination: FloatArray) -> FloatArray:
        """One-sigma errors of the rods' directions at inclinations, shape (n,) each, rad."""
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


def _blocks(adds: FloatArray) -> list[tuple[slice, FloatArray]]:
    """Rods in blocks that follow each other, and what a block's directions (x of all, y of all, z) add, (3 n, 3 k)."""
    ends = [len(adds) * k // BLOCKS for k in range(BLOCKS + 1)]
    rods = [slice(begin, end) for begin, end in pairwise(ends)]
    return [(one, np.ascontiguousarray(adds[one].transpose(2, 1, 0)).reshape(adds.shape[2], -1)) for one in rods]


def _directions(tilt: FloatArray, inclination: FloatArray, usable: NDArray[np.bool_]) -> FloatArray:
    """Directions of rods, shape (3, n), from tilts, shape (2, n), of these inclinations."""
    # What a dead sensor's rod does, nobody knows: it counts as at rest.
    bent = np.minimum(inclination, MOST) * usable
    direction = np.empty((3, len(bent)))
    np.multiply(tilt, np.sin(bent) / np.maximum(inclination, 1e-9), out=direction[:2])
    np.cos(bent, out=direction[2])
    return direction
