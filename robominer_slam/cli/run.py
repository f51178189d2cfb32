"""`robominer-slam run`: the daemon."""

from __future__ import annotations

import contextlib
import signal
import threading
from pathlib import Path

import click

from robominer_slam.configuration.file import ConfigurationError, load, to_toml

FILE = click.Path(dir_okay=False, path_type=Path)


@click.command(epilog="Example: robominer-slam run --config /etc/robominer-slam/config.toml")
@click.option("--config", "config_file", type=FILE, required=True, help="Configuration file (TOML).")
@click.option("--print-config", is_flag=True, help="Print the effective configuration with units and reasons, and end.")
def run(config_file: Path, print_config: bool) -> None:
    """Run the daemon: devices in, Zenoh out, until SIGTERM or SIGINT."""
    configuration = load(config_file)
    if print_config:
        click.echo(to_toml(configuration), nl=False)
        return
    # Imported here so that a mistake in the configuration is reported at once, without the seconds that these take.
    from drivers.serial_reader import SerialReader
    from robominer_slam.configuration.array import calibrated_array
    from robominer_slam.configuration.devices import device_settings
    from robominer_slam.daemon import Daemon
    from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSettings
    from robominer_slam.store import MapStore

    if not configuration.device:
        raise ConfigurationError(f"{config_file}: no [[device]]; expected at least the one that carries the whiskers")
    array = calibrated_array(configuration, config_file.parent)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with contextlib.ExitStack() as stack:
        source = SerialReader(device_settings(configuration))
        settings = ZenohSettings(listen=configuration.zenoh.listen, connect=configuration.zenoh.connect)
        store_path = config_file.parent / configuration.store.path
        bus = stack.enter_context(ZenohBus(settings, f"robominer/{configuration.robot.id}"))
        store = stack.enter_context(MapStore(store_path, configuration.store.sync_s, configuration.robot.id, ""))
        stack.enter_context(source)
        Daemon(configuration, array, source, bus, store).run(stop)
