"""`robominer-slam graph`: the pose-graph back-end on its own, on files in g2o's format."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from robominer_slam.slam.g2o_format import G2oFormatError, G2oGraph, format_g2o, parse_g2o
from robominer_slam.slam.pose_graph import OptimizationResult, PoseGraph, PoseGraphError
from robominer_slam.slam.pose_graph_optimizer import OptimizationOptions
from robominer_slam.slam.pose_graph_residuals import Convention
from robominer_slam.slam.robust_optimizer import RobustResult, optimize_robustly

CONVENTIONS: tuple[Convention, ...] = ("gtsam", "g2o")
#: Rejected loops listed on a terminal; --json has them all.
_SHOWN = 20
_MEANING = {"gtsam": "full SE(n) log (GTSAM)", "g2o": "t and theta or q_vec (g2o)"}


@click.group(epilog="Example: robominer-slam graph optimize intel.g2o --out optimum.g2o")
def graph() -> None:
    """Pose graphs in g2o's text format."""


def read_g2o(path: Path) -> G2oGraph:
    """Read a file; a user's mistake in it becomes a usage error that names file and line."""
    try:
        return parse_g2o(path.read_text(encoding="utf-8"), str(path))
    except UnicodeDecodeError as error:
        raise click.UsageError(
            f"{path}: not a text file ({error.reason}); expected a pose graph in g2o's format"
        ) from error
    except G2oFormatError as error:
        raise click.UsageError(str(error)) from error


def pose_graph_of(content: G2oGraph, path: Path) -> PoseGraph:
    """Pose graph of a file's content; what cannot be solved becomes a usage error that names the file."""
    try:
        pose_graph = PoseGraph(content.dim)
        pose_graph.add_nodes(content.poses)
        pose_graph.add_edges(content.i, content.j, content.measurements, content.information)
        if content.fixed:
            pose_graph.fix(content.fixed)
    except PoseGraphError as error:
        raise click.UsageError(f"{path}: {error} (nodes and edges counted from 0 in the file's order)") from error
    return pose_graph


_EXAMPLES = """\b
Example: robominer-slam graph optimize intel.g2o --out intel-optimized.g2o --json
Example: robominer-slam graph optimize intel.g2o --out intel-true-loops.g2o --robust"""


@graph.command(epilog=_EXAMPLES)
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--out", type=click.Path(dir_okay=False, path_type=Path), help="Where to write the optimized graph, 17 digits."
)
@click.option(
    "--convention",
    type=click.Choice(CONVENTIONS),
    default="gtsam",
    show_default=True,
    help="Error to minimise: gtsam is the full SE(n) logarithm; g2o is (t, theta) or (t, q_vec).",
)
@click.option(
    "--max-iterations", type=click.IntRange(min=1), default=100, show_default=True, help="Linear solves at most."
)
@click.option(
    "--robust",
    is_flag=True,
    help="Tell true loops from wrong ones first. Edges between nodes whose numbers follow each other are odometry and "
    "stay; loops that disagree with it or with each other are left out, also of the file written.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def optimize(
    file: Path, out: Path | None, convention: Convention, max_iterations: int, robust: bool, as_json: bool
) -> None:
    """Optimize the pose graph in FILE (g2o format).

    The first node stays where it is, or those that FIX lines name. chi2 is the sum of e' Omega e over all edges (with
    --robust, after: over the accepted ones).
    """
    content = read_g2o(file)
    pose_graph = pose_graph_of(content, file)
    before = {name: pose_graph.chi2(name) for name in CONVENTIONS}
    options = OptimizationOptions(convention=convention, max_iterations=max_iterations)
    found: RobustResult | None = None
    try:
        if robust:
            sequence = np.argsort(np.argsort(content.ids))
            found = optimize_robustly(pose_graph, options, sequence=sequence)
            result = found.optimization
        else:
            result = pose_graph.optimize(options)
    except PoseGraphError as error:
        raise click.UsageError(f"{file}: {error} (nodes and edges counted from 0 in the file's order)") from error
    after = {name: pose_graph.chi2(name) for name in CONVENTIONS}
    if out is not None:
        try:
            kept = content if found is None else with_edges(content, found.accepted)
            out.write_text(format_g2o(replace(kept, poses=pose_graph.poses)), encoding="utf-8")
        except OSError as error:
            raise click.UsageError(f"{out}: cannot be written ({error.strerror})") from error
    if as_json:
        figures: dict[str, object] = {
            "file": str(file),
            "out": None if out is None else str(out),
            "dimension": content.dim,
            "nodes": pose_graph.node_count,
            "edges": pose_graph.edge_count,
            "convention": convention,
            "chi2_before": before,
            "chi2_after": after,
            "iterations": result.iterations,
            "converged": result.converged,
            "seconds": result.seconds,
        }
        if found is not None:
            figures |= _robust_figures(content, found)
        click.echo(json.dumps(figures))
    else:
        _print_table(pose_graph, convention, before, after, result)
        if found is not None:
            _print_rejected(content, found)
    if not result.converged:
        raise click.ClickException(
            f"{file}: not converged after {result.iterations} iterations; raise --max-iterations or start nearer"
        )


def with_edges(content: G2oGraph, chosen: NDArray[np.bool_]) -> G2oGraph:
    """The graph with all its nodes, and only the chosen edges, shape (m,)."""
    return replace(
        content,
        i=content.i[chosen],
        j=content.j[chosen],
        measurements=content.measurements[chosen],
        information=content.information[chosen],
    )


def _rejected(content: G2oGraph, found: RobustResult) -> list[list[int]]:
    """Numbers in the file of the nodes (i, j) of the rejected edges, in the file's order."""
    out = ~found.accepted
    i, j = content.ids[content.i[out]].tolist(), content.ids[content.j[out]].tolist()
    return [[a, b] for a, b in zip(i, j, strict=True)]


def _robust_figures(content: G2oGraph, found: RobustResult) -> dict[str, object]:
    loops = ~found.odometry
    return {
        "robust": True,
        "odometry_edges": int(found.odometry.sum()),
        "loops": int(loops.sum()),
        "accepted_loops": int((found.accepted & loops).sum()),
        "rejected_loops": int((~found.accepted).sum()),
        "rejected": _rejected(content, found),
        "rejected_edges": np.flatnonzero(~found.accepted).tolist(),
        "noise": found.noise,
        "error_ratio": found.error_ratio,
        "iterations": found.iterations,
        "seconds": found.seconds,
    }


def _print_rejected(content: G2oGraph, found: RobustResult) -> None:
    rejected = _rejected(content, found)
    shown = ", ".join(f"{i} - {j}" for i, j in rejected[:_SHOWN]) + (", ..." if len(rejected) > _SHOWN else "")
    Console().print(
        f"{len(rejected)} of {int((~found.odometry).sum())} loops rejected{': ' if rejected else ''}{shown}\n"
        f"largest error left {found.error_ratio:.2f} sigma, {found.seconds:.1f} s in all",
        highlight=False,
    )


def _print_table(
    pose_graph: PoseGraph,
    convention: Convention,
    before: dict[Convention, float],
    after: dict[Convention, float],
    result: OptimizationResult,
) -> None:
    table = Table(title=f"{pose_graph.node_count} poses, {pose_graph.edge_count} edges, {pose_graph.dim}D")
    table.add_column("chi2")
    table.add_column("before", justify="right")
    table.add_column("after", justify="right")
    for name in CONVENTIONS:
        minimised = ", minimised" if name == convention else ""
        table.add_row(_MEANING[name] + minimised, f"{before[name]:.9g}", f"{after[name]:.9g}")
    console = Console()
    console.print(table)
    console.print(f"{result.iterations} iterations, {result.seconds * 1e3:.1f} ms", highlight=False)
