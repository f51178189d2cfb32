"""Progress, table and failures of an evaluation in the terminal."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from robominer_slam.evaluation.acceptance import acceptance_table, text_tables
from robominer_slam.evaluation.campaign import Campaign, run_tasks
from robominer_slam.evaluation.results_file import RESULTS, results, write_results
from robominer_slam.evaluation.run_record import ResultsError, RunRecord
from robominer_slam.evaluation.run_task import RunTask, SurfaceOf


def run_with_progress(
    tasks: Sequence[RunTask], folder: Path, jobs: int, surface_of: SurfaceOf | None = None
) -> Campaign:
    """Evaluate with a progress bar on stderr, and write `results.json` into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task("evaluating", total=len(tasks))

        def on_done(task: RunTask) -> None:
            progress.update(bar, advance=1, description=f"{task.key.drive}, {task.key.series}, {task.key.source}")

        campaign = run_tasks(tasks, folder, jobs, surface_of, on_done)
    write_results(campaign, folder)
    return campaign


def write_report(path: Path, records: Sequence[RunRecord], files: Sequence[Path]) -> None:
    """Write the HTML page, with a progress bar on stderr.

    Raises:
        ResultsError: a saved run is missing or damaged, or matplotlib is not installed.
    """
    try:
        from robominer_slam.evaluation.page.page import write_page  # matplotlib is in the extras only
    except ModuleNotFoundError as error:
        raise ResultsError(f"the page needs {error.name}: pip install robominer-slam[operator]") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    drives = len({record.key.drive for record in records})
    with Progress(console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task("drawing", total=drives)
        write_page(path, records, files, lambda drive: progress.update(bar, advance=1, description=drive))


def print_campaign(campaign: Campaign, folder: Path, as_json: bool, echo: Callable[[str], None] = click.echo) -> None:
    """The acceptance table, or everything as JSON, on stdout; failures on stderr."""
    if as_json:
        echo(json.dumps(results(campaign, folder)))
    elif campaign.records:
        print_table(campaign.records)
        echo(f"{len(campaign.records)} runs, {campaign.reused} of them from before; {folder / RESULTS}")
    for failure in campaign.failures:
        click.echo(f"error: {failure.task.path.stem}, {failure.task.key.series}: {failure.reason}", err=True)


def print_table(records: Sequence[RunRecord]) -> None:
    """The acceptance table on stdout, methods side by side, a table for each source of odometry."""
    for text in text_tables(acceptance_table(records)):
        # A pipe or file has no width: nothing is to be cut there.
        console = Console(width=None if sys.stdout.isatty() else 60 + sum(len(name) + 6 for name in text.columns))
        table = Table(title=f"odometry: {text.source}; errors against the truth, without alignment")
        table.add_column("")
        for name in text.columns:
            table.add_column(name, justify="right", overflow="fold")
        for name, cells in text.lines:
            table.add_row(name, *cells)
        console.print(table)
