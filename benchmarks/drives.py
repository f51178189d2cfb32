"""Accuracy and speed of every SLAM method on recordings: one table, odometry beside them.

robominer-slam simulate --scenario 1 --record scenario1.mcap --out out/sim
python benchmarks/drives.py scenario1.mcap
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from robominer_slam.cli.evaluate import truth_of
from robominer_slam.evaluation.report import DriveReport, drive_report
from robominer_slam.evaluation.trajectory import Trajectory
from robominer_slam.frame_result import FrameResult
from robominer_slam.graph_json import graph_json
from robominer_slam.replay import prepare, replay

METHODS = ("thesis",)
SOURCES = ("fused", "odometry")


def measure(path: Path, method: str, source: str) -> tuple[DriveReport, float]:
    """The report of one replay, and how many times faster than real time it went."""
    inputs = prepare(path, None)
    configuration = inputs.configuration.model_copy(
        update={
            "slam": inputs.configuration.slam.model_copy(update={"method": method}),
            "estimation": inputs.configuration.estimation.model_copy(update={"source": source}),
        }
    )
    stamps, slam, odometry = [], [], []

    def on_frame(frame: FrameResult) -> None:
        stamps.append(frame.stamp_ns)
        slam.append(frame.T_map_base)
        odometry.append(frame.T_odom_base)

    start = time.perf_counter()
    result = replay(type(inputs)(inputs.recording, configuration, inputs.layout, inputs.model), on_frame)
    seconds = time.perf_counter() - start
    times = np.array(stamps, dtype=np.int64)
    report = drive_report(
        Trajectory(times, np.array(slam)),
        Trajectory(times, np.array(odometry)),
        truth_of(path),
        json.loads(graph_json(result.keyframe_map, 0)),
    )
    return report, report.duration_s / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, nargs="+")
    arguments = parser.parse_args()
    table = Table(title="position error (m): mean / max")
    for column in ("recording", "source", "method", "odometry", "SLAM", "closures", "wrong", "x real time"):
        table.add_column(column)
    for path in arguments.recordings:
        for source in SOURCES:
            for method in METHODS:
                report, factor = measure(path, method, source)
                position = {"odometry": report.odometry.position, "SLAM": report.slam.position}
                shown = [f"{p.mean():.3f} / {p.max():.3f}" for p in position.values()]
                wrong = int(report.closures.wrong.sum())
                table.add_row(path.stem, source, method, *shown, str(len(report.closures)), str(wrong), f"{factor:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
