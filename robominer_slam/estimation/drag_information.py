"""Tips that trail, and what a frame of them says: the quantities of `drag_direction`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrailingTips:
    """Tips that trail: place p, motion in base_link, direction to the base, ground's gradient, predicted motion.

    All of shape (2, m).
    """

    p: FloatArray
    turning: FloatArray
    d: FloatArray
    gradient: FloatArray
    swept: FloatArray


@dataclass(frozen=True, slots=True)
class FrameInformation:
    """A frame's information before what its tips have in common is allowed for.

    information (3, 3), vector (3,) and tips as of `DragInformation`; sliding_*: weighted products of each tip's
    derivative by `slide` with the rows (3,), with itself and with the innovations.
    """

    information: FloatArray
    vector: FloatArray
    tips: int
    sliding_rows: FloatArray
    sliding_sliding: float
    sliding_innovation: float


def swept_by(p: FloatArray, turning: FloatArray, velocity: FloatArray) -> FloatArray:
    """Motion of the tips over the ground in base_link's axes, shape (2, m), m/s; arguments as in the module's text."""
    vx, vy, wz = velocity.tolist()
    swept = np.empty_like(p)
    np.add(vx - wz * p[1], turning[0], out=swept[0])
    np.add(vy + wz * p[0], turning[1], out=swept[1])
    return swept


@dataclass(frozen=True, slots=True)
class DragInformation:
    """What a frame's tips say about (vx, vy, wz), in information form around the estimate they were judged with.

    Attributes:
        information: shape (3, 3); singular along the motion itself, of which the tips say nothing.
        vector: information times the correction of the velocity, shape (3,).
        tips: how many counted.
        ahead: direction of motion that it was linearised at, unit vector, shape (2,).
    """

    information: FloatArray
    vector: FloatArray
    tips: int
    ahead: FloatArray

    def compressed(self) -> tuple[FloatArray, FloatArray]:
        """Rows H (k, 3) and innovations (k,) with unit covariance that say the same; k of 0 to 3."""
        values, vectors = np.linalg.eigh(self.information)
        kept = values > 1e-6 * float(values[-1])
        root = np.sqrt(values[kept])
        H = root[:, None] * vectors[:, kept].T
        return H, (vectors[:, kept].T @ self.vector) / root
