"""Records raw sensors as MCAP, with layout, calibration and configuration: what `replay` runs on."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from drivers.device import DeviceStatus
from drivers.recording_writer import RecordingWriter
from robominer_slam import layout as layouts
from robominer_slam.configuration.array import calibration_path, load_layout, read_calibration
from robominer_slam.configuration.model import Configuration
from robominer_slam.replay import CALIBRATION, CONFIGURATION, LAYOUT
from robominer_slam.sources.source import MeasurementSource

log = logging.getLogger(__name__)


def attachments(configuration: Configuration, config_file: Path) -> dict[str, bytes]:
    """What a replay needs beside the sensors.

    Raises:
        ConfigurationError, LayoutError, CalibrationFileError: files that it names and that cannot be used.
    """
    folder = config_file.parent
    layout = load_layout(configuration.robot.layout, folder)
    found = {CONFIGURATION: config_file.read_bytes(), LAYOUT: layouts.to_json(layout).encode()}
    calibration = calibration_path(configuration, folder)
    if calibration is None:
        log.warning("no [[device]] names a calibration: a replay will need --config with one")
    else:
        read_calibration(calibration, layout)
        found[CALIBRATION] = calibration.read_bytes()
    return found


class RawRecorder:
    """Writes what a source of measurements delivers."""

    def __init__(self, source: MeasurementSource, writer: RecordingWriter) -> None:
        self._source = source
        self._writer = writer
        # One for the whole recording: a step of the wall clock must not tear it.
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    @property
    def dropped(self) -> int:
        """Measurements that came faster than the disk took them."""
        return self._source.dropped

    def step(self, timeout_s: float) -> None:
        """Write the next measurement, waiting at most so long for it.

        Raises:
            RecordingError: the file cannot be written.
        """
        item = self._source.get(timeout_s)
        if item is not None:
            measurement = item[1]
            self._writer.write_measurement(replace(measurement, stamp_ns=measurement.stamp_ns + self._offset_ns))

    def tend(self) -> None:
        """About once a second: hand all to the system.

        Raises:
            RecordingError: the file cannot be written.
        """
        self._writer.flush()

    def finish(self) -> None:
        """Write what was already delivered; not for long, as more comes all the time."""
        end = time.monotonic() + 1.0
        while time.monotonic() < end and (item := self._source.get(0.0)) is not None:
            measurement = item[1]
            self._writer.write_measurement(replace(measurement, stamp_ns=measurement.stamp_ns + self._offset_ns))

    def faults(self) -> Sequence[DeviceStatus]:
        """Devices of which nothing comes."""
        return [device for device in self._source.status() if device.state != "streaming"]
