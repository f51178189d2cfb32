"""One device: its decoder, its clock, its state; bytes with arrival time in, measurements out. No I/O here.

The reader thread (`serial_reader.py`) moves the bytes. States: `absent` -> `synchronising` (open, clock not known
yet) -> `streaming` <-> `silent` (open, nothing comes) -> `absent`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.clock import DeviceClock
from drivers.counters import Counters
from drivers.framed import FramedDecoder, count_not_finite, ping
from drivers.measurement import (
    FloatArray,
    HallFrame,
    ImuSample,
    Measurement,
    OdometrySample,
    ScrewAngles,
    ScrewSpeeds,
)
from drivers.readings import (
    EncoderReading,
    HallReading,
    HelloReading,
    ImuReading,
    MotorReading,
    OdometryReading,
    PongReading,
    Reading,
)
from drivers.settings import DeviceSettings

DeviceState = Literal["absent", "synchronising", "streaming", "silent"]

#: At first eight quick round trips, so that measurements are stamped 0.2 s after opening; then one a second.
FIRST_PINGS = 8
FIRST_PING_INTERVAL_NS = 25_000_000
PING_INTERVAL_NS = 1_000_000_000
#: A device that says nothing for this long is reported as silent.
SILENT_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """A device's state as published: see the attributes of `Device`."""

    name: str
    state: DeviceState
    path: str | None
    firmware: str
    counters: dict[str, int]
    clock_offset_ns: int
    clock_uncertainty_ns: int
    clock_drift: float
    fault: str


class Device:
    """Turns one port's bytes into measurements stamped in the host's monotonic time.

    Attributes:
        settings: from the configuration.
        state: see the module.
        fault: what is wrong now, in words; empty if nothing is.
        counters: of this device beyond its decoder's: `before_sync`, `not_finite`, `faults`.
    """

    def __init__(self, settings: DeviceSettings) -> None:
        self.settings = settings
        self.state: DeviceState = "absent"
        self.path: str | None = None
        self.fault = ""
        self.firmware = ""
        self.counters = Counters()
        self.clock = DeviceClock()
        self.decoder = FramedDecoder()
        self._pings: dict[int, int] = {}
        self._ping_count = 0
        self._next_ping_ns = 0
        self._last_heard_ns = 0
        self._ticks: tuple[int, ...] | None = None
        self._turned = np.zeros(4, dtype=np.int64)

    def opened(self, path: str, now_ns: int) -> None:
        """The port is open; the device may have restarted, so its clock is asked anew."""
        self.state = "synchronising"
        self.path = path
        self.fault = ""
        counted = self.decoder.counters
        self.decoder = FramedDecoder()
        self.decoder.counters = counted
        self.clock.reset()
        self._pings.clear()
        self._ping_count = 0
        self._next_ping_ns = now_ns
        self._last_heard_ns = now_ns
        # A device that restarted counts from zero again: the angle goes on from where it was.
        self._ticks = None

    def lost(self, fault: str) -> None:
        """The port is gone or never was there."""
        self.state = "absent"
        self.path = None
        self.fault = fault
        self.counters["faults"] += 1

    def to_send(self, now_ns: int) -> bytes:
        """What to write to the port now: a PING when one is due."""
        if self.state == "absent" or now_ns < self._next_ping_ns:
            return b""
        quick = self._ping_count < FIRST_PINGS or not self.clock.synchronised
        self._next_ping_ns = now_ns + (FIRST_PING_INTERVAL_NS if quick else PING_INTERVAL_NS)
        nonce = self._ping_count & 0xFFFFFFFF
        self._ping_count += 1
        # Answers that never came must not pile up.
        while len(self._pings) >= 16:
            del self._pings[next(iter(self._pings))]
        self._pings[nonce] = now_ns
        return ping(nonce, nonce)

    def check_silence(self, now_ns: int) -> None:
        """Report a device that is open but says nothing."""
        if self.state == "streaming" and now_ns - self._last_heard_ns > SILENT_NS:
            self.state = "silent"
            self.fault = "open, but nothing comes"

    def received(self, data: bytes, arrival_ns: int) -> list[Measurement]:
        """Bytes that arrived at `arrival_ns`; returns the measurements that they complete."""
        measurements: list[Measurement] = []
        for reading in self.decoder.feed(data):
            match reading:
                case PongReading():
                    sent_ns = self._pings.pop(reading.nonce, None)
                    if sent_ns is None:
                        self.counters["unasked_pongs"] += 1
                    else:
                        self.clock.add_round_trip(sent_ns, arrival_ns, reading.device_time_us)
                case HelloReading():
                    self.firmware = reading.text
                case _:
                    measurement = self._measurement(reading)
                    if measurement is not None:
                        measurements.append(measurement)
                        self._last_heard_ns = arrival_ns
                        if self.state != "streaming":
                            self.state = "streaming"
                            self.fault = ""
        return measurements

    def _measurement(self, reading: Reading) -> Measurement | None:
        if count_not_finite(reading):
            self.counters["not_finite"] += 1
            return None
        if not self.clock.synchronised or reading.device_time_us is None:
            self.counters["before_sync"] += 1
            return None
        stamp = self.clock.to_host_ns(reading.device_time_us)
        match reading:
            case HallReading():
                return HallFrame(stamp, reading.field_mT, reading.valid, reading.sensor_period_us * 1000)
            case ImuReading():
                return ImuSample(stamp, reading.gyro, reading.acceleration, reading.orientation_xyzw)
            case EncoderReading():
                return ScrewAngles(stamp, self._unwrap(reading.ticks))
            case MotorReading():
                return ScrewSpeeds(stamp, reading.speed, reading.current_mA, reading.voltage_V)
            case OdometryReading():
                return OdometrySample(stamp, reading.velocity)
            case _:
                return None

    def _unwrap(self, ticks: tuple[int, ...]) -> FloatArray:
        if self._ticks is not None:
            step = (np.array(ticks, dtype=np.int64) - np.array(self._ticks, dtype=np.int64)) & 0xFFFFFFFF
            self._turned += np.where(step >= 1 << 31, step - (1 << 32), step)
        self._ticks = ticks
        return self._turned.astype(np.float64) * (2.0 * np.pi / self.settings.ticks_per_turn)

    def status(self) -> DeviceStatus:
        """A copy of what status publishes."""
        return DeviceStatus(
            name=self.settings.name,
            state=self.state,
            path=self.path,
            firmware=self.firmware,
            counters={**self.decoder.counters, **self.counters},
            clock_offset_ns=self.clock.offset_ns,
            clock_uncertainty_ns=self.clock.uncertainty_ns,
            clock_drift=self.clock.drift,
            fault=self.fault,
        )
