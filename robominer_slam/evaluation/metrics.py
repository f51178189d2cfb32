"""Errors of an estimated trajectory against the truth, frame by frame, without any alignment.

The position error is the thesis's: distance in x and y at each time. All six components are kept beside it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.evaluation.trajectory import Trajectory, interpolate

FloatArray = NDArray[np.float64]

COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of an error over the frames."""

    mean: float
    median: float
    p95: float
    max: float
    rmse: float

    @classmethod
    def of(cls, errors: FloatArray) -> ErrorStatistics:
        """Of absolute errors, shape (n,), n above 0."""
        return cls(
            float(np.mean(errors)),
            float(np.median(errors)),
            float(np.percentile(errors, 95)),
            float(np.max(errors)),
            float(np.sqrt(np.mean(np.square(errors)))),
        )

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors at the estimate's times that the truth covers.

    Attributes:
        stamps_ns: shape (n,).
        components: estimate minus truth: x, y, z (m) in map; roll, pitch, yaw (rad); shape (n, 6).
        rotation: angle of the rotation between estimate and truth, shape (n,), rad.
    """

    stamps_ns: NDArray[np.int64]
    components: FloatArray
    rotation: FloatArray

    @property
    def position(self) -> FloatArray:
        """Distance in x and y, shape (n,), m."""
        distance: FloatArray = np.hypot(self.components[:, 0], self.components[:, 1])
        return distance

    @property
    def distance(self) -> FloatArray:
        """Distance in x, y and z, shape (n,), m."""
        distance: FloatArray = np.linalg.norm(self.components[:, :3], axis=1)
        return distance

    @property
    def heading(self) -> FloatArray:
        """Absolute heading error, shape (n,), rad."""
        heading: FloatArray = np.abs(self.components[:, 5])
        return heading


def component_errors(T_estimate: FloatArray, T_truth: FloatArray) -> FloatArray:
    """Six components of estimate minus truth, shape (..., 6), of poses (..., 4, 4)."""
    position = T_estimate[..., :3, 3] - T_truth[..., :3, 3]
    angles = geometry.rpy_of(T_estimate) - geometry.rpy_of(T_truth)
    return np.concatenate([position, geometry.wrap_angle(angles)], axis=-1)


def trajectory_errors(estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors:
    """Compare an estimate with the truth, interpolated at the estimate's times.

    Raises:
        ValueError: they do not overlap in time.
    """
    inside, T_truth = interpolate(truth, estimate.stamps_ns)
    if not inside.any():
        raise ValueError("the estimate and the truth do not overlap in time: are their clocks the same?")
    T = estimate.T[inside]
    return TrajectoryErrors(estimate.stamps_ns[inside], component_errors(T, T_truth), rotation_angle(T_truth, T))


def rotation_angle(T_a: FloatArray, T_b: FloatArray) -> FloatArray:
    """Angle of the rotation from a to b, shape (...,), rad, of poses (..., 4, 4)."""
    return np.asarray(np.linalg.norm(geometry.se3_log(geometry.inverse(T_a) @ T_b)[..., 3:], axis=-1))


def relative_errors(estimate: Trajectory, truth: Trajectory, frames: int) -> tuple[FloatArray, FloatArray]:
    """How far the estimate drifts within so many frames, from every frame on: independent of errors before.

    Args:
        estimate: what is judged.
        truth: interpolated at the estimate's times.
        frames: from one pose to the other.

    Returns:
        Distances, m, and angles, rad, of the error of the relative pose; shape (n - frames,) each, empty where the
        estimate has fewer frames.
    """
    inside, T_truth = interpolate(truth, estimate.stamps_ns)
    T = estimate.T[inside]
    moved = geometry.inverse(T[:-frames]) @ T[frames:]
    truly = geometry.inverse(T_truth[:-frames]) @ T_truth[frames:]
    error = geometry.inverse(truly) @ moved
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle(truly, moved)
