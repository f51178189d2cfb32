"""How far the robot has come along its walls: the roughness that side whiskers feel, matched with that felt before.

Walls hold the place across and the heading far better than along. But there they tell more than they know: a row of
whiskers each 0.35 mm off is an arc, and would turn a straight gallery by half a degree a metre. So place across and
heading are unknowns of the match that nobody else hears of; what counts is the one direction that walls hold least, and
of it what errors of the slopes leave.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.slope_noise import less
from robominer_slam.slam.surface_registration import KERNEL_WIDTH, LEAST_KNOWN, REWEIGHTINGS, YAW, placed
from robominer_slam.slam.wall_registration import wall_terms
from robominer_slam.slam.wall_surface import WallSurface

FloatArray = NDArray[np.float64]

#: How far x, y, heading and z may be off in a match: centimetres and degrees, but z as the floor tells it.
SIGMA_FREE = np.array([0.02, 0.02, 0.02, 0.002])


@dataclass(frozen=True, slots=True)
class WayAlong:
    """What walls say along the direction that they hold least.

    Attributes:
        direction: unit vector in x and y, shape (2,).
        offset: measured less predicted, m.
        known, apparent: information, 1/m2, without what errors of the slopes add, and with it.
    """

    direction: FloatArray
    offset: float
    known: float
    apparent: float


def way_along(walls: WallSurface, points: FloatArray, pose: FloatArray) -> WayAlong | None:
    """Match touches of walls with those made before; None where too few walls are known.

    Args:
        walls: touched before.
        points: touches in the robot's level frame, shape (m, 3), m.
        pose: predicted x, y, yaw, z, shape (4,).
    """
    terms = wall_terms(walls, placed(points, pose)[None], pose[None])
    if np.count_nonzero(terms.known) <= LEAST_KNOWN:
        return None
    J, r, inverse_variance = terms.jacobian[0], terms.residual[0], (terms.known / terms.variance)[0]
    prior = np.diag(SIGMA_FREE**-2.0)
    e = r
    for _ in range(REWEIGHTINGS):
        weight = inverse_variance / (1.0 + e * e * inverse_variance / KERNEL_WIDTH**2)
        JtW = J * weight
        H = JtW @ J.T
        step = -np.linalg.solve(H + prior, JtW @ r)
        e = r + step @ J
    H_less = less(H[None], terms.noise_information(weight[None]))[0]
    known, apparent = _place_alone(H_less + prior), _place_alone(H + prior)
    values, vectors = np.linalg.eigh(apparent)
    direction = vectors[:, 0]
    free = SIGMA_FREE[0] ** -2.0
    apparent_along = float(values[0]) - free
    known_along = float(1.0 / (direction @ np.linalg.solve(known, direction))) - free
    if known_along <= 0.0 or apparent_along <= 0.0:
        return None
    # Noise of the slopes is in H and not in what the touches pull by: the offset is as much larger as H is.
    offset = float(direction @ step[:2]) * (apparent_along + free) / known_along
    return WayAlong(direction, offset, known_along, apparent_along)


def _place_alone(H: FloatArray) -> FloatArray:
    """Information about x and y, heading and z being unknown, shape (2, 2)."""
    rest = slice(YAW, None)
    place: FloatArray = H[:2, :2] - H[:2, rest] @ np.linalg.solve(H[rest, rest], H[rest, :2])
    return place
