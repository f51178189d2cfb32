"""Pose-graph back-end against GTSAM: minimum reached, and time to come within a millionth of the optimum.

    python benchmarks/pose_graph.py [--data DIR] [--repeats N]

Both start from the poses in the file, parsed beforehand, and are stopped as soon as chi2 is within 1e-6 of the known
optimum; ours includes finding the elimination order, GTSAM's likewise. GTSAM runs Levenberg-Marquardt with its
default parameters. The last column is our time with default options, stopping by itself. Without the public
data sets a made 3D grid and a made 2D graph stand in. For one thread set OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from robominer_slam import geometry
from robominer_slam.slam.g2o_format import G2oGraph, parse_g2o
from robominer_slam.slam.pose_graph import PoseGraph
from robominer_slam.slam.pose_graph_optimizer import OptimizationOptions

DEFAULT_DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "pose_graphs"
#: Optimum in GTSAM's convention, from the data sets' README.
DATA_SETS = {
    "noisyToyGraph.txt": 0.136685648,
    "tinyGrid3D.g2o": 18.6278189,
    "smallGrid3D.g2o": 1035.85066,
    "MIT.g2o": 770.238984,
    "intel.g2o": 45.0042331,
    "M3500.g2o": 137.914878,
    "sphere2500.g2o": 1351.40193,
}
GOOD_ENOUGH = 1e-6
ROTATION_FIRST = [3, 4, 5, 0, 1, 2]


def our_graph(content: G2oGraph) -> PoseGraph:
    graph = PoseGraph(content.dim)
    graph.add_nodes(content.poses)
    graph.add_edges(content.i, content.j, content.measurements, content.information)
    return graph


def our_iterations(content: G2oGraph, optimum: float) -> int:
    """Fewest iterations that come within `GOOD_ENOUGH` of the optimum; 0 if a hundred do not."""
    for iterations in range(1, 101):
        result = our_graph(content).optimize(OptimizationOptions(max_iterations=iterations, relative_tolerance=0.0))
        if result.chi2_after <= optimum * (1.0 + GOOD_ENOUGH):
            return iterations
    return 0


def gtsam_problem(content: G2oGraph) -> tuple[Any, Any]:
    """GTSAM's values and factors of a graph, without a prior on the first pose."""
    import gtsam

    values, factors = gtsam.Values(), gtsam.NonlinearFactorGraph()
    plane = content.dim == 2
    pose_of: Callable[[Any], Any] = (lambda pose: gtsam.Pose2(*pose)) if plane else gtsam.Pose3
    between = gtsam.BetweenFactorPose2 if plane else gtsam.BetweenFactorPose3
    for k, pose in enumerate(content.poses):
        values.insert(k, pose_of(pose))
    for i, j, Z, Omega in zip(
        content.i.tolist(), content.j.tolist(), content.measurements, content.information, strict=True
    ):
        ordered = Omega if plane else Omega[np.ix_(ROTATION_FIRST, ROTATION_FIRST)]
        factors.add(between(i, j, pose_of(Z), gtsam.noiseModel.Gaussian.Information(ordered)))
    return values, factors


def gtsam_seconds(content: G2oGraph, optimum: float) -> Callable[[], float]:
    """A function that runs GTSAM once and returns the seconds it took."""
    import gtsam

    plane = content.dim == 2
    values, factors = gtsam_problem(content)
    pose_of: Callable[[Any], Any] = (lambda pose: gtsam.Pose2(*pose)) if plane else gtsam.Pose3
    equal = gtsam.NonlinearEqualityPose2 if plane else gtsam.NonlinearEqualityPose3
    factors.add(equal(0, pose_of(content.poses[0])))

    def once() -> float:
        started = perf_counter()
        optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values, gtsam.LevenbergMarquardtParams())
        for _ in range(100):
            if 2.0 * optimizer.error() <= optimum * (1.0 + GOOD_ENOUGH):
                break
            optimizer.iterate()
        return perf_counter() - started

    return once


def made_data() -> dict[str, tuple[G2oGraph, float]]:
    """A planar ring and a cube of poses, driven over with noise; the optimum is what a tight run of ours reaches."""
    rng = np.random.default_rng(0)
    out: dict[str, tuple[G2oGraph, float]] = {}
    for dim, n, back in ((2, 1000, 100), (3, 500, 50)):
        angle = 2.0 * np.pi * np.arange(n) / back
        truth = geometry.T_from_xyyaw(np.stack([5.0 * np.cos(angle), 5.0 * np.sin(angle), angle + np.pi / 2.0], -1))
        i = np.concatenate([np.arange(n - 1), np.arange(n - back)])
        j = np.concatenate([np.arange(1, n), np.arange(back, n)])
        noise = rng.normal(size=(i.size, 6)) * 0.02 * ([1, 1, 0, 0, 0, 1] if dim == 2 else [1] * 6)
        Z = geometry.inverse(truth)[i] @ truth[j] @ geometry.se3_exp(noise)
        poses = [truth[0]]
        for step in Z[: n - 1]:
            poses.append(poses[-1] @ step)
        stack = np.stack(poses)
        d = 3 if dim == 2 else 6
        content = G2oGraph(
            dim=2 if dim == 2 else 3,
            ids=np.arange(n),
            poses=geometry.xyyaw_of(stack) if dim == 2 else stack,
            i=i,
            j=j,
            measurements=geometry.xyyaw_of(Z) if dim == 2 else Z,
            information=np.tile(2500.0 * np.eye(d), (i.size, 1, 1)),
        )
        tight = our_graph(content).optimize(OptimizationOptions(relative_tolerance=1e-14))
        out[f"made ring, {dim}D"] = content, tight.chi2_after
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder of the public data sets")
    parser.add_argument("--repeats", type=int, default=7, help="runs per figure; the median is shown")
    arguments = parser.parse_args()
    if arguments.data.is_dir():
        problems = {
            name: (parse_g2o((arguments.data / name).read_text(encoding="utf-8"), name), optimum)
            for name, optimum in DATA_SETS.items()
        }
    else:
        print(f"{arguments.data} is not there: made data instead", file=sys.stderr)
        problems = made_data()
    table = Table(title=f"time to {GOOD_ENOUGH:g} above the optimum, median of {arguments.repeats}")
    for column in ("data set", "poses / edges", "chi2", "above", "its", "ours ms", "GTSAM ms", "ratio", "default ms"):
        table.add_column(column, justify="left" if column == "data set" else "right", no_wrap=True)
    for name, (content, optimum) in problems.items():
        iterations = our_iterations(content, optimum)
        to_good = OptimizationOptions(max_iterations=max(iterations, 1), relative_tolerance=0.0)
        theirs = gtsam_seconds(content, optimum)
        ours_runs, their_runs, default_runs = [], [], []
        for _ in range(arguments.repeats):  # alternating, so that both see the same load of the machine
            ours_runs.append(our_graph(content).optimize(to_good).seconds)
            their_runs.append(theirs())
            default = our_graph(content).optimize()
            default_runs.append(default.seconds)
        ours, gtsam_time = statistics.median(ours_runs), statistics.median(their_runs)
        table.add_row(
            name,
            f"{content.ids.size} / {content.i.size}",
            f"{default.chi2_after:.9g}",
            f"{default.chi2_after / optimum - 1.0:+.1e}",
            str(iterations) if iterations else "never",
            f"{1e3 * ours:.2f}",
            f"{1e3 * gtsam_time:.2f}",
            f"{ours / gtsam_time:.2f}",
            f"{1e3 * statistics.median(default_runs):.2f}",
        )
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
