"""What a recording of raw sensors runs on: the daemon on this machine where it has the devices, else the devices."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from drivers.recording_writer import RecordingWriter
from drivers.serial_reader import SerialReader
from robominer_slam.configuration.devices import device_settings
from robominer_slam.configuration.file import ConfigurationError, load
from robominer_slam.configuration.model import Configuration
from robominer_slam.publishing.client_settings import client_settings
from robominer_slam.publishing.zenoh_session import ZenohBus, ZenohSetupError
from robominer_slam.recording.raw_recorder import RawRecorder, attachments
from robominer_slam.security.endpoints import is_tls
from robominer_slam.sources.zenoh_source import ZenohSource
from robominer_slam.wall_clock import WallClock

log = logging.getLogger(__name__)

#: A daemon on this machine answers at once, or is not there.
LOCAL_TIMEOUT_S = 1.0


class RawSession(NamedTuple):
    """A recorder and the file that it writes."""

    recorder: RawRecorder
    writer: RecordingWriter


@contextlib.contextmanager
def raw_recorder(config_file: Path, out: Path) -> Iterator[RawSession]:
    """Record the sensors of a configuration's robot.

    Raises:
        ConfigurationError and the other errors of a user's mistake, before anything is touched.
        RecordingError: the file cannot be created.
    """
    configuration = load(config_file)
    content = attachments(configuration, config_file)
    with contextlib.ExitStack() as stack:
        bus = _local_daemon(configuration)
        if bus is not None:
            stack.enter_context(bus)
        elif not configuration.device:
            raise ConfigurationError("device: missing, and no daemon runs here; expected a [[device]] for each port")
        reader = SerialReader(device_settings(configuration)) if bus is None else None
        writer = RecordingWriter(out, attachments=content)
        if reader is not None:
            log.info("recording %d devices", len(configuration.device))
            yield RawSession(RawRecorder(stack.enter_context(reader), writer), writer)
        elif bus is not None:
            log.info("recording what the daemon's devices measure")
            yield RawSession(RawRecorder(stack.enter_context(ZenohSource(bus, WallClock())), writer), writer)


def _local_daemon(configuration: Configuration) -> ZenohBus | None:
    """A client of the daemon of this configuration, if it runs on this machine."""
    for endpoint in configuration.zenoh.listen:
        if not is_tls(endpoint):
            with contextlib.suppress(ZenohSetupError):
                settings = client_settings(endpoint, None, LOCAL_TIMEOUT_S)
                return ZenohBus(settings, f"robominer/{configuration.robot.id}")
    return None
