"""Body velocity from the speeds of four Archimedes screws (order FR, RR, RL, FL).

    vx = r tan(alpha) / 4 (-w1 - w2 + w3 + w4)
    vy = r / 4 (-w1 + w2 + w3 - w4)
    wz = -r / (4 c) (w1 + w2 + w3 + w4),  c = lx + ly / tan(alpha)

Source: the kinematics of RM3 as published with its ROS 2 packages (Centre for Biorobotics). The combination
w1 - w2 + w3 - w4 moves nothing on ideal ground: on real ground it measures slip.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def forward_matrix(radius: float, helix_angle: float, half_track: float, half_base: float) -> FloatArray:
    """Matrix from screw speeds (rad/s) to (vx m/s, vy m/s, wz rad/s, slip m/s), shape (4, 4).

    Args:
        radius: of a screw, m.
        helix_angle: rad.
        half_track: lx, m.
        half_base: ly, m.
    """
    c = half_track + half_base / np.tan(helix_angle)
    return np.array(
        [
            radius * np.tan(helix_angle) / 4.0 * np.array([-1.0, -1.0, 1.0, 1.0]),
            radius / 4.0 * np.array([-1.0, 1.0, 1.0, -1.0]),
            -radius / (4.0 * c) * np.ones(4),
            radius / 4.0 * np.array([1.0, -1.0, 1.0, -1.0]),
        ]
    )
