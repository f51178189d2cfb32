"""One drive's table: errors of odometry and SLAM against the truth, keyframes, closures, cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robominer_slam.evaluation.metrics import ErrorStatistics, TrajectoryErrors, trajectory_errors
from robominer_slam.evaluation.pose_graph_errors import ClosureErrors, closure_errors
from robominer_slam.evaluation.trajectory import Trajectory

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class DriveReport:
    """Everything in the table.

    Attributes:
        slam, odometry: errors of both trajectories.
        closures: errors of the loop closures.
        keyframes: number of them.
        duration_s: from the first to the last pose.
        cpu_s: processor time of the daemon, or None if it was not measured.
        peak_memory_mb: its largest resident memory, or None.
    """

    slam: TrajectoryErrors
    odometry: TrajectoryErrors
    closures: ClosureErrors
    keyframes: int
    duration_s: float
    cpu_s: float | None = None
    peak_memory_mb: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON; positions in m, headings in deg."""
        result: dict[str, Any] = {}
        for name, errors in (("odometry", self.odometry), ("slam", self.slam)):
            result[name] = {
                "position_m": ErrorStatistics.of(errors.position).as_dict(),
                "heading_deg": ErrorStatistics.of(np.rad2deg(errors.heading)).as_dict(),
                "frames": len(errors.stamps_ns),
            }
        result["keyframes"] = self.keyframes
        result["loop_closures"] = len(self.closures)
        result["wrong_loop_closures"] = int(self.closures.wrong.sum())
        result["duration_s"] = self.duration_s
        if self.cpu_s is not None:
            result["cpu_s_per_s"] = self.cpu_s / self.duration_s
        if self.peak_memory_mb is not None:
            result["peak_memory_MB"] = self.peak_memory_mb
        return result


def drive_report(
    slam: Trajectory,
    odometry: Trajectory,
    truth: Trajectory,
    graph: Mapping[str, Any],
    cpu_s: float | None = None,
    peak_memory_mb: float | None = None,
) -> DriveReport:
    """Compare a drive with the truth.

    Raises:
        ValueError: the trajectories do not overlap with the truth in time.
    """
    return DriveReport(
        slam=trajectory_errors(slam, truth),
        odometry=trajectory_errors(odometry, truth),
        closures=closure_errors(graph, truth),
        keyframes=len(graph["keyframes"]),
        duration_s=float(slam.stamps_ns[-1] - slam.stamps_ns[0]) * 1e-9,
        cpu_s=cpu_s,
        peak_memory_mb=peak_memory_mb,
    )


def report_rows(report: DriveReport) -> tuple[list[list[str]], list[tuple[str, str]]]:
    """The report as rows of text: errors (see ERROR_COLUMNS), and named figures."""
    errors = []
    for what, pick in (("position (m)", _position), ("heading (deg)", _heading)):
        for name, one in (("odometry", report.odometry), ("SLAM", report.slam)):
            statistics = ErrorStatistics.of(pick(one))
            values = (statistics.mean, statistics.median, statistics.p95, statistics.max)
            errors.append([what, name, *(f"{value:.3f}" for value in values), str(len(one.stamps_ns))])
    wrong = int(report.closures.wrong.sum())
    figures = [
        ("keyframes", str(report.keyframes)),
        ("loop closures", str(len(report.closures))),
        ("of these wrong (over 0.10 m or 5 deg)", str(wrong)),
        ("duration", f"{report.duration_s:.1f} s"),
    ]
    if report.cpu_s is not None:
        figures.append(("CPU seconds per second of data", f"{report.cpu_s / report.duration_s:.3f}"))
    if report.peak_memory_mb is not None:
        figures.append(("peak memory of the daemon", f"{report.peak_memory_mb:.0f} MB"))
    return errors, figures


ERROR_COLUMNS = ("error", "method", "mean", "median", "95 %", "max", "frames")


def _position(errors: TrajectoryErrors) -> FloatArray:
    return errors.position


def _heading(errors: TrajectoryErrors) -> FloatArray:
    return np.asarray(np.rad2deg(errors.heading))
