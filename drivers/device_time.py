"""How a device's samples get host time, and what the host must send for that: one class for each kind of protocol.

`framed` is asked for its time (PING). The others only speak: their time is the lower envelope of arrival times, less
what a sample needs from its measurement to its arrival. `mip` is told to speak, again and again until it does.
"""

from __future__ import annotations

from typing import Protocol

from drivers.arrival_clock import DEVICE_TIME, SAMPLES, ArrivalClock, Counting
from drivers.bno08x_rvc import INDEX_MODULUS, SIZE
from drivers.clock import DeviceClock
from drivers.counters import Counters
from drivers.framed import ping
from drivers.mip import FORMATS, MESSAGE_FORMAT, MipDecoder, start_streaming
from drivers.readings import Decoder, HallReading, PongReading, Reading, ScrewReading
from drivers.rm3_values import values_per_sensor
from drivers.settings import DeviceSettings

#: At first eight quick round trips, so that measurements are stamped 0.2 s after opening; then one a second. Where a
#: busy machine made them all slow, more of them, for a few seconds.
FIRST_PINGS, MOST_FIRST_PINGS = 8, 200
SURE_ENOUGH_NS = 1_000_000
FIRST_PING_INTERVAL_NS = 25_000_000
PING_INTERVAL_NS = 1_000_000_000
#: Intervals vary by this share either way. A device whose loop looks at its port every 10 ms, after it has sent, would
#: answer regular pings with always the same delay, which no regression can see.
PING_SPREAD = 0.3
GOLDEN_RATIO = 0.6180339887
#: A device that was told to stream and does not is told again this often.
START_INTERVAL_NS = 1_000_000_000
#: BNO08X: 100 Hz from an oscillator without a crystal where none is fitted: a few per cent.
RVC_INDEX = Counting(10_000_000.0, 0.05, 500_000_000, INDEX_MODULUS)
#: Characters of a whisker's values in plain text, about: `[-123.45;12.34;56.78]`.
PLAINTEXT_CHARACTERS = 21


class DeviceTime(Protocol):
    """Stamps a device's readings."""

    @property
    def synchronised(self) -> bool:
        """Whether stamps are good."""

    @property
    def offset_ns(self) -> int:
        """Host time minus device time, ns."""

    @property
    def uncertainty_ns(self) -> int:
        """Bound of the stamps' error, ns; 0 where none is known."""

    @property
    def drift(self) -> float:
        """Rate error of the device's clock, dimensionless."""

    def opened(self, decoder: Decoder, now_ns: int, byte_ns: int) -> None:
        """The port is open; a byte takes `byte_ns` on the line."""

    def to_send(self, now_ns: int) -> bytes:
        """What to write to the port now."""

    def take(self, reading: Reading, arrival_ns: int) -> bool:
        """Learn from a reading; True where it was for the clock only."""

    def stamp_ns(self, reading: Reading) -> int | None:
        """Host time of the reading just taken; None where it cannot be said yet."""

    def sensor_period_ns(self, reading: HallReading) -> int:
        """Time from one sensor's reading to the next."""


class AskedTime:
    """Protocol `framed`: PING and PONG."""

    def __init__(self, counters: Counters) -> None:
        self.clock = DeviceClock()
        self._counters = counters
        self._pings: dict[int, int] = {}
        self._ping_count = 0
        self._next_ping_ns = 0

    @property
    def synchronised(self) -> bool:
        """Whether the device has answered."""
        return self.clock.synchronised

    @property
    def offset_ns(self) -> int:
        """Host time minus device time, ns."""
        return self.clock.offset_ns

    @property
    def uncertainty_ns(self) -> int:
        """Bound of the mapping, ns: the round trips' own bounds, in the mean that it takes of them."""
        return self.clock.uncertainty_ns

    @property
    def drift(self) -> float:
        """Rate error of the device's clock."""
        return self.clock.drift

    def opened(self, _decoder: Decoder, now_ns: int, _byte_ns: int) -> None:
        """The device may have restarted, so its clock is asked anew."""
        self.clock.reset()
        self._pings.clear()
        self._ping_count = 0
        self._next_ping_ns = now_ns

    @property
    def due_ns(self) -> int:
        """When the next PING is to be sent, host's monotonic time."""
        return self._next_ping_ns

    def to_send(self, now_ns: int) -> bytes:
        """A PING when one is due."""
        if now_ns < self._next_ping_ns:
            return b""
        unsure = self.clock.uncertainty_ns > SURE_ENOUGH_NS and self._ping_count < MOST_FIRST_PINGS
        quick = self._ping_count < FIRST_PINGS or not self.clock.synchronised or unsure
        interval = FIRST_PING_INTERVAL_NS if quick else PING_INTERVAL_NS
        spread = 2.0 * (self._ping_count * GOLDEN_RATIO % 1.0) - 1.0
        self._next_ping_ns = now_ns + round(interval * (1.0 + PING_SPREAD * spread))
        nonce = self._ping_count & 0xFFFFFFFF
        self._ping_count += 1
        # Answers that never came must not pile up.
        while len(self._pings) >= 16:
            del self._pings[next(iter(self._pings))]
        self._pings[nonce] = now_ns
        return ping(nonce, nonce)

    def take(self, reading: Reading, arrival_ns: int) -> bool:
        """Take a PONG."""
        if not isinstance(reading, PongReading):
            return False
        sent_ns = self._pings.pop(reading.nonce, None)
        if sent_ns is None:
            self._counters["unasked_pongs"] += 1
        else:
            self.clock.add_round_trip(sent_ns, arrival_ns, reading.device_time_us)
        return True

    def stamp_ns(self, reading: Reading) -> int | None:
        """The reading's device time in host time."""
        if not self.clock.synchronised or reading.device_time_us is None:
            return None
        return self.clock.to_host_ns(reading.device_time_us)

    def sensor_period_ns(self, reading: HallReading) -> int:
        """As the frame says."""
        return reading.sensor_period_us * 1000


class ArrivalTime:
    """Protocols of devices that only speak: the lower envelope of arrival times.

    From the envelope is taken what a sample needs until it is here: its bytes on a real serial line (none over USB
    CDC, where `byte_ns` is 0), and, for whisker frames, the reading of the sensors: the stamp is the first one's. With
    no `sensor_period_us` configured, reading is taken to fill the frame's period but for the time on the line.
    """

    def __init__(self, settings: DeviceSettings) -> None:
        self._settings = settings
        self._clock: ArrivalClock | None = None
        self._byte_ns = 0
        self._envelope_ns = 0

    @property
    def synchronised(self) -> bool:
        """Whether the envelope rests on enough samples."""
        return self._clock is not None and self._clock.synchronised

    @property
    def offset_ns(self) -> int:
        """Host time of the device's count zero, ns."""
        return 0 if self._clock is None else self._clock.offset_ns

    @property
    def uncertainty_ns(self) -> int:
        """Unknown: the least delay cannot be seen from one side."""
        return 0

    @property
    def drift(self) -> float:
        """Rate error of the device's clock."""
        return 0.0 if self._clock is None else self._clock.drift

    def opened(self, _decoder: Decoder, _now_ns: int, byte_ns: int) -> None:
        """The device may have restarted: its clock is learned anew."""
        self._byte_ns = byte_ns
        self._clock = None

    def to_send(self, _now_ns: int) -> bytes:
        """Nothing: it does not listen."""
        return b""

    def take(self, reading: Reading, arrival_ns: int) -> bool:
        """Every reading teaches the clock."""
        if self._clock is None:
            counting = SAMPLES if reading.device_time_us is None else DEVICE_TIME
            self._clock = ArrivalClock(RVC_INDEX if self._settings.protocol == "bno08x-rvc" else counting)
        sent = reading.sequence if reading.device_time_us is None else reading.device_time_us
        self._envelope_ns = self._clock.add(arrival_ns, sent)
        return False

    def stamp_ns(self, reading: Reading) -> int | None:
        """The envelope at the reading just taken, less the time from its measurement to its arrival."""
        if not self.synchronised:
            return None
        before = self._byte_ns * self._bytes(reading)
        if isinstance(reading, HallReading):
            before += reading.valid.size * self.sensor_period_ns(reading)
        return self._envelope_ns - before

    def sensor_period_ns(self, reading: HallReading) -> int:
        """As configured, else as long as the frame's period allows."""
        if self._settings.sensor_period_us is not None:
            return round(self._settings.sensor_period_us * 1000)
        frame_ns = 0.0 if self._clock is None else self._clock.step_ns
        return max(0, round((frame_ns - self._byte_ns * self._bytes(reading)) / reading.valid.size))

    def _bytes(self, reading: Reading) -> int:
        """About how many bytes the reading had on the line."""
        if isinstance(reading, HallReading):
            size = reading.valid.size
            if self._settings.protocol == "rm3-plaintext":
                return size * PLAINTEXT_CHARACTERS
            # Without a magnitude the third component is zero.
            values = 3 if reading.field_mT[..., 2].any() else values_per_sensor(self._settings.representation)[0]
            return 2 * values * size + 2
        if isinstance(reading, ScrewReading):
            return 15 if reading.current_mA is None else 23
        return SIZE if self._settings.protocol == "bno08x-rvc" else 0


class StartedTime(ArrivalTime):
    """Protocol `mip`: as `ArrivalTime`, and the device is told to stream after opening and whenever it is silent."""

    def __init__(self, settings: DeviceSettings) -> None:
        super().__init__(settings)
        self._decoder: MipDecoder | None = None
        self._next_start_ns = 0
        self._format = 0

    def opened(self, decoder: Decoder, now_ns: int, byte_ns: int) -> None:
        """The device may have lost its power and be idle."""
        super().opened(decoder, now_ns, byte_ns)
        self._decoder = decoder if isinstance(decoder, MipDecoder) else None
        self._next_start_ns = now_ns

    def to_send(self, now_ns: int) -> bytes:
        """The commands that start streaming, with a simpler format where the device has refused the last."""
        if self._decoder is not None and MESSAGE_FORMAT in self._decoder.refused:
            self._decoder.refused.clear()
            self._format = min(self._format + 1, len(FORMATS) - 1)
            self._next_start_ns = now_ns
        if now_ns < self._next_start_ns:
            return b""
        self._next_start_ns = now_ns + START_INTERVAL_NS
        return start_streaming(FORMATS[self._format])

    def take(self, reading: Reading, arrival_ns: int) -> bool:
        """A sample has come: no need to start the device within the next second."""
        self._next_start_ns = max(self._next_start_ns, arrival_ns + START_INTERVAL_NS)
        return super().take(reading, arrival_ns)


def device_time(settings: DeviceSettings, counters: Counters) -> DeviceTime:
    """What belongs to the protocol; `counters` are the device's own."""
    if settings.protocol == "framed":
        return AskedTime(counters)
    if settings.protocol == "mip":
        return StartedTime(settings)
    return ArrivalTime(settings)
