"""Information matrices from the fitness of a match, by hdl_graph_slam's rule (its defaults; the thesis names none).

The variance of a component grows from its least to its greatest value as a saturating exponential of the fitness.
Source: Koide et al. 2019 (doi 10.1177/1729881419841532) and the published parameters of hdl_graph_slam.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

GAIN = 20.0
SATURATION_M2 = 0.5
POSITION_SIGMA_M = (0.1, 5.0)
ROTATION_SIGMA_RAD = (0.05, 0.2)


def information_from_fitness(fitness: float) -> FloatArray:
    """Information matrix, shape (6, 6), translation first, of a relative pose with this fitness, m2."""
    share = (1.0 - np.exp(-GAIN * min(fitness, SATURATION_M2))) / (1.0 - np.exp(-GAIN * SATURATION_M2))

    def variance(sigma: tuple[float, float]) -> float:
        return sigma[0] ** 2 + (sigma[1] ** 2 - sigma[0] ** 2) * float(share)

    position, rotation = variance(POSITION_SIGMA_M), variance(ROTATION_SIGMA_RAD)
    return np.diag([1.0 / position] * 3 + [1.0 / rotation] * 3)
