"""A device's clock mapped to the host's monotonic clock by PING/PONG round trips.

Each round trip bounds the offset: the device answered between sending and receiving, so the midpoint errs by at
most half the trip. A line (offset and drift) is fitted through the midpoints of the quicker trips; arrival times
of measurements, bursty over USB, are never used. The idea of regression over round trips with an ageing minimum
is that of Klipper's clock synchronisation.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

WRAP_US = 1 << 32
#: Round trips remembered: one a second, so the drift is seen over half a minute.
WINDOW = 32
#: The drift is estimated once the trips span this long; before that it is taken as zero.
MIN_DRIFT_SPAN_NS = 5_000_000_000
#: Crystals are good to 100 ppm; what deviates more is noise or a jump.
MAX_DRIFT = 500e-6
#: Round trips slower than this many times the quickest (plus slack) are kept out of the fit.
SLOW_TRIP_FACTOR = 2.0
SLOW_TRIP_SLACK_NS = 200_000
#: A midpoint that misses the line by more than this beyond its own bound: the device's clock jumped.
JUMP_NS = 20_000_000


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """One PING/PONG: device clock (us, unwrapped), host midpoint and half trip time (ns)."""

    device_us: int
    host_ns: int
    half_trip_ns: int


class DeviceClock:
    """Maps a wrapping 32-bit microsecond clock to monotonic host nanoseconds.

    Attributes:
        jumps: how often the device's clock jumped (a restart of the device, mostly).
        drift: estimated rate error of the device's clock, dimensionless.
        uncertainty_ns: half the quickest trip in the window; the mapping's bound.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self.drift = 0.0
        self.uncertainty_ns = 0
        self._trips: deque[RoundTrip] = deque(maxlen=WINDOW)
        self._last_device_us: int | None = None
        self._reference_us = 0
        self._reference_ns = 0

    @property
    def synchronised(self) -> bool:
        """True once at least one round trip was made since the start or the last jump."""
        return bool(self._trips)

    @property
    def offset_ns(self) -> int:
        """Host time minus device time now, ns; 0 while not synchronised."""
        return self._reference_ns - self._reference_us * 1000 if self._trips else 0

    def reset(self) -> None:
        """Forget everything: the device was opened anew."""
        self._trips.clear()
        self._last_device_us = None
        self.drift = 0.0

    def unwrap(self, device_us: int) -> int:
        """The device's time continued beyond 32 bits: the value nearest to the last one seen."""
        if self._last_device_us is None:
            self._last_device_us = device_us
            return device_us
        step = (device_us - self._last_device_us + WRAP_US // 2) % WRAP_US - WRAP_US // 2
        unwrapped = self._last_device_us + step
        self._last_device_us = max(self._last_device_us, unwrapped)
        return unwrapped

    def add_round_trip(self, sent_ns: int, received_ns: int, device_us: int) -> None:
        """Take a PONG: `device_us` as sent (wrapping), between `sent_ns` and `received_ns` of the host."""
        half = max(0, (received_ns - sent_ns) // 2)
        trip = RoundTrip(self.unwrap(device_us), sent_ns + half, half)
        if self._trips:
            miss = abs(trip.host_ns - self._map(trip.device_us))
            if miss > JUMP_NS + half:
                self.jumps += 1
                self.reset()
                trip = RoundTrip(self.unwrap(device_us), trip.host_ns, half)
        self._trips.append(trip)
        self._fit()

    def to_host_ns(self, device_us: int) -> int:
        """Host time of a device time as sent (wrapping).

        Raises:
            RuntimeError: not synchronised yet.
        """
        if not self._trips:
            raise RuntimeError("the device's clock is not synchronised yet")
        return self._map(self.unwrap(device_us))

    def _map(self, unwrapped_us: int) -> int:
        elapsed_us = unwrapped_us - self._reference_us
        return self._reference_ns + round(elapsed_us * 1000 * (1.0 + self.drift))

    def _fit(self) -> None:
        quickest = min(trip.half_trip_ns for trip in self._trips)
        limit = quickest * SLOW_TRIP_FACTOR + SLOW_TRIP_SLACK_NS
        good = [trip for trip in self._trips if trip.half_trip_ns <= limit]
        device = np.array([trip.device_us - good[0].device_us for trip in good], dtype=np.float64) * 1000.0
        host = np.array([trip.host_ns - good[0].host_ns for trip in good], dtype=np.float64)
        residual = host - device
        span = device[-1] - device[0]
        slope = 0.0
        if span >= MIN_DRIFT_SPAN_NS:
            centred = device - device.mean()
            slope = float(centred @ (residual - residual.mean()) / (centred @ centred))
            slope = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
        self.drift = slope
        mean_device = float(device.mean())
        mean_residual = float(residual.mean())
        self._reference_us = good[0].device_us + round(mean_device / 1000.0)
        rounded = (self._reference_us - good[0].device_us) * 1000.0
        self._reference_ns = good[0].host_ns + round(rounded + mean_residual)
        self.uncertainty_ns = quickest
