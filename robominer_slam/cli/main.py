"""`robominer-slam`: finds its subcommands, and turns users' mistakes into one line and exit code 2."""

from __future__ import annotations

import importlib
import logging
import sys
from importlib.metadata import entry_points

import click

from calibration.capture_labels import CaptureError
from calibration.file_format import CalibrationFileError
from calibration.fit import FitError
from drivers.port_discovery import PortNameError
from drivers.recording_reader import RecordingError
from robominer_slam import __version__
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.evaluation.run_record import ResultsError
from robominer_slam.evaluation.trajectory import TrajectoryError
from robominer_slam.journal import stderr_is_journal
from robominer_slam.layout import LayoutError
from robominer_slam.publishing.zenoh_session import ZenohSetupError
from robominer_slam.security.errors import KeysError
from robominer_slam.store_database import StoreError

#: Errors that are the user's to mend; anything else is ours and shows a traceback.
USER_ERRORS = (
    CalibrationFileError,
    CaptureError,
    ConfigurationError,
    FitError,
    KeysError,
    LayoutError,
    PortNameError,
    RecordingError,
    ResultsError,
    StoreError,
    TrajectoryError,
    ZenohSetupError,
)

#: Imported only when called, so that `--help` and the daemon load no more than they need.
COMMANDS = {
    "calibrate": "robominer_slam.cli.calibrate:calibrate",
    "decode": "robominer_slam.cli.decode:decode",
    "doctor": "robominer_slam.cli.doctor:doctor",
    "evaluate": "robominer_slam.cli.evaluate:evaluate",
    "graph": "robominer_slam.cli.graph:graph",
    "keys": "robominer_slam.cli.keys:keys",
    "map": "robominer_slam.cli.map:map_group",
    "operator": "robominer_slam.cli.operator:operator",
    "record": "robominer_slam.cli.record:record",
    "replay": "robominer_slam.cli.replay:replay",
    "run": "robominer_slam.cli.run:run",
    "status": "robominer_slam.cli.status:status",
}
ENTRY_POINT_GROUP = "robominer_slam.commands"
#: Modules that a robot need not have, by the extra that brings them.
EXTRAS = {
    "cryptography": "keys",
    "foxglove": "operator",
    "magpylib": "sim",
    "matplotlib": "operator",
    "mujoco": "sim",
    "nicegui": "operator",
}


class _Commands(click.Group):
    """Our own subcommands and those that other packages register by entry point."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(
            [*super().list_commands(ctx), *COMMANDS, *(point.name for point in entry_points(group=ENTRY_POINT_GROUP))]
        )

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name in COMMANDS:
            module, attribute = COMMANDS[name].split(":")
            command: click.Command = getattr(importlib.import_module(module), attribute)
            return command
        for point in entry_points(group=ENTRY_POINT_GROUP, name=name):
            loaded: click.Command = point.load()
            return loaded
        return super().get_command(ctx, name)


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: robominer-slam run --config /etc/robominer-slam/config.toml",
)
@click.version_option(__version__, prog_name="robominer-slam")
@click.option("-v", "--verbose", count=True, help="More of what happens, on stderr.")
def cli(verbose: int) -> None:
    """Blind SLAM for a mining robot: whisker touches in, pose and map out."""
    level = [logging.INFO, logging.DEBUG][min(verbose, 1)]
    logging.basicConfig(level=level, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")


def main() -> None:
    """Entry point of the program."""
    try:
        # Where it does not end the program itself, click gives back what a command exits with.
        status = cli.main(standalone_mode=False)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except click.Abort:
        sys.exit(130)
    except ModuleNotFoundError as error:
        extra = EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        needs = f"{error.name}, which is not installed: pip install 'robominer-slam[{extra}]'"
        click.echo(f"error: this needs {needs}", err=True)
        sys.exit(2)
    except USER_ERRORS as error:
        # In the journal a line's level is a prefix; there is no log yet.
        prefix = "<3>" if stderr_is_journal() else ""
        for line in str(error).splitlines():
            click.echo(f"{prefix}error: {line}", err=True)
        sys.exit(2)
    if status:
        sys.exit(status)
