"""The edges of a pose graph: measured relative poses with their information and robust kernels, in growing arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robominer_slam.geometry import FloatArray
from robominer_slam.slam.growing_array import GrowingArray
from robominer_slam.slam.pose_algebra import inverse
from robominer_slam.slam.pose_graph_input import PoseGraphError, check_ends, checked_information, checked_poses
from robominer_slam.slam.pose_graph_optimizer import Kernels
from robominer_slam.slam.pose_graph_residuals import EdgeArrays
from robominer_slam.slam.robust_kernels import kernel_code

EdgeKind = Literal["odometry", "loop"]


class PoseGraphEdges:
    """Edges in the order of their making; those taken back stay listed.

    Attributes:
        i, j: nodes, rows of shape ().
        Z_inverse: inverse measurements, rows of shape (3,) or (4, 4); m and rad.
        information: Omega, rows of shape (d, d).
        kernel, kernel_width: code of the robust kernel (`robust_kernels.kernel_code`), and its width in sigmas.
        enabled: whether an edge counts.
        kinds: what the edges are from.
    """

    def __init__(self, dim: Literal[2, 3]) -> None:
        """Start empty, in the plane (`dim` 2) or in space (3)."""
        self.dim = dim
        d, pose_shape = (3, (3,)) if dim == 2 else (6, (4, 4))
        self.i = GrowingArray((), np.int64)
        self.j = GrowingArray((), np.int64)
        self.Z_inverse = GrowingArray(pose_shape, np.float64)
        self.information = GrowingArray((d, d), np.float64)
        self.kernel = GrowingArray((), np.int8)
        self.kernel_width = GrowingArray((), np.float64)
        self.enabled = GrowingArray((), np.bool_)
        self.kinds: list[EdgeKind] = []

    def __len__(self) -> int:
        return len(self.i)

    def add(
        self,
        node_count: int,
        i: ArrayLike,
        j: ArrayLike,
        T_i_j: ArrayLike,
        information: ArrayLike,
        kind: EdgeKind,
        kernel: str | None,
        kernel_width: float,
    ) -> NDArray[np.int64]:
        """Add k edges between nodes below `node_count`; returns their numbers. See `PoseGraph.add_edges`.

        Raises:
            PoseGraphError: as there; nothing is added then.
        """
        a, b = np.asarray(i, dtype=np.int64), np.asarray(j, dtype=np.int64)
        first = len(self)
        check_ends(a, b, node_count, first)
        measurement = checked_poses(self.dim, T_i_j, a.size, "measurement")
        Omega = checked_information(3 if self.dim == 2 else 6, information, a.size)
        code = _checked_kernel(kernel, kernel_width)
        self.i.extend(a)
        self.j.extend(b)
        self.Z_inverse.extend(inverse(self.dim, measurement))
        self.information.extend(Omega)
        self.kernel.extend(np.full(a.size, code))
        self.kernel_width.extend(np.full(a.size, kernel_width))
        self.enabled.extend(np.ones(a.size, dtype=np.bool_))
        self.kinds.extend([kind] * a.size)
        return np.arange(first, len(self))

    def set_kernel(
        self, edges: int | Sequence[int] | NDArray[np.int64], kernel: str | None, kernel_width: float
    ) -> None:
        """Give edges another robust kernel.

        Raises:
            PoseGraphError: the kernel is not known, or its width is no number above 0.
        """
        self.kernel.view[edges] = _checked_kernel(kernel, kernel_width)
        self.kernel_width.view[edges] = kernel_width

    @property
    def measurements(self) -> FloatArray:
        """T_i_j of all edges, (m, 3) or (m, 4, 4)."""
        return inverse(self.dim, self.Z_inverse.view)

    def arrays(self, disabled_too: bool = False) -> tuple[EdgeArrays, Kernels]:
        """The enabled edges and their kernels, or all of them, as arrays: views where all are meant."""
        enabled = self.enabled.view
        k: slice | NDArray[np.intp] = slice(None) if disabled_too or enabled.all() else np.flatnonzero(enabled)
        edges = EdgeArrays(self.dim, self.i.view[k], self.j.view[k], self.Z_inverse.view[k], self.information.view[k])
        return edges, Kernels(self.kernel.view[k], self.kernel_width.view[k])


def _checked_kernel(kernel: str | None, width: float) -> int:
    try:
        code = kernel_code(kernel)
    except ValueError as error:
        raise PoseGraphError(str(error)) from error
    if not (np.isfinite(width) and width > 0.0):
        raise PoseGraphError(f"kernel width is {width}; expected a number above 0, in sigmas")
    return code
