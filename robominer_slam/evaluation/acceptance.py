"""The table by which a method is accepted: one row per method, variant and source, over all runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from robominer_slam.evaluation.run_record import RunRecord

#: A run is worse than odometry if its mean position error is larger by both.
WORSE_SHARE = 0.05
WORSE_M = 0.005
#: Closures that a run needs to count as having closed its loops.
ENOUGH_CLOSURES = 5


@dataclass(frozen=True, slots=True)
class AcceptanceRow:
    """One method, variant and source over all runs. Errors are against the truth, without alignment.

    Attributes:
        method, variant, source: whose row.
        runs: number of them.
        mean_m: mean over the runs of their mean position errors.
        worst_mean_m: the largest of these.
        worst_moment_m: the largest position error of any frame.
        heading_deg: mean over the runs of their mean heading errors.
        worse_than_odometry: runs whose mean position error is larger than that of the raw dead reckoning (method
            `none` on the same recording, or else `thesis`'s odometry) by more than 5 % and 5 mm; None where neither
            was run.
        worse_than_own_odometry: likewise against the same run's own dead reckoning.
        wrong_closures: closures that survive the kernel and are wrong, all runs together.
        runs_with_closures: runs with at least five true closures.
        height_rms_mm, height_median_mm: means over the runs of the height map's errors; None without any.
        consistency: share of all frames within the 99 % quantile of their covariance.
        sigma_ratio: median over the runs of median sigma over median error.
        real_time_factor: median over the runs.
    """

    method: str
    variant: str
    source: str
    runs: int
    mean_m: float
    worst_mean_m: float
    worst_moment_m: float
    heading_deg: float
    worse_than_odometry: int | None
    worse_than_own_odometry: int
    wrong_closures: int
    runs_with_closures: int
    height_rms_mm: float | None
    height_median_mm: float | None
    consistency: float
    sigma_ratio: float | None
    real_time_factor: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Figure:
    """A line of the printed table: which field, its name with unit, and how a value is written."""

    field: str
    name: str
    text: Callable[[Any], str]


def _number(digits: int) -> Callable[[Any], str]:
    return lambda value: "-" if value is None else f"{value:.{digits}f}"


def _share(value: float) -> str:
    return f"{100.0 * value:.1f}"


def _plain(value: object) -> str:
    return "-" if value is None else str(value)


FIGURES = (
    Figure("runs", "runs", _plain),
    Figure("mean_m", "mean position error (m)", _number(4)),
    Figure("worst_mean_m", "worst run's mean (m)", _number(3)),
    Figure("worst_moment_m", "worst moment (m)", _number(3)),
    Figure("heading_deg", "mean heading error (deg)", _number(2)),
    Figure("worse_than_odometry", "runs worse than odometry", _plain),
    Figure("worse_than_own_odometry", "runs worse than their own odometry", _plain),
    Figure("wrong_closures", "wrong closures left", _plain),
    Figure("runs_with_closures", "runs with 5 true closures or more", _plain),
    Figure("height_rms_mm", "height map, RMS error (mm)", _number(1)),
    Figure("height_median_mm", "height map, median error (mm)", _number(1)),
    Figure("consistency", "frames within 99 % of covariance (%)", _share),
    Figure("sigma_ratio", "median sigma / median error", _number(2)),
    Figure("real_time_factor", "times real time", _number(1)),
)


@dataclass(frozen=True, slots=True)
class TextTable:
    """One source's rows, side by side: a column for each method and variant, a line for each figure."""

    source: str
    columns: list[str]
    lines: list[tuple[str, list[str]]]


def acceptance_table(runs: Iterable[RunRecord]) -> list[AcceptanceRow]:
    """One row per source, method and variant, in the order of their first run; sources stay together."""
    runs = list(runs)
    raw = _raw_odometry(runs)
    groups: dict[tuple[str, str, str], list[RunRecord]] = {}
    for run in runs:
        groups.setdefault((run.key.source, run.key.method, run.key.variant), []).append(run)
    sources = list(dict.fromkeys(source for source, _, _ in groups))
    ordered = sorted(groups.items(), key=lambda item: sources.index(item[0][0]))
    return [_row(key, group, raw) for key, group in ordered]


def text_tables(rows: Sequence[AcceptanceRow]) -> list[TextTable]:
    """The table as it is printed, one for each source; figures that no method has are left out."""
    tables = []
    for source in dict.fromkeys(row.source for row in rows):
        own = [row for row in rows if row.source == source]
        columns = [f"{row.method}, {row.variant}" if row.variant else row.method for row in own]
        lines = [(figure.name, [figure.text(getattr(row, figure.field)) for row in own]) for figure in FIGURES]
        tables.append(TextTable(source, columns, [line for line in lines if set(line[1]) != {"-"}]))
    return tables


def is_worse(mean_m: float, reference_m: float) -> bool:
    """Whether a mean error is larger than the reference by more than 5 % and 5 mm."""
    return mean_m > (1.0 + WORSE_SHARE) * reference_m and mean_m > reference_m + WORSE_M


def _raw_odometry(runs: Sequence[RunRecord]) -> Mapping[tuple[str, int | None, str], float]:
    """Mean position error of the raw dead reckoning by conditions."""
    found: dict[tuple[str, int | None, str], float] = {}
    for method in ("thesis", "none"):
        for run in runs:
            if run.key.method == method and not run.key.variant:
                found[run.key.conditions] = run.odometry_position_m.mean
    return found


def _row(
    key: tuple[str, str, str], runs: Sequence[RunRecord], raw: Mapping[tuple[str, int | None, str], float]
) -> AcceptanceRow:
    source, method, variant = key
    means = [run.slam_position_m.mean for run in runs]
    known = [run for run in runs if run.key.conditions in raw]
    heights = [run.height for run in runs if run.height is not None]
    frames = np.array([run.frames for run in runs])
    ratios = [run.consistency.sigma_ratio for run in runs if run.consistency.sigma_ratio is not None]
    return AcceptanceRow(
        method=method,
        variant=variant,
        source=source,
        runs=len(runs),
        mean_m=float(np.mean(means)),
        worst_mean_m=max(means),
        worst_moment_m=max(run.slam_position_m.max for run in runs),
        heading_deg=float(np.mean([run.slam_heading_deg.mean for run in runs])),
        worse_than_odometry=(
            sum(is_worse(run.slam_position_m.mean, raw[run.key.conditions]) for run in known) if known else None
        ),
        worse_than_own_odometry=sum(is_worse(run.slam_position_m.mean, run.odometry_position_m.mean) for run in runs),
        wrong_closures=sum(run.closures.wrong for run in runs),
        runs_with_closures=sum(run.closures.true >= ENOUGH_CLOSURES for run in runs),
        height_rms_mm=1e3 * float(np.mean([h.rms_m for h in heights])) if heights else None,
        height_median_mm=1e3 * float(np.mean([h.median_m for h in heights])) if heights else None,
        consistency=float(np.average([run.consistency.share_within_99 for run in runs], weights=frames)),
        sigma_ratio=float(np.median(ratios)) if ratios else None,
        real_time_factor=float(np.median([run.real_time_factor for run in runs])),
    )
