"""Whether the published covariance tells the size of the errors."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.evaluation.metrics import TrajectoryErrors

FloatArray = NDArray[np.float64]

#: 99 % quantile of chi-square with three degrees of freedom: (x, y, yaw).
CHI2_3_99 = 11.344866730144373
#: Below this nobody tells an error from the truth's own resolution, m and rad; keeps a covariance of zero invertible.
FLOOR = 1e-4


@dataclass(frozen=True, slots=True)
class Consistency:
    """Covariance against error.

    Attributes:
        share_within_99: share of the frames whose squared Mahalanobis distance of (x, y, yaw) is below the 99 %
            quantile of chi-square; 0.99 where the covariance is right, less where it promises too much.
        sigma_ratio: median of sqrt(var x + var y) over the median position error; above 1 where it promises too
            little; None where the error is zero.
        median_sigma_m: that median sigma, m.
    """

    share_within_99: float
    sigma_ratio: float | None
    median_sigma_m: float

    def as_dict(self) -> dict[str, float | None]:
        """For JSON."""
        return asdict(self)


def mahalanobis2(errors: TrajectoryErrors, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis distance of (x, y, yaw) per frame, shape (n,), by covariances of shape (n, 3, 3), m, rad."""
    e = errors.components[:, [0, 1, 5]]
    solved = np.linalg.solve(covariance + FLOOR**2 * np.eye(3), e[:, :, None])[:, :, 0]
    distance: FloatArray = np.einsum("ni,ni->n", e, solved)
    return distance


def consistency(errors: TrajectoryErrors, covariance: FloatArray) -> Consistency:
    """Compare errors with the covariances of (x, y, yaw) at the same frames, shape (n, 3, 3), m, rad."""
    within = mahalanobis2(errors, covariance) < CHI2_3_99
    sigma = float(np.median(np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])))
    error = float(np.median(errors.position))
    return Consistency(float(np.mean(within)), sigma / error if error > 0.0 else None, sigma)
