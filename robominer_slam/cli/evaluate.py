"""`robominer-slam evaluate`: trajectories against ground truth, with the thesis's path figure."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from robominer_slam.cli.evaluate_runs import report, run
from robominer_slam.evaluation.report import ERROR_COLUMNS, DriveReport, drive_report, report_rows
from robominer_slam.evaluation.trajectory_files import read_tum, truth_of
from robominer_slam.mapping.height_grid import height_grid

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)


def print_report(report: DriveReport, title: str) -> None:
    """The table on stdout."""
    errors, figures = report_rows(report)
    table = Table(title=title)
    for column in ERROR_COLUMNS:
        table.add_column(column, justify="left" if column in ("error", "method") else "right")
    for row in errors:
        table.add_row(*row)
    console = Console()
    console.print(table)
    for name, value in figures:
        console.print(f"{name:>40}: {value}", highlight=False)


@click.group(
    invoke_without_command=True,
    epilog="Example: robominer-slam evaluate --truth drive.mcap --odometry odometry.tum --slam slam.tum",
)
@click.option("--truth", type=FILE, help="Ground truth: TUM format, or the recording.")
@click.option("--odometry", type=FILE, help="Dead reckoning alone, TUM format.")
@click.option("--slam", type=FILE, help="Poses as published, TUM format.")
@click.option("--graph", "graph_file", type=FILE, help="Pose graph, the JSON of map/graph.")
@click.option("--figure", type=click.Path(dir_okay=False, path_type=Path), help="Path figure to write (PNG).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.pass_context
def evaluate(
    context: click.Context,
    truth: Path | None,
    odometry: Path | None,
    slam: Path | None,
    graph_file: Path | None,
    figure: Path | None,
    as_json: bool,
) -> None:
    """Errors of odometry and SLAM against ground truth, frame by frame, without alignment.

    With the options below for one drive whose trajectories are there; with `run` for recordings that are to be
    replayed with several methods; with `report` for saved results of `run`.
    """
    if context.invoked_subcommand is not None:
        if as_json or any((truth, odometry, slam, graph_file, figure)):
            raise click.UsageError(f"Options go behind '{context.invoked_subcommand}'.")
        return
    if truth is None or odometry is None or slam is None:
        given = {"--truth": truth, "--odometry": odometry, "--slam": slam}
        missing = next(option for option, value in given.items() if value is None)
        raise click.UsageError(f"Missing option '{missing}'.")
    trajectories = {"truth": truth_of(truth), "odom": read_tum(odometry), "slam": read_tum(slam)}
    graph = json.loads(graph_file.read_text(encoding="utf-8")) if graph_file else {"keyframes": [], "edges": []}
    try:
        errors = drive_report(trajectories["slam"], trajectories["odom"], trajectories["truth"], graph)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    if figure is not None:
        from robominer_slam.evaluation.figures import DriveData, path_figure  # matplotlib is in the extras only

        empty = height_grid(np.zeros((0, 3)), 1.0)
        order = (trajectories["truth"], trajectories["odom"], trajectories["slam"])
        path_figure(figure, DriveData(*order, graph, empty, errors), slam.stem)
    if as_json:
        click.echo(json.dumps(errors.as_dict()))
    else:
        print_report(errors, slam.stem)


evaluate.add_command(run)
evaluate.add_command(report)
