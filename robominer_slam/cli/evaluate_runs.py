"""`robominer-slam evaluate run` and `evaluate report`: many replays, one table, one page."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from robominer_slam.cli.evaluation_output import print_campaign, print_table, run_with_progress, write_report
from robominer_slam.cli.number_list import number_list
from robominer_slam.configuration.overrides import parse_override, parse_variant
from robominer_slam.evaluation.acceptance import acceptance_table
from robominer_slam.evaluation.campaign import plan
from robominer_slam.evaluation.results_file import read_results
from robominer_slam.evaluation.run_record import ResultsError

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
REPORT = click.option("--report", type=click.Path(dir_okay=False, path_type=Path), help="HTML page to write.")
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Print table and runs as JSON.")


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _seeds(_context: click.Context, _parameter: click.Parameter, text: str | None) -> list[int] | None:
    try:
        return None if text is None else number_list(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


@click.command(
    epilog="Example: robominer-slam evaluate run drive*.mcap --methods none,thesis --out out/evaluation "
    "--report out/evaluation.html"
)
@click.argument("recordings", type=FILE, nargs=-1, required=True)
@click.option("--methods", default="none,thesis", show_default=True, help="Of SLAM, as slam.method has them.")
@click.option("--sources", default="fused", show_default=True, help="Of odometry: fused, odometry or both.")
@click.option("--odometry-seeds", callback=_seeds, help="Only recordings with these odometry noises, as 0-9.")
@click.option("--set", "common", multiple=True, metavar="KEY=VALUE", help="A key of the configuration for all runs.")
@click.option("--variant", "variants", multiple=True, metavar="LABEL:KEY=VALUE,...",
              help="Run with these keys too, beside the configuration as it is.")  # fmt: skip
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True,
              help="Folder of the results; runs that are there from before are not run again.")  # fmt: skip
@click.option("--jobs", type=click.IntRange(1, 256), default=1, show_default=True, help="Processes side by side.")
@REPORT
@AS_JSON
def run(
    recordings: tuple[Path, ...],
    methods: str,
    sources: str,
    odometry_seeds: list[int] | None,
    common: tuple[str, ...],
    variants: tuple[str, ...],
    out: Path,
    jobs: int,
    report: Path | None,
    as_json: bool,
) -> None:
    """Replay RECORDINGS with every method and compare with their ground truth.

    Recordings that differ in the ready-made odometry's noise: `robominer-slam simulate --from FILE --odometry-seed N
    --out FILE_N`.
    """
    tasks = plan(
        recordings,
        _names(methods),
        _names(sources),
        [parse_variant(text) for text in variants],
        [parse_override(text) for text in common],
        odometry_seeds,
    )
    if not tasks:
        raise ResultsError("nothing to run: no recording has one of these odometry noises")
    campaign = run_with_progress(tasks, out, jobs)
    if report is not None and campaign.records:
        write_report(report, campaign.records, campaign.files)
    print_campaign(campaign, out, as_json)
    if campaign.failures:
        sys.exit(1)


@click.command(epilog="Example: robominer-slam evaluate report out/*/results.json --report page.html")
@click.argument("results", type=FILE, nargs=-1, required=True)
@REPORT
@AS_JSON
def report(results: tuple[Path, ...], report: Path | None, as_json: bool) -> None:
    """Table and page of saved RESULTS; several are taken together."""
    records, files = read_results(results)
    if report is not None:
        write_report(report, records, files)
    if as_json:
        table = [row.as_dict() for row in acceptance_table(records)]
        click.echo(json.dumps({"table": table, "runs": [record.as_dict() for record in records]}))
    else:
        print_table(records)
