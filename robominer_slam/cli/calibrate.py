"""`robominer-slam calibrate`: the group of the calibration's tools; each is in a file of its own."""

from __future__ import annotations

import importlib

import click

#: Imported only when called.
COMMANDS = {
    "angles": "robominer_slam.cli.calibrate_fit:angles",
    "capture": "robominer_slam.cli.calibrate_capture:capture",
    "check": "robominer_slam.cli.calibrate_check:check",
    "convert": "robominer_slam.cli.calibrate_convert:convert",
    "fit": "robominer_slam.cli.calibrate_fit:fit",
    "report": "robominer_slam.cli.calibrate_report:report",
    "stiffness": "robominer_slam.cli.calibrate_stiffness:stiffness",
    "wizard": "robominer_slam.cli.calibrate_wizard:wizard",
}


class _Tools(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted([*super().list_commands(ctx), *COMMANDS])

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return super().get_command(ctx, name)
        module, attribute = COMMANDS[name].split(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command


@click.group(
    cls=_Tools,
    epilog="Example: robominer-slam calibrate capture --config config.toml --method jig --out array-07.mcap",
)
def calibrate() -> None:
    """From magnetic vectors to angles: capture, fit, check and report the calibration of a whisker array."""
