"""The demo's table and figures, from the files that the listener and the simulator wrote."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np

from robominer_slam.cli.evaluate import print_report
from robominer_slam.evaluation.figures import DriveData, write_figures
from robominer_slam.evaluation.report import drive_report
from robominer_slam.evaluation.trajectory_files import read_tum
from robominer_slam.mapping.height_grid import height_grid
from sim_backend.process_usage import ProcessUsage

#: Cells of the height map in the figure, m.
FIGURE_CELL = 0.02


def write_report(out: Path, truth_file: Path, scenario: int, usage: ProcessUsage, as_json: bool) -> None:
    """Print the table and write figures, trajectories and report.json into `out`."""
    truth, slam, odometry = (read_tum(path) for path in (truth_file, out / "slam.tum", out / "odometry.tum"))
    graph = json.loads((out / "graph.json").read_text(encoding="utf-8"))
    points = np.load(out / "cloud.npy").astype(np.float64)
    report = drive_report(slam, odometry, truth, graph, usage.cpu_s, usage.peak_memory_mb)
    (out / "truth.tum").write_text(truth_file.read_text(encoding="utf-8"), encoding="utf-8")
    (out / "report.json").write_text(json.dumps(report.as_dict(), indent=1) + "\n", encoding="utf-8")
    name = f"scenario {scenario}"
    data = DriveData(truth, odometry, slam, graph, height_grid(points, FIGURE_CELL), report)
    write_figures(out, data, name)
    if as_json:
        click.echo(json.dumps(report.as_dict()))
    else:
        print_report(report, f"{name}: estimate against the truth")
