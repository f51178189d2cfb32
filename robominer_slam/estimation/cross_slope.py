"""Local slope of the ground under each tip, from the tips around it in the same frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

#: Tips around a tip that its plane is fitted to.
NEIGHBOURS = 8
#: Within this distance neighbours weigh alike, m; beyond, by the inverse square of the distance.
NEAR = 0.03
#: Keeps the fit of a tip without neighbours at slope zero, m2.
FLATNESS = 1e-6


class CrossSlope:
    """Fits planes through tips and their neighbours, all at once.

    Args:
        layout: the array.
        floor: whiskers that point down, shape (n,); others are left out.
    """

    def __init__(self, layout: WhiskerLayout, floor: BoolArray) -> None:
        p = np.where((floor & layout.present)[:, None], layout.p_base, 1e6)
        distance = np.square(p[:, None] - p[None]).sum(axis=-1)
        np.fill_diagonal(distance, np.inf)
        self._neighbours = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
        self._tips = np.empty((3, layout.count))
        self._unusable = np.flatnonzero(~floor)

    def gradient(self, tips: FloatArray, index: NDArray[np.intp]) -> FloatArray:
        """Slope of the ground along x and y at each tip, shape (2, m); zero where too few neighbours touch.

        Args:
            tips: in base_link, shape (m, 3), m.
            index: whose they are, shape (m,).
        """
        everyone = self._tips
        everyone.fill(np.nan)
        everyone[:, index] = tips.T
        if len(self._unusable):
            everyone[:, self._unusable] = np.nan
        dx, dy, dz = everyone[:, self._neighbours[index]] - tips.T[:, :, None]
        weight = 1.0 / (dx * dx + dy * dy + NEAR**2)
        unknown = dz != dz
        if np.count_nonzero(unknown):
            for part in (weight, dx, dy, dz):
                part[unknown] = 0.0
        wx, wy = weight * dx, weight * dy
        xx, xy, yy = (wx * dx).sum(axis=1), (wx * dy).sum(axis=1), (wy * dy).sum(axis=1)
        xz, yz = (wx * dz).sum(axis=1), (wy * dz).sum(axis=1)
        xx += FLATNESS / NEAR**2
        yy += FLATNESS / NEAR**2
        determinant = xx * yy - xy * xy
        slopes = np.empty((2, len(index)))
        np.divide(yy * xz - xy * yz, determinant, out=slopes[0])
        np.divide(xx * yz - xy * xz, determinant, out=slopes[1])
        return slopes
