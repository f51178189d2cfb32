"""A Kalman filter's state, and the update with a measurement: gated, and able to leave combinations of states alone.

Written out because a board pays for it a hundred times a second: general libraries form the products of Joseph's form
with the whole state, and copy what nobody asks for, three to four times as much work for a measurement of one number.
The tests hold it against filterpy's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class KalmanFilter:
    """State x, shape (n,), and covariance P, shape (n, n).

    A measurement whose squared Mahalanobis distance d2 exceeds the gate counts with its covariance grown by
    d2 / gate: an outlier's pull is bounded, and a filter that has gone wrong is still pulled back.

    Attributes:
        x: the state.
        P: its covariance.
        outliers: measurements beyond the gate.
    """

    def __init__(self, x: FloatArray, P: FloatArray, gate: float = np.inf) -> None:
        """Start at state x with covariance P."""
        self.x = x
        self.P = P
        self.gate = gate
        self.outliers = 0

    def correct(self, innovation: FloatArray, H: FloatArray, R: FloatArray, held: FloatArray | None = None) -> float:
        """Update with a measurement that differs from its prediction by `innovation`, shape (m,).

        Args:
            innovation: measured less predicted.
            H: derivative of the prediction by the state, shape (m, n).
            R: covariance of the measurement, shape (m, m).
            held: orthonormal rows, shape (k, n): combinations of states that this measurement must not move.

        Returns:
            The squared Mahalanobis distance.
        """
        if len(innovation) == 1 and held is None:
            return self._correct_one(float(innovation[0]), H[0], float(R[0, 0]))
        # Of few numbers, `dot` takes half of what `@` does, and a division a quarter of what `solve` does.
        PHT = self.P.dot(H.T)
        S = H.dot(PHT) + R
        single = len(innovation) == 1
        solved: FloatArray | None = None
        if single:
            distance = float(innovation[0]) ** 2 / float(S[0, 0])
        else:
            # At once for the distance and the gain.
            solved = np.linalg.solve(S, np.concatenate([innovation[:, None], PHT.T], axis=1))
            distance = float(innovation.dot(solved[:, 0]))
        if distance > self.gate:
            self.outliers += 1
            S = S + R * (distance / self.gate - 1.0)
            solved = None if single else np.linalg.solve(S, np.concatenate([innovation[:, None], PHT.T], axis=1))
        gain = PHT / S[0, 0] if solved is None else solved[:, 1:].T
        if held is not None:
            # Any gain is allowed as long as the covariance follows it.
            gain = gain - held.T.dot(held.dot(gain))
        self.x = self.x + gain.dot(innovation)
        # Joseph's form, (I - K H) P (I - K H)' + K R K', multiplied out: it holds for every gain.
        later = self.P - 2.0 * gain.dot(PHT.T) + gain.dot(S).dot(gain.T)
        # Multiplied out, it makes what is lopsided by rounding more so with every update.
        self.P = 0.5 * (later + later.T)
        return distance

    def _correct_one(self, innovation: float, h: FloatArray, variance: float) -> float:
        """The same with one number, at the best gain: P - P h h' P / s."""
        Ph = self.P.dot(h)
        predicted = float(h.dot(Ph))
        s = predicted + variance
        distance = innovation**2 / s
        if distance > self.gate:
            self.outliers += 1
            s = predicted + variance * (distance / self.gate)
        self.x = self.x + Ph * (innovation / s)
        column = Ph[:, None]
        self.P = self.P - column.dot(column.T / s)
        return distance
