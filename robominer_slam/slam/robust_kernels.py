"""Robust kernels: what an edge's squared error s = e' Omega e costs, and the weight it has in the next iteration.

Every kernel has a width k in sigmas (the square root of s). With c = k^2 the cost rho and its slope w = drho/ds,
the weight of iteratively reweighted least squares, are:

| kernel        | rho(s)                                       | w(s)                                  |
|---------------|----------------------------------------------|---------------------------------------|
| none          | s                                            | 1                                     |
| huber         | s up to c, then 2 k sqrt(s) - c              | 1 up to c, then k / sqrt(s)           |
| cauchy        | c log(1 + s / c)                             | 1 / (1 + s / c)                       |
| dcs           | s up to c, then c (3 s - c) / (s + c)        | 1 up to c, then (2 c / (s + c))^2     |
| geman-mcclure | c s / (c + s)                                | (c / (c + s))^2                       |

Sources: Zhang, "Parameter estimation techniques" (1997); DCS: Agarwal et al., "Robust map optimization using
dynamic covariance scaling" (ICRA 2013), whose Phi is c here (Phi = 1 in the paper).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robominer_slam.geometry import FloatArray

KernelName = Literal["none", "huber", "cauchy", "dcs", "geman-mcclure"]

#: Names in the order of the codes that `PoseGraph` stores per edge.
KERNEL_NAMES: tuple[KernelName, ...] = ("none", "huber", "cauchy", "dcs", "geman-mcclure")
_HUBER, _CAUCHY, _DCS, _GEMAN_MCCLURE = 1, 2, 3, 4


def kernel_code(name: str | None) -> int:
    """Code of a kernel; None means no kernel.

    Raises:
        ValueError: there is no such kernel.
    """
    if name is None:
        return 0
    for code, known in enumerate(KERNEL_NAMES):
        if known == name:
            return code
    raise ValueError(f"robust kernel {name!r} is not known; expected one of {', '.join(KERNEL_NAMES)}")


def robust_cost_and_weight(s: FloatArray, codes: NDArray[np.int8], widths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cost rho(s) and weight drho/ds per edge.

    Args:
        s: squared Mahalanobis errors e' Omega e, shape (m,).
        codes: kernel per edge (`kernel_code`), shape (m,).
        widths: kernel width per edge in sigmas, shape (m,).

    Returns:
        rho and w, both of shape (m,); w in (0, 1].
    """
    cost, weight = s.copy(), np.ones(s.size)
    if not np.count_nonzero(codes):
        return cost, weight
    for code in np.unique(codes[codes > 0]):
        k = np.flatnonzero(codes == code)
        cost[k], weight[k] = _one_kernel(int(code), s[k], widths[k] ** 2)
    return cost, weight


def _one_kernel(code: int, s: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    if code == _HUBER:
        root = np.sqrt(np.maximum(s, c))
        width = np.sqrt(c)
        return np.where(s <= c, s, 2.0 * width * root - c), width / root
    if code == _CAUCHY:
        return c * np.log1p(s / c), c / (c + s)
    if code == _DCS:
        outside = np.maximum(s, c)
        return np.where(s <= c, s, c * (3.0 * s - c) / (s + c)), (2.0 * c / (outside + c)) ** 2
    if code == _GEMAN_MCCLURE:
        return c * s / (c + s), (c / (c + s)) ** 2
    raise ValueError(f"kernel code {code} is not known; expected 0 to {len(KERNEL_NAMES) - 1}")
