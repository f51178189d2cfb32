"""Measurements from another board over Zenoh: the messages of `raw/<device>`, sent by a daemon in role `drivers`."""

from __future__ import annotations

import logging
import queue
import struct
import time
from collections.abc import Sequence
from dataclasses import replace

from drivers import measurement_messages
from drivers.counters import Counters
from drivers.device import SILENT_NS, DeviceState, DeviceStatus
from drivers.measurement import HallFrame, Measurement
from robominer_slam.publishing.bus_messages import Received
from robominer_slam.publishing.keys import cdr
from robominer_slam.publishing.zenoh_session import ZenohBus
from robominer_slam.wall_clock import WallClock

log = logging.getLogger(__name__)

QUEUE_LENGTH = 2048
#: What a WhiskerArray has no field for: the time between two sensors' readings, us.
SENSOR_PERIOD = struct.Struct("<I")


def publish_raw(bus: ZenohBus, clock: WallClock, device: str, measurement: Measurement) -> None:
    """Send a measurement of a device, stamped in this board's UNIX time."""
    stamped = replace(measurement, stamp_ns=clock.unix_ns(measurement.stamp_ns))
    attachment = None
    if isinstance(measurement, HallFrame):
        attachment = SENSOR_PERIOD.pack(measurement.sensor_period_ns // 1000)
    for _, typename, payload in measurement_messages.encode(stamped):
        bus.put(f"raw/{device}", payload, cdr(typename), attachment=attachment)


class ZenohSource:
    """Subscribes to `raw/*`. The boards' clocks are taken to agree: they need to be synchronised (chrony).

    Attributes:
        dropped: measurements lost because nobody took them in time.
    """

    def __init__(self, bus: ZenohBus, clock: WallClock) -> None:
        self._bus = bus
        self._clock = clock
        # Written in C, so a fifth of `queue.Queue`; `_take` keeps the bound.
        self._queue: queue.SimpleQueue[tuple[str, Measurement]] = queue.SimpleQueue()
        self._counters: dict[str, Counters] = {}
        self._heard_ns: dict[str, int] = {}
        self.dropped = 0

    def __enter__(self) -> ZenohSource:
        self._bus.subscriber("raw/*", self._take)
        return self

    def __exit__(self, *_: object) -> None:
        """The bus takes its subscribers back itself."""

    def get(self, timeout: float) -> tuple[str, Measurement] | None:
        """The next (device, measurement), or None after `timeout` seconds."""
        try:
            return self._queue.get(timeout=timeout)
        except queue.Empty:
            return None

    def status(self) -> Sequence[DeviceStatus]:
        """The remote devices that have been heard, with the counts of what came."""
        return [self._status(name, counters) for name, counters in sorted(self._counters.items())]

    def _status(self, name: str, counters: Counters) -> DeviceStatus:
        silent = time.monotonic_ns() - self._heard_ns[name] > SILENT_NS
        state: DeviceState = "silent" if silent else "streaming"
        fault = "nothing comes from its board" if silent else ""
        return DeviceStatus(name, state, f"raw/{name}", "", dict(counters), 0, 0, 0.0, fault)

    def _take(self, received: Received) -> None:
        device = received.key.removeprefix("raw/")
        self._heard_ns[device] = time.monotonic_ns()
        counters = self._counters.setdefault(device, Counters())
        period_ns = 0
        if received.attachment is not None and len(received.attachment) == SENSOR_PERIOD.size:
            period_ns = SENSOR_PERIOD.unpack(received.attachment)[0] * 1000
        measurement = measurement_messages.decode(
            received.payload, received.schema, counters, sensor_period_ns=period_ns
        )
        if measurement is None:
            return
        local = replace(measurement, stamp_ns=measurement.stamp_ns - self._clock.offset_ns)
        if self._queue.qsize() >= QUEUE_LENGTH:
            self.dropped += 1
        else:
            self._queue.put((device, local))
