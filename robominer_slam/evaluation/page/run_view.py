"""What the page shows of many runs: errors and paths of all, map and graph of a few."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robominer_slam.evaluation.run_record import ResultsError, RunKey, RunRecord
from robominer_slam.evaluation.run_result import RunResult, load_result
from robominer_slam.evaluation.trajectory import Trajectory

FloatArray = NDArray[np.float64]

#: Points of a path as it is drawn: more cannot be seen.
PATH_POINTS = 1500


@dataclass(frozen=True)
class RunView:
    """One run without its map and graph.

    Attributes:
        record: its figures.
        file: where the rest lies.
        slam_error, odometry_error: position errors per frame, shape (n,), m.
        truth, odometry, slam: paths in map, thinned, shape (m, 2), m.
    """

    record: RunRecord
    file: Path
    slam_error: FloatArray
    odometry_error: FloatArray
    truth: FloatArray
    odometry: FloatArray
    slam: FloatArray

    @property
    def key(self) -> RunKey:
        """Which run."""
        return self.record.key

    def full(self) -> RunResult:
        """With map and graph."""
        return load_result(self.file)


@dataclass(frozen=True)
class DriveViews:
    """The runs of one drive with one source of odometry.

    Attributes:
        drive, source: which.
        runs: all of them.
        series: methods and variants, in the order of the runs.
    """

    drive: str
    source: str
    runs: list[RunView]

    @property
    def series(self) -> list[str]:
        """Methods and variants, in the order of the runs; `none` is the odometry and stands for itself."""
        return list(dict.fromkeys(run.key.series for run in self.runs if run.key.method != "none"))

    @property
    def seeds(self) -> list[int | None]:
        """Odometry seeds, ascending."""
        return sorted({run.key.odometry_seed for run in self.runs}, key=lambda seed: -1 if seed is None else seed)

    def of_series(self, series: str) -> list[RunView]:
        """Runs of a method and variant, by seed."""
        order = self.seeds
        return sorted(
            (run for run in self.runs if run.key.series == series), key=lambda run: order.index(run.key.odometry_seed)
        )

    def odometry(self) -> list[RunView]:
        """One run for each seed whose odometry is the raw one, by seed."""
        found: dict[int | None, RunView] = {}
        for method in ("none", "thesis"):
            for run in self.runs:
                if run.key.method == method and not run.key.variant:
                    found.setdefault(run.key.odometry_seed, run)
        for run in self.runs:
            found.setdefault(run.key.odometry_seed, run)
        return [found[seed] for seed in self.seeds]

    def shown_seed(self) -> int | None:
        """The seed whose figures stand for all: of median error with the last method."""
        runs = self.of_series(self.series[-1]) if self.series else self.odometry()
        ranked = sorted(runs, key=lambda run: run.record.slam_position_m.mean)
        return ranked[(len(ranked) - 1) // 2].key.odometry_seed


def read_views(records: Sequence[RunRecord], files: Sequence[Path]) -> list[DriveViews]:
    """All runs by drive and source, drives in the order of their names.

    Raises:
        ResultsError: a saved run is missing or damaged.
    """
    groups: dict[tuple[str, str], list[RunView]] = {}
    for record, file in zip(records, files, strict=True):
        groups.setdefault((record.key.drive, record.key.source), []).append(_view(record, file))
    sources = list(dict.fromkeys(source for _, source in groups))
    order = sorted(groups, key=lambda key: (_rank(key[0]), sources.index(key[1])))
    return [DriveViews(drive, source, groups[drive, source]) for drive, source in order]


def _rank(drive: str) -> tuple[bool, str]:
    """The thesis's scenarios first."""
    return not drive.startswith("scenario "), drive


def _view(record: RunRecord, file: Path) -> RunView:
    result = load_result(file)
    if result.record.key != record.key:
        raise ResultsError(f"{file}: holds another run than the results say")
    return RunView(
        record,
        file,
        result.slam_errors.position,
        result.odometry_errors.position,
        _path(result.truth),
        _path(result.odometry),
        _path(result.slam),
    )


def _path(trajectory: Trajectory) -> FloatArray:
    step = max(1, len(trajectory) // PATH_POINTS)
    return trajectory.T[::step, :2, 3].copy()
