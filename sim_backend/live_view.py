"""The demo's live view: progress, and the pose errors in all six components, as the thesis's error node showed them.

It reads what the listener and the simulator write as they go; it knows nothing of the daemon's inside.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np
from rich.console import Group, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from robominer_slam.evaluation.metrics import COMPONENTS, component_errors
from robominer_slam.evaluation.trajectory import Trajectory, TrajectoryError, interpolate, parse_tum

#: Truth kept for comparison: the newest estimate is at most a second old.
KEPT_LINES = 200


class TumTail:
    """The newest complete lines of a TUM file that grows."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = None
        self._rest = ""
        self.lines: list[str] = []
        self.count = 0

    def read(self) -> None:
        """Take what has been written since the last call."""
        if self._file is None:
            if not self._path.exists():
                return
            self._file = self._path.open(encoding="utf-8")
        *complete, self._rest = (self._rest + self._file.read()).split("\n")
        complete = [line for line in complete if line and not line.startswith("#")]
        self.count += len(complete)
        self.lines = (self.lines + complete)[-KEPT_LINES:]

    def trajectory(self) -> Trajectory | None:
        """The kept lines as a trajectory; None while there are none."""
        try:
            return parse_tum(self.lines, str(self._path))
        except TrajectoryError:
            return None

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class LiveView:
    """What the terminal shows while the robot drives.

    Args:
        truth, slam, odometry: the three growing TUM files.
        duration_s: how long the drive will take, in the robot's time.
    """

    def __init__(self, truth: Path, slam: Path, odometry: Path, duration_s: float) -> None:
        self._truth = TumTail(truth)
        self._estimates = {"odometry": TumTail(odometry), "SLAM": TumTail(slam)}
        self._progress = Progress(
            TextColumn("driving"), BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(),
            TextColumn("left"), TimeRemainingColumn(),
        )  # fmt: skip
        self._task = self._progress.add_task("drive", total=duration_s)
        self.first_stamp_ns: int | None = None

    def update(self) -> None:
        """Read what is new."""
        for tail in (self._truth, *self._estimates.values()):
            tail.read()
        truth = self._truth.trajectory()
        if truth is not None:
            if self.first_stamp_ns is None:
                self.first_stamp_ns = int(truth.stamps_ns[0])
            self._progress.update(self._task, completed=(truth.stamps_ns[-1] - self.first_stamp_ns) * 1e-9)

    def errors(self) -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
        """Newest error of each estimate: x, y, z (m), roll, pitch, yaw (rad); those that can be told."""
        truth = self._truth.trajectory()
        found = {}
        for name, tail in self._estimates.items():
            estimate = tail.trajectory()
            if truth is None or estimate is None:
                continue
            inside, T_truth = interpolate(truth, estimate.stamps_ns)
            if inside.any():
                found[name] = component_errors(estimate.T[inside][-1], T_truth[-1])
        return found

    def frames(self) -> int:
        """SLAM poses heard so far."""
        return self._estimates["SLAM"].count

    def render(self) -> RenderableType:
        """The table and the bar."""
        table = Table(title="pose error now: estimate minus truth")
        table.add_column("method")
        for component in COMPONENTS:
            table.add_column(f"{component} ({'m' if component in 'xyz' else 'deg'})", justify="right", min_width=9)
        table.add_column("poses", justify="right")
        for name, error in self.errors().items():
            shown = np.concatenate([error[:3], np.rad2deg(error[3:])])
            table.add_row(name, *(f"{value:+.3f}" for value in shown), str(self._estimates[name].count))
        return Group(table, self._progress)

    def line(self) -> str:
        """One line for where there is no terminal."""
        parts = []
        for name, error in self.errors().items():
            shown = np.concatenate([error[:3], np.rad2deg(error[3:])])
            values = " ".join(f"{c} {v:+.3f}" for c, v in zip(COMPONENTS, shown, strict=True))
            parts.append(f"{name}: {values}")
        task = self._progress.tasks[0]
        return f"{task.percentage:3.0f} %  " + "  |  ".join(parts)

    def close(self) -> None:
        """Close the files."""
        for tail in (self._truth, *self._estimates.values()):
            tail.close()
