"""The robot's own devices, with what they measure on `raw/<device>` for as long as a recorder listens there."""

from __future__ import annotations

import time
from collections.abc import Sequence

from drivers.device import DeviceStatus
from drivers.measurement import Measurement
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.sources.source import MeasurementSource
from robominer_slam.sources.zenoh_source import publish_raw
from robominer_slam.wall_clock import WallClock

#: How often it is looked whether somebody listens, s: who does not record pays for nothing more.
LOOK_S = 0.5


class TappedSource:
    """A source of measurements that also publishes them where they are wanted.

    Attributes:
        dropped: measurements lost because nobody took them in time.
    """

    def __init__(self, source: MeasurementSource, bus: ZenohBus, clock: WallClock) -> None:
        self._source = source
        self._bus = bus
        self._clock = clock
        self._wanted: dict[str, bool] = {}
        self._look_s = 0.0
        self.dropped = 0

    def __enter__(self) -> TappedSource:
        self._source.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._source.__exit__(*error)

    def get(self, timeout: float) -> tuple[str, Measurement] | None:
        """The next (device, measurement), or None after `timeout` seconds."""
        item = self._source.get(timeout)
        self.dropped = self._source.dropped
        if item is not None and self._is_wanted(item[0]):
            publish_raw(self._bus, self._clock, *item)
        return item

    def status(self) -> Sequence[DeviceStatus]:
        """The devices' states and counters."""
        return self._source.status()

    def _is_wanted(self, device: str) -> bool:
        now = time.monotonic()
        if now >= self._look_s:
            self._look_s = now + LOOK_S
            self._wanted.clear()
        if device not in self._wanted:
            self._wanted[device] = self._bus.wanted(f"raw/{device}")
        return self._wanted[device]
