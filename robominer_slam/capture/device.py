"""Frames of the whisker array from its device, live; each is recorded as it comes."""

from __future__ import annotations

import time
from pathlib import Path
from types import TracebackType

from calibration.capture_labels import CaptureError
from drivers.measurement import HallFrame
from drivers.recording_writer import RecordingWriter
from drivers.serial_reader import SerialReader
from drivers.spherical import cartesian_frame
from robominer_slam.configuration.devices import device_settings
from robominer_slam.configuration.file import load
from robominer_slam.configuration.model import Configuration

#: A device that says nothing for so long is not there: it may be opening and learning its clock before.
SILENCE_S = 6.0


class WhiskerDevice:
    """The device that carries the whiskers; use as a context manager.

    Attributes:
        writer: where the raw frames go; None for nowhere.
        failure_s: silence that is a fault, s.
    """

    def __init__(
        self,
        configuration: Configuration,
        rows: int,
        cols: int,
        *,
        device: str | None = None,
        writer: RecordingWriter | None = None,
    ) -> None:
        """Take the configured devices, or one of them, and use the frames of the array that come.

        Raises:
            CaptureError: no such device, or none configured.
        """
        settings = [one for one in device_settings(configuration) if device in (None, one.name)]
        if not settings:
            names = ", ".join(one.name for one in configuration.device) or "none"
            raise CaptureError(f"device {device or ''}: not in the configuration; there: {names}")
        self._reader = SerialReader(settings)
        self._shape = (rows, cols)
        self.writer = writer
        self.failure_s = SILENCE_S
        self._heard = time.monotonic()

    def __enter__(self) -> WhiskerDevice:
        self._reader.__enter__()
        self._heard = time.monotonic()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.__exit__(kind, error, trace)

    def frame(self, timeout: float) -> HallFrame | None:
        """The next frame in Cartesian form, or None after `timeout` seconds.

        Raises:
            CaptureError: the device is silent for too long, or its array has another size.
        """
        item = self._reader.get(timeout)
        if item is not None and isinstance(item[1], HallFrame):
            frame = item[1]
            if frame.valid.shape != self._shape:
                rows, cols = frame.valid.shape
                raise CaptureError(
                    f"device {item[0]}: its array is {rows} x {cols}, the layout's {self._shape[0]} x {self._shape[1]}"
                )
            self._heard = time.monotonic()
            if self.writer is not None:
                self.writer.write_measurement(frame)
            return cartesian_frame(frame)
        if time.monotonic() - self._heard > self.failure_s:
            states = "; ".join(f"{one.name} is {one.state} ({one.fault or one.path})" for one in self._reader.status())
            raise CaptureError(f"no whisker frame within {self.failure_s:g} s: {states}")
        return None


def load_configuration(path: Path) -> tuple[Configuration, Path]:
    """The configuration and the folder that its paths are relative to.

    Raises:
        ConfigurationError: as `configuration.file.load`.
    """
    return load(path), path.resolve().parent
