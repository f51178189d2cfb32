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
        #: Neighbours first, shape (k, n): sums over them then run along whole rows of tips.
        self._neighbours = np.ascontiguousarray(np.argsort(distance, axis=1)[:, :NEIGHBOURS].T)
        #: x, y, z of each whisker's tip, and 1 where it touches.
        self._tips = np.empty((4, layout.count))
        self._unusable = np.flatnonzero(~floor)

    def gradient(self, tips: FloatArray, index: NDArray[np.intp], of: NDArray[np.intp]) -> FloatArray:
        """Slope of the ground along x and y at some tips, shape (2, k); zero where too few neighbours touch.

        Args:
            tips: in base_link, shape (m, 3), m.
            index: whose they are, shape (m,).
            of: which of them are asked for, shape (k,).
        """
        everyone, at = self._tips, tips.T
        everyone.fill(0.0)
        everyone[:3, index] = at
        everyone[3, index] = 1.0
        if len(self._unusable):
            everyone[3, self._unusable] = 0.0
        around = everyone.take(self._neighbours.take(index.take(of), axis=1), axis=1)
        offset, touches = around[:3], around[3]
        offset -= at.take(of, axis=1)[:, None]
        # A neighbour that does not touch lies at the tip itself, so to speak: there it weighs nothing in any sum.
        offset *= touches
        dx, dy, _ = offset
        weight = 1.0 / (dx * dx + dy * dy + NEAR**2)
        xx, xy, xz = np.einsum("km,akm->am", weight * dx, offset)
        yy, yz = np.einsum("km,akm->am", weight * dy, offset[1:])
        xx += FLATNESS / NEAR**2
        yy += FLATNESS / NEAR**2
        determinant = xx * yy - xy * xy
        slopes = np.empty((2, len(of)))
        np.divide(yy * xz - xy * yz, determinant, out=slopes[0])
        np.divide(xx * yz - xy * xz, determinant, out=slopes[1])
        return slopes
