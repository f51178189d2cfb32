"""One evaluated replay with what its figures need, in one file."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robominer_slam.evaluation.metrics import TrajectoryErrors, trajectory_errors
from robominer_slam.evaluation.run_record import ResultsError, RunRecord
from robominer_slam.evaluation.trajectory import Trajectory
from robominer_slam.mapping.height_grid import HeightGrid

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RunResult:
    """A record and its arrays.

    Attributes:
        record: the figures.
        truth, odometry, slam: poses at the same frames.
        graph: the pose graph at the end, as `map/graph` has it.
        wrong: which of the graph's loop closures are wrong, in their order, shape (n,).
        grid: heights of the final map.
        surface: the true surface's heights at the centres of the grid's cells, of the grid's shape, m; None where
            nobody knows it.
    """

    record: RunRecord
    truth: Trajectory
    odometry: Trajectory
    slam: Trajectory
    graph: Mapping[str, Any]
    wrong: NDArray[np.bool_]
    grid: HeightGrid
    surface: FloatArray | None = None

    @property
    def slam_errors(self) -> TrajectoryErrors:
        """Errors of the poses as published."""
        return trajectory_errors(self.slam, self.truth)

    @property
    def odometry_errors(self) -> TrajectoryErrors:
        """Errors of dead reckoning."""
        return trajectory_errors(self.odometry, self.truth)

    def save(self, path: Path, fingerprint: str) -> None:
        """Write to a file that is there as a whole or not at all; `fingerprint` says what it was made from."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            fingerprint=np.array(fingerprint),
            record=np.array(json.dumps(self.record.as_dict())),
            graph=np.array(json.dumps(self.graph)),
            wrong=self.wrong,
            stamps_ns=self.truth.stamps_ns,
            truth=self.truth.T[:, :3],
            odometry=self.odometry.T[:, :3],
            slam=self.slam.T[:, :3],
            height=self.grid.height,
            origin=np.array(self.grid.origin),
            cell=np.array(self.grid.cell),
            surface=np.zeros(0) if self.surface is None else self.surface,
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_bytes(buffer.getvalue())
        part.replace(path)


def load_result(path: Path) -> RunResult:
    """Read a saved run.

    Raises:
        ResultsError: it cannot be read, or is not a run's file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            stamps = file["stamps_ns"]
            x, y = (float(v) for v in file["origin"])
            return RunResult(
                record=RunRecord.from_dict(json.loads(str(file["record"]))),
                truth=Trajectory(stamps, _poses(file["truth"])),
                odometry=Trajectory(stamps, _poses(file["odometry"])),
                slam=Trajectory(stamps, _poses(file["slam"])),
                graph=json.loads(str(file["graph"])),
                wrong=file["wrong"],
                grid=HeightGrid((x, y), float(file["cell"]), file["height"]),
                surface=file["surface"] if file["surface"].size else None,
            )
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ResultsError(f"{path}: not a saved run: {reason}") from error


def saved_record(path: Path, fingerprint: str) -> RunRecord | None:
    """The record of a saved run, or None where there is none made from the same."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["fingerprint"]) != fingerprint:
                return None
            return RunRecord.from_dict(json.loads(str(file["record"])))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        return None


def _poses(rows: FloatArray) -> FloatArray:
    """Matrices (n, 4, 4) from their first three rows."""
    T = np.zeros((len(rows), 4, 4))
    T[:, :3] = rows
    T[:, 3, 3] = 1.0
    return T
