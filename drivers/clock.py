"""A device's clock mapped to the host's monotonic clock by PING/PONG round trips.

Each round trip bounds the offset: the device answered between sending and receiving, so the midpoint errs by at
most half the trip. A line (offset and drift) is fitted through the midpoints, each weighted by its bound; arrival
times of measurements, bursty over USB, are never used. The idea of regression over round trips with an ageing minimum
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
#: A trip's bound is taken as no smaller than this: clocks tick in microseconds and threads are not quicker.
LEAST_HALF_TRIP_NS = 20_000
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
        synchronised: true once at least one round trip was made since the start or the last jump.
        jumps: how often the device's clock jumped (a restart of the device, mostly).
        drift: estimated rate error of the device's clock, dimensionless.
        uncertainty_ns: the mapping's bound: the trips' own bounds, in the mean that the fit takes of their midpoints.
    """

    def __init__(self) -> None:
        self.synchronised = False
        self.jumps = 0
        self.drift = 0.0
        self.uncertainty_ns = 0
        self._trips: deque[RoundTrip] = deque(maxlen=WINDOW)
        self._last_device_us: int | None = None
        self._reference_us = 0
        self._reference_ns = 0

    @property
    def offset_ns(self) -> int:
        """Host time minus device time now, ns; 0 while not synchronised."""
        return self._reference_ns - self._reference_us * 1000 if self._trips else 0

    def reset(self) -> None:
        """Forget everything: the device was opened anew."""
        self._trips.clear()
        self.synchronised = False
        self._last_device_us = None
        self.drift = 0.0

    def unwrap(self, device_us: int) -> int:
        """The device's time continued beyond 32 bits: the value nearest to the last one seen."""
        if self._last_device_us is None:
            self._last_device_us = device_us
            return device_us
        step = (device_us - self._last_device_us + WRAP_US // 2) % WRAP_US - WRAP_US // 2
        unwrapped = self._last_device_us + step
        if step > 0:
            self._last_device_us = unwrapped
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
        self.synchronised = True
        self._fit()

    def to_host_ns(self, device_us: int) -> int:
        """Host time of a device time as sent (wrapping).

        Raises:
            RuntimeError: not synchronised yet.
        """
        if not self.synchronised:
            raise RuntimeError("the device's clock is not synchronised yet")
        return self._map(self.unwrap(device_us))

    def _map(self, unwrapped_us: int) -> int:
        elapsed_us = unwrapped_us - self._reference_us
        return self._reference_ns + round(elapsed_us * 1000 * (1.0 + self.drift))

    def _fit(self) -> None:
        first = self._trips[0]
        device = np.array([trip.device_us - first.device_us for trip in self._trips], dtype=np.float64) * 1000.0
        host = np.array([trip.host_ns - first.host_ns for trip in self._trips], dtype=np.float64)
        bound = np.array([max(trip.half_trip_ns, LEAST_HALF_TRIP_NS) for trip in self._trips], dtype=np.float64)
        # A trip that took four times as long counts a sixteenth: on a busy machine one quick trip outweighs all others.
        weight = bound**-2 / np.sum(bound**-2)
        residual = host - device
        mean_device = float(weight @ device)
        mean_residual = float(weight @ residual)
        slope = 0.0
        centred = device - mean_device
        # Trips that were quick enough to be trusted, not the slow ones at the ends, must span the time.
        spread = float(weight @ centred**2)
        if device[-1] - device[0] >= MIN_DRIFT_SPAN_NS and 12.0 * spread >= MIN_DRIFT_SPAN_NS**2:
            slope = float(weight @ (centred * (residual - mean_residual))) / spread
            slope = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
        self.drift = slope
        self._reference_us = first.device_us + round(mean_device / 1000.0)
        rounded = (self._reference_us - first.device_us) * 1000.0
        self._reference_ns = first.host_ns + round(rounded + mean_residual)
        self.uncertainty_ns = round(float(weight @ bound))
