"""What a scan match says of the robust filter's state: of the pose since the last keyframe, where it says anything.

Matches share the errors of the whiskers. So the last states are an offset that all matches of some metres have in
common, in the body's axes: it keeps many matches from being surer than the whiskers are.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from robominer_slam.estimation.planar_motion import KEY_YAW, REL

FloatArray = NDArray[np.float64]

#: Less information about a direction, 1/m2 or 1/rad2, is none.
LEAST_INFORMATION = 1.0


def match_measurement(
    x: FloatArray, common: slice, offset: FloatArray, information: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Innovation, its derivative H by the state and its covariance, along what is told; None if nothing is.

    Args:
        x: state of the filter.
        common: where in it the offset is that matches have in common.
        offset: of (x, y, yaw) in odom, measured less predicted, shape (3,).
        information: of it, shape (3, 3).
    """
    to_key = _odom_from_key(x).T
    values, vectors = np.linalg.eigh(to_key.dot(information).dot(to_key.T))
    told = values > LEAST_INFORMATION
    if not told.any():
        return None
    rows = vectors[:, told].T
    H = np.zeros((len(rows), len(x)))
    H[:, REL] = rows
    H[:, common] = rows
    return rows @ (to_key @ offset - x[common]), H, np.diag(1.0 / values[told])


def relative_covariance(x: FloatArray, P: FloatArray) -> FloatArray:
    """Covariance of (x, y, yaw) since the last keyframe, in odom's axes, shape (3, 3)."""
    R = _odom_from_key(x)
    return np.asarray(R.dot(P[REL, REL]).dot(R.T))


def _odom_from_key(x: FloatArray) -> FloatArray:
    c, s = math.cos(x[KEY_YAW]), math.sin(x[KEY_YAW])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
