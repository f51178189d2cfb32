"""`robominer-slam run`: the daemon."""

from __future__ import annotations

import faulthandler
import logging
import signal
import threading
from pathlib import Path

import click

from robominer_slam.configuration.file import load, to_toml

FILE = click.Path(dir_okay=False, path_type=Path)


@click.command(epilog="Example: robominer-slam run --config /etc/robominer-slam/config.toml")
@click.option("--config", "config_file", type=FILE, required=True, help="Configuration file (TOML).")
@click.option("--print-config", is_flag=True, help="Print the effective configuration with units and reasons, and end.")
def run(config_file: Path, print_config: bool) -> None:
    """Run the daemon: devices in, Zenoh out, until SIGTERM or SIGINT; SIGHUP reads the configuration anew."""
    configuration = load(config_file)
    if print_config:
        click.echo(to_toml(configuration), nl=False)
        return
    # Imported here so that a mistake in the file is reported at once, without the seconds that the rest takes to load.
    from robominer_slam.configuration.reload import Reload
    from robominer_slam.log_output import LogOutput

    # The watchdog ends a daemon that hangs by SIGABRT: where each thread stood is then in the journal.
    faulthandler.enable()
    output = LogOutput(configuration.log, verbose=logging.getLogger().level == logging.DEBUG)
    reload = Reload(config_file, configuration, output.configure)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    signal.signal(signal.SIGHUP, lambda *_: reload.ask())

    from robominer_slam.service import serve

    serve(configuration, reload, stop)
