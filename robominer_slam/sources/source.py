"""What the wiring needs of a source of measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from drivers.device import DeviceStatus
from drivers.measurement import Measurement


class MeasurementSource(Protocol):
    """Delivers measurements stamped in the host's monotonic time; `drivers.serial_reader.SerialReader` is one.

    Attributes:
        dropped: measurements lost because nobody took them in time.
    """

    dropped: int

    def get(self, timeout: float) -> tuple[str, Measurement] | None:
        """The next (device, measurement), or None after `timeout` seconds."""
        ...

    def status(self) -> Sequence[DeviceStatus]:
        """The devices' states and counters."""
        ...

    def __enter__(self) -> MeasurementSource:
        """Start."""
        ...

    def __exit__(self, *_: object) -> None:
        """Stop."""
        ...
