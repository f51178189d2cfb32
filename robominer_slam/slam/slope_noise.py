"""What errors of a surface's slopes make of the information that they seem to carry, to be taken off again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

X, Y = 0, 1
#: What noise adds to the information varies about its mean, the more the fewer touches carry it: half as much again.
NOISE_MARGIN = 1.5
#: Deviation of headings within a surface, rad.
TURN_SIGMA = 0.03


def turned_slope_noise(slope: FloatArray) -> FloatArray:
    """Covariance of slopes (m, 2) by headings that were a little off when the surface was touched.

    A ridge that was mapped slightly turned has a slope along itself, and would tell a place along it.

    Returns:
        Its xx, xy and yy, shape (3, m).
    """
    off = slope.T * TURN_SIGMA
    noise = np.empty((3, len(slope)))
    np.multiply(off[1], off[1], out=noise[0])
    np.multiply(off[0], -off[1], out=noise[1])
    np.multiply(off[0], off[0], out=noise[2])
    return noise


def slope_noise_information(q: FloatArray, pose: FloatArray, slope_noise: FloatArray, weight: FloatArray) -> FloatArray:
    """What errors of the slopes add to J' W J in the mean, shape (..., 4, 4).

    Args:
        q: touches on the surface, shape (..., m, 3), m.
        pose: of their frame, shape (..., 4).
        slope_noise: covariance of the slopes there, its xx, xy and yy, shape (3, ..., m).
        weight: of the touches, shape (..., m).
    """
    # J' = M' slope, with M' the rows (-1, 0), (0, -1), (a, b): the sum of w M' C M, entry by entry.
    a, b = q[..., 1] - pose[..., Y, None], pose[..., X, None] - q[..., 0]
    xx, xy, yy = slope_noise
    entries = np.empty((*weight.shape[:-1], 6, weight.shape[-1]))
    entries[..., 0, :], entries[..., 1, :], entries[..., 2, :] = xx, xy, yy
    on_a, on_b = xx * a + xy * b, xy * a + yy * b
    np.negative(on_a, out=entries[..., 3, :])
    np.negative(on_b, out=entries[..., 4, :])
    entries[..., 5, :] = a * on_a + b * on_b
    sums = (entries @ weight[..., None])[..., 0]
    added = np.zeros((*pose.shape, 4))
    added[..., :3, :3] = sums[..., [[0, 1, 3], [1, 2, 4], [3, 4, 5]]]
    return added


def less(H: FloatArray, noise: FloatArray) -> FloatArray:
    """H (k, 4, 4) without what noise adds, and somewhat more, as that is a mean; kept positive semidefinite."""
    values, vectors = np.linalg.eigh(H)
    kept = (vectors * (noise @ vectors)).sum(axis=-2)
    share = np.minimum(np.maximum(1.0 - NOISE_MARGIN * kept / np.maximum(values, 1e-12), 0.0), 1.0)
    return np.asarray((vectors * (values * share)[:, None]) @ vectors.transpose(0, 2, 1))
