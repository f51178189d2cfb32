"""Loop closures of a published graph (`map/graph`) against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.evaluation.trajectory import Trajectory, interpolate

FloatArray = NDArray[np.float64]

#: A closure is wrong if its T_i_j differs from the truth by more than either.
WRONG_DISTANCE_M = 0.10
WRONG_ANGLE_RAD = np.deg2rad(5.0)
#: A closure that the robust kernel leaves no more than this has no say.
LEAST_WEIGHT = 0.1


@dataclass(frozen=True, slots=True)
class ClosureErrors:
    """Errors of the loop closures of a graph.

    Attributes:
        pairs: keyframe ids (i, j), shape (n, 2).
        distance: translation error of T_i_j, shape (n,), m.
        angle: rotation error, shape (n,), rad.
        weight: as published, shape (n,).
    """

    pairs: NDArray[np.int64]
    distance: FloatArray
    angle: FloatArray
    weight: FloatArray

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """Which are wrong, shape (n,)."""
        return np.asarray((self.distance > WRONG_DISTANCE_M) | (self.angle > WRONG_ANGLE_RAD))

    def __len__(self) -> int:
        return len(self.distance)


def closure_errors(graph: Mapping[str, Any], truth: Trajectory) -> ClosureErrors:
    """Errors of the loop edges of a `map/graph` answer.

    Raises:
        ValueError: a keyframe's stamp lies outside the truth.
    """
    stamps = {int(k["id"]): int(k["stamp_ns"]) for k in graph["keyframes"]}
    loops = [edge for edge in graph["edges"] if edge["kind"] == "loop"]
    pairs = np.array([(int(e["i"]), int(e["j"])) for e in loops], dtype=np.int64).reshape(-1, 2)
    if not loops:
        empty = np.zeros(0)
        return ClosureErrors(pairs, empty, empty, empty)
    poses = []
    for column in (0, 1):
        wanted = np.array([stamps[int(k)] for k in pairs[:, column]], dtype=np.int64)
        inside, T = interpolate(truth, wanted)
        if not inside.all():
            raise ValueError(f"keyframe {pairs[~inside, column][0]} lies outside the time that the truth covers")
        poses.append(T)
    measured = geometry.from_vector7(np.array([edge["T_i_j"] for edge in loops], dtype=np.float64))
    error = geometry.inverse(geometry.inverse(poses[0]) @ poses[1]) @ measured
    angle = np.linalg.norm(geometry.se3_log(error)[:, 3:], axis=1)
    weight = np.array([float(edge["weight"]) for edge in loops])
    return ClosureErrors(pairs, np.linalg.norm(error[:, :3, 3], axis=1), angle, weight)
