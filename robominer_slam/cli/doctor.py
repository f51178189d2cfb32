"""`robominer-slam doctor`: what is wrong, and the command that mends it."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from robominer_slam.doctor.finding import Finding

COLOURS = {"ok": "green", "warning": "yellow", "error": "red"}


@click.command(epilog="Example: robominer-slam doctor --connect tls/robot.local:7448 --credentials alice")
@click.option("--config", type=click.Path(dir_okay=False, path_type=Path), help="Configuration file of the daemon.")
@click.option("--connect", help="Endpoint of a running daemon: tls/HOST:PORT or tcp/HOST:PORT.")
@click.option(
    "--credentials", type=click.Path(file_okay=False, path_type=Path), help="Folder with a bundle from `keys issue`."
)
@click.option("--robot", default="rm3", show_default=True, help="The robot's id.")
@click.option("--timeout", default=5.0, show_default=True, help="How long to wait at each step, s.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def doctor(
    config: Path | None, connect: str | None, credentials: Path | None, robot: str, timeout: float, as_json: bool
) -> None:
    """What is wrong with configuration, devices, board, keys and connection. Exits 0 when content, 1 when not."""
    if config is None and connect is None and credentials is None:
        raise click.UsageError("nothing to look at: give --config, --credentials or --connect")
    findings = _findings(config, connect, credentials, robot, timeout)
    if as_json:
        click.echo(json.dumps([finding._asdict() for finding in findings]))
    else:
        _print(findings)
    if any(finding.level == "error" for finding in findings):
        raise click.exceptions.Exit(1)


def _findings(
    config: Path | None, connect: str | None, credentials: Path | None, robot: str, timeout: float
) -> list[Finding]:
    # Imported here so that `--help` loads none of it.
    from robominer_slam.doctor.configuration_checks import check_configuration
    from robominer_slam.doctor.credentials_checks import check_credentials

    findings: list[Finding] = []
    if config is not None:
        findings += check_configuration(config)
    if credentials is not None:
        findings += check_credentials(credentials, robot=False)
    if connect is not None:
        from robominer_slam.doctor.link_checks import check_link

        findings += check_link(connect, credentials, f"robominer/{robot}", timeout)
    return findings


def _print(findings: list[Finding]) -> None:
    table = Table()
    for column in ("check", "level", "says", "mend"):
        table.add_column(column, overflow="fold")
    for finding in findings:
        level = f"[{COLOURS[finding.level]}]{finding.level}[/]"
        table.add_row(finding.check, level, escape(finding.message), escape(finding.mend))
    Console().print(table)
