"""One device: its decoder, its clock, its state; bytes with arrival time in, measurements out. No I/O here.

The reader thread (`serial_reader.py`) moves the bytes. States: `absent` -> `synchronising` (open, clock not known
yet) -> `streaming` <-> `silent` (open, nothing comes) -> `absent`. Where the port is not certain, `probing` comes
first: it is listened to. A silent USB device is `resetting` from time to time.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.counters import Counters
from drivers.decoders import make_decoder
from drivers.device_time import AskedTime, device_time
from drivers.measurement import (
    SCREW_NAMES,
    FloatArray,
    HallFrame,
    ImuSample,
    Measurement,
    OdometrySample,
    ScrewAngles,
    ScrewSpeeds,
)
from drivers.port_probe import kind_of
from drivers.readings import (
    Decoder,
    EncoderReading,
    HallReading,
    HelloReading,
    ImuReading,
    MotorReading,
    OdometryReading,
    Reading,
    ScrewReading,
    count_not_finite,
)
from drivers.settings import DeviceSettings

DeviceState = Literal["absent", "probing", "synchronising", "streaming", "silent", "resetting"]

#: A device that says nothing for this long is reported as silent.
SILENT_NS = 1_000_000_000
#: Encoders count modulo 2^32.
WRAP, HALF_WRAP = 0xFFFFFFFF, 0x80000000


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
        counters: of this device beyond its decoder's: `before_sync`, `not_finite`, `faults`, `other_screw`.
    """

    def __init__(self, settings: DeviceSettings) -> None:
        self.settings = settings
        self.state: DeviceState = "absent"
        self.path: str | None = None
        self.fault = ""
        self.firmware = ""
        self.counters = Counters()
        self.decoder = self._new_decoder()
        self.time = device_time(settings, self.counters)
        #: Readings by kind since the port was opened.
        self.heard: Counter[str] = Counter()
        self._last_heard_ns = 0
        self._ticks: tuple[int, ...] | None = None
        self._turned = [0] * 4

    def _new_decoder(self) -> Decoder:
        one = self.settings
        return make_decoder(one.protocol, one.rows, one.cols, one.representation)

    def opened(self, path: str, now_ns: int, byte_ns: int = 0) -> None:
        """The port is open; the device may have restarted, so its clock is learned anew.

        Args:
            path: of the port.
            now_ns: host's monotonic time.
            byte_ns: time that a byte takes on the line; 0 where it is not a real serial line.
        """
        self.state = "synchronising"
        self.path = path
        self.fault = ""
        counted = self.decoder.counters
        self.decoder = self._new_decoder()
        self.decoder.counters = counted
        self.time.opened(self.decoder, now_ns, byte_ns)
        self._last_heard_ns = now_ns
        self.heard.clear()
        # A device that restarted counts from zero again: the angle goes on from where it was.
        self._ticks = None

    def lost(self, fault: str) -> None:
        """The port is gone or never was there."""
        self.state = "absent"
        self.path = None
        self.fault = fault
        self.counters["faults"] += 1

    def to_send(self, now_ns: int) -> bytes:
        """What to write to the port now: what the protocol needs for time, or to start the device."""
        return b"" if self.state == "absent" else self.time.to_send(now_ns)

    @property
    def due_ns(self) -> int | None:
        """When there is something to send to the nanosecond; None where it does not matter."""
        if isinstance(self.time, AskedTime) and self.state not in ("absent", "probing"):
            return self.time.due_ns
        return None

    def check_silence(self, now_ns: int) -> None:
        """Report a device that is open but says nothing."""
        if self.state in ("synchronising", "streaming") and now_ns - self._last_heard_ns > SILENT_NS:
            self.state = "silent"
            self.fault = "open, but nothing comes"

    def received(self, data: bytes, arrival_ns: int) -> list[Measurement]:
        """Bytes that arrived at `arrival_ns`; returns the measurements that they complete."""
        measurements: list[Measurement] = []
        for reading in self.decoder.feed(data):
            if isinstance(reading, HelloReading):
                self.firmware = reading.text
                continue
            kind = kind_of(reading)
            if kind is not None:
                self.heard[kind] += 1
            if self.time.take(reading, arrival_ns):
                continue
            measurement = self._measurement(reading)
            if measurement is not None:
                measurements.append(measurement)
                self._last_heard_ns = arrival_ns
                if self.state not in ("streaming", "probing"):
                    self.state = "streaming"
                    self.fault = ""
        return measurements

    def _measurement(self, reading: Reading) -> Measurement | None:
        if count_not_finite(reading):
            self.counters["not_finite"] += 1
            return None
        stamp = self.time.stamp_ns(reading)
        if stamp is None:
            self.counters["before_sync"] += 1
            return None
        match reading:
            case HallReading():
                period = self.time.sensor_period_ns(reading)
                return HallFrame(stamp, reading.field_mT, reading.valid, period, reading.representation)
            case ImuReading():
                orientation = reading.orientation_xyzw if self.settings.use_orientation else None
                return ImuSample(stamp, reading.gyro, reading.acceleration, orientation)
            case EncoderReading():
                return ScrewAngles(stamp, self._unwrap(reading.ticks))
            case MotorReading():
                return ScrewSpeeds(stamp, reading.speed, reading.current_mA, reading.voltage_V)
            case ScrewReading():
                return self._screw_speed(stamp, reading)
            case OdometryReading():
                return OdometrySample(stamp, reading.velocity)
            case _:
                return None

    def _screw_speed(self, stamp: int, reading: ScrewReading) -> ScrewSpeeds | None:
        expected = self.settings.screw
        if expected is not None and SCREW_NAMES[reading.screw] != expected:
            self.counters["other_screw"] += 1
            self.fault = f"expected the board of screw {expected}, found that of {SCREW_NAMES[reading.screw]}"
            return None
        speed = np.full(4, np.nan)
        speed[reading.screw] = reading.speed
        if reading.current_mA is None or reading.voltage_V is None:
            return ScrewSpeeds(stamp, speed)
        current, voltage = np.full(4, np.nan), np.full(4, np.nan)
        current[reading.screw], voltage[reading.screw] = reading.current_mA, reading.voltage_V
        return ScrewSpeeds(stamp, speed, current, voltage)

    def _unwrap(self, ticks: tuple[int, ...]) -> FloatArray:
        if self._ticks is not None:
            for screw, (now, before) in enumerate(zip(ticks, self._ticks, strict=True)):
                self._turned[screw] += ((now - before + HALF_WRAP) & WRAP) - HALF_WRAP
        self._ticks = ticks
        per_tick = 2.0 * math.pi / self.settings.ticks_per_turn
        return np.array([turned * per_tick for turned in self._turned])

    def status(self) -> DeviceStatus:
        """A copy of what status publishes."""
        return DeviceStatus(
            name=self.settings.name,
            state=self.state,
            path=self.path,
            firmware=self.firmware,
            counters={**self.decoder.counters, **self.counters},
            clock_offset_ns=self.time.offset_ns,
            clock_uncertainty_ns=self.time.uncertainty_ns,
            clock_drift=self.time.drift,
            fault=self.fault,
        )
