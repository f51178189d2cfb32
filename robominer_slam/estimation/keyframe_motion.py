"""Motion from one keyframe to the next, with what it owes to the slow biases kept apart from its noise.

A bias that lasts the whole drive makes the errors of all edges of a pose graph alike; taken as independent noise they
would average out, and they do not. So an edge comes with its covariance for a known bias and with its derivative by
the bias: the graph may then solve for one global bias b with edges  T_last_new Exp(bias_jacobian (b - bias)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class KeyframeMotion:
    """Motion of base_link since the last keyframe.

    Attributes:
        stamp_ns: time of the new keyframe.
        T_last_new: pose of base_link at the new keyframe in base_link at the last, shape (4, 4).
        covariance: of the twist error eta (translation first; T_true = T_last_new Exp(eta), in the new keyframe's
            frame) if the biases were known to be `bias`, shape (6, 6).
        bias_jacobian: derivative of eta by the bias, shape (6, nb).
        bias: the biases that T_last_new was made with, shape (nb,): vx, vy (m/s), wz (rad/s) of a ready-made
            odometry, or the vertical gyro's (rad/s).
        bias_posterior: their present estimate, shape (nb,).
        bias_covariance: of the present estimate, shape (nb, nb).
        bias_walk: covariance of what the biases have changed by since the last keyframe, shape (nb, nb); None: nothing.
    """

    stamp_ns: int
    T_last_new: FloatArray
    covariance: FloatArray
    bias_jacobian: FloatArray
    bias: FloatArray
    bias_posterior: FloatArray
    bias_covariance: FloatArray
    bias_walk: FloatArray | None = None
