"""Edges of the level graph as arrays, one per attribute: a keyframe must not cost a loop over all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robominer_slam.slam.growing_array import GrowingArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LevelEdge:
    """A constraint between two keyframes, level.

    Attributes:
        kind: of odometry or of a loop closure.
        i, j: ids of the keyframes.
        Z: pose of j in i: x, y (m), heading (rad), shape (3,).
        information: of it, as a twist in j's frame, shape (3, 3).
        dz: height of j over i, m.
        dz_information: 1/m2.
        jacobian: what the slow biases do to Z, shape (3, nb).
        reference: the biases that Z was made with, shape (nb,).
        enabled: False where a closure was taken back.
        fade: how much of a change of the biases of now still concerns this edge, 1 for all of it (`bias_walk`).
        slack: covariance that the edge gets when it has faded, shape (3, 3); None: none.
    """

    kind: Literal["odometry", "loop"]
    i: int
    j: int
    Z: FloatArray
    information: FloatArray
    dz: float
    dz_information: float
    jacobian: FloatArray
    reference: FloatArray
    enabled: bool = True
    fade: float = 1.0
    slack: FloatArray | None = None


class LevelEdges:
    """All edges of a graph in the order of their making; views are writable and valid until edges are added.

    Attributes:
        version: grows when edges come or go or are switched.
    """

    def __init__(self) -> None:
        self.version = 0
        self._columns: dict[str, GrowingArray] = {}
        self._made = 0

    def __len__(self) -> int:
        return len(self._columns["i"]) if self._columns else 0

    def append(self, edge: LevelEdge) -> None:
        """Add an edge; all have as many biases as the first."""
        nb = edge.reference.size
        covariance = np.linalg.inv(edge.information)
        if not self._columns:
            self._columns = {
                "serial": GrowingArray((), np.int64),
                "i": GrowingArray((), np.int64),
                "j": GrowingArray((), np.int64),
                "loop": GrowingArray((), np.bool_),
                "Z": GrowingArray((3,), np.float64),
                "information": GrowingArray((3, 3), np.float64),
                "covariance": GrowingArray((3, 3), np.float64),
                "dz": GrowingArray((), np.float64),
                "dz_information": GrowingArray((), np.float64),
                "jacobian": GrowingArray((3, nb), np.float64),
                "reference": GrowingArray((nb,), np.float64),
                "enabled": GrowingArray((), np.bool_),
                "fade": GrowingArray((), np.float64),
                "slack": GrowingArray((3, 3), np.float64),
                "chi2": GrowingArray((), np.float64),
            }
        values: dict[str, object] = {
            "serial": self._made,
            "i": edge.i,
            "j": edge.j,
            "loop": edge.kind == "loop",
            "Z": edge.Z,
            "information": edge.information,
            "covariance": 0.5 * (covariance + covariance.T),
            "dz": edge.dz,
            "dz_information": edge.dz_information,
            "jacobian": edge.jacobian,
            "reference": edge.reference,
            "enabled": edge.enabled,
            "fade": edge.fade,
            "slack": np.zeros((3, 3)) if edge.slack is None else edge.slack,
            "chi2": 0.0,
        }
        for name, column in self._columns.items():
            column.extend(np.asarray(values[name])[None])
        self._made += 1
        self.version += 1

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Drop the edges where `kept`, shape (m,), is False."""
        for column in self._columns.values():
            column.keep(kept)
        self.version += 1

    def switch(self, which: NDArray[np.bool_] | IndexArray, on: bool) -> None:
        """Let edges count, or take them back."""
        self.enabled[which] = on
        self.version += 1

    def set_covariance(self, row: int, covariance: FloatArray) -> None:
        """Give an edge another covariance, shape (3, 3)."""
        information = np.linalg.inv(covariance)
        self.covariance[row] = 0.5 * (covariance + covariance.T)
        self.information[row] = 0.5 * (information + information.T)
        self.version += 1

    def renew(self, rows: IndexArray) -> None:
        """Say that edges were changed into others: they go to the end with new numbers."""
        changed = [self.edge(int(row)) for row in rows]
        kept = np.ones(len(self), dtype=np.bool_)
        kept[rows] = False
        self.keep(kept)
        for edge in changed:
            self.append(edge)

    def edge(self, row: int) -> LevelEdge:
        """One edge."""
        return LevelEdge(
            "loop" if self.loop[row] else "odometry",
            int(self.i[row]),
            int(self.j[row]),
            self.Z[row].copy(),
            self.information[row].copy(),
            float(self.dz[row]),
            float(self.dz_information[row]),
            self.jacobian[row].copy(),
            self.reference[row].copy(),
            bool(self.enabled[row]),
            float(self.fade[row]),
            self.slack[row].copy(),
        )

    def _view(self, name: str) -> NDArray[Any]:
        if not self._columns:
            raise LookupError("there are no edges")
        return self._columns[name].view

    @property
    def serial(self) -> IndexArray:
        """Numbers of the edges in the order of their making, never used again, shape (m,)."""
        return self._view("serial")

    @property
    def i(self) -> IndexArray:
        """Ids of the first keyframes, shape (m,)."""
        return self._view("i")

    @property
    def j(self) -> IndexArray:
        """Ids of the second keyframes, shape (m,)."""
        return self._view("j")

    @property
    def loop(self) -> NDArray[np.bool_]:
        """Which are loop closures, shape (m,)."""
        return self._view("loop")

    @property
    def fade(self) -> FloatArray:
        """What is left of a change of the biases, shape (m,)."""
        return self._view("fade")

    @property
    def slack(self) -> FloatArray:
        """Covariances that edges get when they have faded, shape (m, 3, 3)."""
        return self._view("slack")

    @property
    def Z(self) -> FloatArray:
        """Measured poses of j in i, shape (m, 3)."""
        return self._view("Z")

    @property
    def information(self) -> FloatArray:
        """Of Z, as twists in j's frame, shape (m, 3, 3)."""
        return self._view("information")

    @property
    def covariance(self) -> FloatArray:
        """The inverse of `information`, shape (m, 3, 3)."""
        return self._view("covariance")

    @property
    def dz(self) -> FloatArray:
        """Heights of j over i, shape (m,), m."""
        return self._view("dz")

    @property
    def dz_information(self) -> FloatArray:
        """Shape (m,), 1/m2."""
        return self._view("dz_information")

    @property
    def jacobian(self) -> FloatArray:
        """What the slow biases do to Z, shape (m, 3, nb)."""
        return self._view("jacobian")

    @property
    def reference(self) -> FloatArray:
        """The biases that Z was made with, shape (m, nb)."""
        return self._view("reference")

    @property
    def enabled(self) -> NDArray[np.bool_]:
        """False where a closure was taken back, shape (m,)."""
        return self._view("enabled")

    @property
    def chi2(self) -> FloatArray:
        """Squared errors when last computed, shape (m,)."""
        return self._view("chi2")
