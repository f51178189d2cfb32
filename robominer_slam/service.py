"""Opens what the configured role needs (devices, network, store) and runs the daemon of that role."""

from __future__ import annotations

import contextlib
import gc
import logging
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from drivers.serial_reader import SerialReader
from robominer_slam.configuration.array import calibrated_array
from robominer_slam.configuration.devices import device_settings
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import Configuration
from robominer_slam.configuration.reload import Reload
from robominer_slam.daemon import Daemon
from robominer_slam.drivers_daemon import forward
from robominer_slam.heap import give_large_blocks_back
from robominer_slam.notify import Notifier
from robominer_slam.publishing.robot_settings import robot_settings
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.security.credentials import load_credentials
from robominer_slam.security.inspection import inspect
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.sources.source import MeasurementSource
from robominer_slam.sources.tapped_source import TappedSource
from robominer_slam.sources.zenoh_source import ZenohSource
from robominer_slam.store import MapStore
from robominer_slam.store_database import StoreError
from robominer_slam.store_reader import map_to_start_in
from robominer_slam.store_salvage import Salvage, check_and_salvage
from robominer_slam.supervision import Supervision
from robominer_slam.wall_clock import WallClock

log = logging.getLogger(__name__)


def serve(configuration: Configuration, reload: Reload, stop: threading.Event) -> None:
    """Run until `stop` is set.

    Args:
        configuration: the effective one.
        reload: reads it anew from where it came from; relative paths in it start there.
        stop: set by SIGTERM and SIGINT.

    Raises:
        ConfigurationError and the other errors of a user's mistake, before anything runs.
    """
    robot, config_file, folder = configuration.robot, reload.path, reload.path.parent
    if robot.role != "slam" and not configuration.device:
        raise ConfigurationError(f"{config_file}: device: missing; expected a [[device]] for each port")
    prefix = f"robominer/{robot.id}"
    settings = robot_settings(configuration.zenoh, folder, prefix)
    if configuration.zenoh.credentials is not None:
        _say_if_expired(folder / configuration.zenoh.credentials)
    with contextlib.ExitStack() as stack:
        notifier = stack.enter_context(contextlib.closing(Notifier()))
        supervision = Supervision(notifier, reload)
        if robot.role == "drivers":
            reader = SerialReader(device_settings(configuration))
            # The board with the SLAM is the one that ROS sees: all topics are its own.
            bus = stack.enter_context(ZenohBus(replace(settings, ros=None), prefix))
            forward(stack.enter_context(reader), bus, stop, supervision)
            return
        array = calibrated_array(configuration, folder)
        path = folder / configuration.store.path
        salvage = check_and_salvage(path)
        map_id, known = map_to_start_with(configuration, path, salvage)
        frozen = configuration.slam.start == "localize" and map_id is not None
        kept = configuration.store
        store = MapStore(
            path, kept.sync_s, robot.id, "", map_id, frozen, salvage, point_voxel=kept.point_voxel, max_mb=kept.max_mb
        )
        bus = stack.enter_context(ZenohBus(settings, prefix))
        stack.enter_context(store)
        source: MeasurementSource = (
            ZenohSource(bus, WallClock())
            if robot.role == "slam"
            else TappedSource(SerialReader(device_settings(configuration)), bus, WallClock())
        )
        stack.enter_context(source)
        daemon = Daemon(configuration, array, source, bus, store, supervision, known)
        keep_what_is_there()
        give_large_blocks_back()
        daemon.run(stop)


def keep_what_is_there() -> None:
    """Spare the garbage collector all that lives as long as the process.

    A full collection would stop the loop for as long as five frames take, every few minutes.
    """
    gc.collect()
    gc.freeze()


def map_to_start_with(
    configuration: Configuration, path: Path, salvage: Salvage
) -> tuple[int, SavedMap] | tuple[None, None]:
    """As `map_to_start_in`; where the database was damaged and the map is gone, a new one rather than no start.

    Raises:
        ConfigurationError and StoreError: mistakes of the user's.
    """
    if salvage.postponed:
        log.error("a new map begins in memory, since the stored ones cannot be read now")
        return None, None
    try:
        return map_to_start_in(configuration.slam, path, WallClock().offset_ns)
    except StoreError as error:
        if not salvage.reason:
            raise
        log.error("a new map begins, since the one to start in was not among what was salvaged: %s", error)
        return None, None


def _say_if_expired(credentials: Path) -> None:
    """An expired certificate keeps remote users out, but never the robot from working.

    Raises:
        KeysError: a certificate that does not belong to its key or its authority.
    """
    facts = inspect(load_credentials(credentials))
    if facts.ends <= datetime.now(UTC):
        log.error("the certificate of %s expired at %s: nobody can connect by TLS; run doctor", facts.name, facts.ends)
