"""Trajectories from files: TUM text, and the ground truth of a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.recording_reader import Recording
from robominer_slam import geometry
from robominer_slam.evaluation.trajectory import Trajectory, TrajectoryError, parse_tum


def read_tum(path: Path) -> Trajectory:
    """Read a TUM trajectory; raises TrajectoryError."""
    with path.open(encoding="utf-8") as file:
        return parse_tum(file, str(path))


def truth_of(path: Path) -> Trajectory:
    """Ground truth of a recording (.mcap) or of a TUM file.

    Raises:
        RecordingError, TrajectoryError: it cannot be read, or has no ground truth.
    """
    if path.suffix != ".mcap":
        return read_tum(path)
    truths = [truth for _, truth in Recording(path).ground_truth()]
    if not truths:
        raise TrajectoryError(f"{path}: no ground truth in this recording")
    stamps = np.array([truth.stamp_ns for truth in truths], dtype=np.int64)
    return Trajectory(stamps, geometry.from_vector7(np.array([truth.pose for truth in truths])))
