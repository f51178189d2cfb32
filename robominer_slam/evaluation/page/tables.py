"""The page's tables: the acceptance table, and the runs of one drive."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

from robominer_slam.evaluation.acceptance import AcceptanceRow, text_tables
from robominer_slam.evaluation.metrics import ErrorStatistics
from robominer_slam.evaluation.page.run_view import DriveViews
from robominer_slam.evaluation.run_record import RunRecord

RUN_HEAD = (
    "odometry", "noise", "method", "position error (m): mean", "median", "95 %", "largest", "heading (deg)",
    "odometry's mean (m)", "keyframes", "true closures", "wrong", "height RMS (mm)", "within 99 % (%)",
    "tracking (%)", "x real time",
)  # fmt: skip


def acceptance_html(rows: Sequence[AcceptanceRow]) -> str:
    """The acceptance table, one for each source of odometry, methods side by side."""
    parts = []
    for table in text_tables(rows):
        name = html.escape(SOURCES.get(table.source, table.source))
        lines = _table(["", *table.columns], ([name, *cells] for name, cells in table.lines))
        parts.append(f"<div><h3>Odometry: {name}</h3>{lines}</div>")
    return f'<div class="tables">{"".join(parts)}</div>'


def runs_html(views: Sequence[DriveViews]) -> str:
    """Every run of one drive, a line each."""
    rows = []
    for one in views:
        for name in dict.fromkeys(run.key.series for run in one.runs):
            rows += [_run(run.record) for run in one.of_series(name)]
    return f'<div class="runs">{_table(RUN_HEAD, rows)}</div>'


#: What the sources of odometry are, in words.
SOURCES = {"fused": "fused from IMU and screws", "odometry": "the thesis's, ready-made with bias and noise"}


def _run(run: RunRecord) -> list[str]:
    seed = run.key.odometry_seed
    return [
        run.key.source,
        "-" if seed is None else str(seed),
        run.key.series,
        *_statistics(run.slam_position_m),
        f"{run.slam_heading_deg.mean:.2f}",
        f"{run.odometry_position_m.mean:.3f}",
        str(run.keyframes),
        str(run.closures.true),
        str(run.closures.wrong),
        "-" if run.height is None else f"{1e3 * run.height.rms_m:.1f}",
        f"{100.0 * run.consistency.share_within_99:.1f}",
        f"{100.0 * run.states.get('tracking', 0.0):.1f}",
        f"{run.real_time_factor:.1f}",
    ]


def _statistics(statistics: ErrorStatistics) -> list[str]:
    return [f"{v:.3f}" for v in (statistics.mean, statistics.median, statistics.p95, statistics.max)]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
