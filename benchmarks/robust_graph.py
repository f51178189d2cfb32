"""Pose graphs with wrong loops: the robust optimiser against plain kernels and GTSAM's GNC, on the same graphs.

    python benchmarks/robust_graph.py [--data DIR] [--seeds N] [--rival-seeds N] [--sets intel,M3500,smallGrid3D]

Wrong loops are added as 0, 10, 30, 50 and 70 % of all loops, and as a group of ten that agree with each other
(`false_loops`). Shown is the RMSE of the positions (m) to the optimum of the graph without them, first pose fixed, no
alignment: worst / median over the seeds; the median time; wrong loops accepted and true ones rejected, worst seed.

The rivals get the poses of the file and know which edges are odometry: kernels of width 1 sigma on the loops, at
most 30 iterations; GTSAM's GNC with truncated least squares, odometry as known inliers, its threshold at 99 %.
They run up to 50 % on intel and 10 % on M3500: with thousands of random loops the matrix fills up, and each takes
many minutes.
For one thread set OPENBLAS_NUM_THREADS=1.
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

from benchmarks.false_loops import agreeing, is_loop, optimum, pose_graph, position_rmse, scattered
from benchmarks.pose_graph import gtsam_problem
from robominer_slam.geometry import FloatArray
from robominer_slam.slam.g2o_format import G2oGraph, parse_g2o
from robominer_slam.slam.pose_graph import OptimizationOptions, PoseGraphError
from robominer_slam.slam.robust_optimizer import optimize_robustly

DEFAULT_DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "pose_graphs"
#: RMSE that is asked for, m.
LIMITS = {"intel": 0.05, "M3500": 0.05, "smallGrid3D": 0.1}
SHARES = (0.0, 0.1, 0.3, 0.5, 0.7)
KERNELS = {"L2": None, "Huber": "huber", "DCS": "dcs"}
#: Above so many wrong loops the matrix of all loops fills up, and the rivals are left out.
RIVALS_UP_TO = {"intel": 800, "M3500": 300}


def by_kernel(content: G2oGraph, kernel: str | None) -> FloatArray:
    graph = pose_graph(content)
    graph.set_edge_kernel(np.flatnonzero(is_loop(content)), kernel)
    graph.optimize(OptimizationOptions(max_iterations=30))
    return graph.poses


def by_gnc(content: G2oGraph) -> FloatArray:
    import gtsam

    plane = content.dim == 2
    values, factors = gtsam_problem(content)
    pose_of: Callable[[Any], Any] = (lambda pose: gtsam.Pose2(*pose)) if plane else gtsam.Pose3
    prior = gtsam.PriorFactorPose2 if plane else gtsam.PriorFactorPose3
    d = 3 if plane else 6
    factors.add(prior(0, pose_of(content.poses[0]), gtsam.noiseModel.Isotropic.Sigma(d, 1e-6)))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers([*np.flatnonzero(~is_loop(content)).tolist(), content.i.size])
    optimizer = gtsam.GncLMOptimizer(factors, values, parameters)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    found = optimizer.optimize()
    if plane:
        poses = [found.atPose2(k) for k in range(content.ids.size)]
        return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])
    return np.stack([found.atPose3(k).matrix() for k in range(content.ids.size)])


def rivals(content: G2oGraph, reference: FloatArray) -> dict[str, tuple[float, float]]:
    """RMSE (m) and seconds per rival."""
    ways: dict[str, Callable[[], FloatArray]] = {
        name: (lambda kernel=kernel: by_kernel(content, kernel)) for name, kernel in KERNELS.items()
    }
    ways["GNC"] = lambda: by_gnc(content)
    out = {}
    for name, way in ways.items():
        started = perf_counter()
        try:
            rmse = position_rmse(content.dim, way(), reference)
        except (ImportError, PoseGraphError, RuntimeError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            rmse = float("nan")
        out[name] = rmse, perf_counter() - started
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder of the public data sets")
    parser.add_argument("--sets", default=",".join(LIMITS), help="data sets, by name")
    parser.add_argument("--seeds", type=int, default=5, help="graphs per row for the robust optimiser")
    parser.add_argument("--rival-seeds", type=int, default=1, help="of these, graphs for the rivals")
    arguments = parser.parse_args()
    console = Console(width=150)
    table = Table(title="RMSE (m) worst / median, and seconds (median)")
    for column in ("data set", "wrong", "robust", "s", "wrong in", "true out", "L2", "Huber", "DCS", "GNC", "GNC s"):
        table.add_column(column, justify="left" if column == "data set" else "right", no_wrap=True)
    missed = 0
    for name in arguments.sets.split(","):
        clean = parse_g2o((arguments.data / f"{name}.g2o").read_text(encoding="utf-8"), name)
        reference = optimum(clean)
        for share in (*SHARES, None):
            rmse, seconds, wrong_in, true_out = [], [], [], []
            theirs: dict[str, list[tuple[float, float]]] = {}
            for seed in range(1 if share == 0.0 else arguments.seeds):
                made = agreeing(clean, reference, seed) if share is None else scattered(clean, reference, share, seed)
                content, wrong = made
                graph = pose_graph(content)
                result = optimize_robustly(graph)
                rmse.append(position_rmse(clean.dim, graph.poses, reference))
                seconds.append(result.seconds)
                wrong_in.append(int((result.accepted & wrong).sum()))
                true_out.append(int((~result.accepted & ~wrong).sum()))
                missed += rmse[-1] > LIMITS[name]
                if seed < arguments.rival_seeds and wrong.sum() <= RIVALS_UP_TO.get(name, np.inf):
                    for rival, figures in rivals(content, reference).items():
                        theirs.setdefault(rival, []).append(figures)
            row = [name, "10 agree" if share is None else f"{share:.0%}"]
            row += [f"{max(rmse):.4f} / {statistics.median(rmse):.4f}", f"{statistics.median(seconds):.1f}"]
            row += [str(max(wrong_in)), str(max(true_out))]
            for rival in (*KERNELS, "GNC"):
                figures = theirs.get(rival, [])
                row.append(f"{max(r for r, _ in figures):.3f}" if figures else "-")
            row.append(f"{statistics.median(s for _, s in theirs['GNC']):.0f}" if "GNC" in theirs else "-")
            table.add_row(*row)
            print(" | ".join(row), file=sys.stderr, flush=True)
    console.print(table)
    console.print(f"{missed} graphs above the limit of 0.05 m, 0.1 m on smallGrid3D")


if __name__ == "__main__":
    main()
