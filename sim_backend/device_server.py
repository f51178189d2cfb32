"""Serves a simulated robot's events on serial devices, in real time or a stated multiple of it."""

from __future__ import annotations

import contextlib
import logging
import queue
import select
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from sim_backend.control_socket import ControlSocket
from sim_backend.events import Event, TruthEvent
from sim_backend.serial_devices import EVENT_OF_DEVICE, SerialDevice

log = logging.getLogger(__name__)

#: After all devices have been asked for the time, the host gets this long to learn their clocks, s.
CLOCK_LEARNING = 0.5
#: At the end the host gets this long to read what is in the ports, s.
DRAIN = 1.0
#: Events computed ahead: two seconds, so that a busy moment does not stop the sensors.
AHEAD = 460
#: Faults of the lines begin and end within this time of their schedule, s, where no packet is due earlier.
POLL = 0.02
LATE_NS = 200_000_000


@dataclass(frozen=True, slots=True)
class StartTime:
    """When the simulation started: on the host's monotonic clock and as UNIX time, ns; simulated time per time."""

    monotonic_ns: int
    unix_ns: int
    rate: float

    def monotonic(self, simulated_ns: int) -> int:
        """Host's monotonic time, ns, of a simulated time."""
        return self.monotonic_ns + round(simulated_ns / self.rate)

    def unix(self, simulated_ns: int) -> int:
        """UNIX time, ns, of a simulated time, on the clock that published stamps use."""
        return self.unix_ns + round(simulated_ns / self.rate)


class DeviceServer:
    """Paces the events and answers the host; one thread computes ahead, one serves.

    Attributes:
        worst_lateness_ns: how late an event was sent at most.
    """

    def __init__(
        self,
        devices: dict[str, SerialDevice],
        array: tuple[int, int, int],
        *,
        rate: float = 1.0,
        on_truth: Callable[[TruthEvent, StartTime], None] | None = None,
        control: ControlSocket | None = None,
    ) -> None:
        """Serve these devices.

        Args:
            devices: by name.
            array: rows, columns and sensor period (us) of the whisker array.
            rate: simulated seconds per second.
            on_truth: called for each truth event when its time has come.
            control: served as well.
        """
        self._devices, self._array, self._rate, self._on_truth = devices, array, rate, on_truth
        self._control = control
        self._devices_of_event: dict[type[Event], list[SerialDevice]] = {}
        for device in devices.values():
            self._devices_of_event.setdefault(EVENT_OF_DEVICE[device.role], []).append(device)
        self._stop = threading.Event()
        self._abandoned = threading.Event()
        self.worst_lateness_ns = 0

    def stop(self) -> None:
        """End as soon as possible; may be called from a signal handler or another thread."""
        self._stop.set()

    def wait_for_host(self, timeout: float, names: Iterable[str]) -> bool:
        """Answer until a host wants every device of these names or roles; False if it has not within `timeout` s.

        A host wants a device that it has sent a PING or a command; of those that never listen, one whose port it
        has read or flushed.
        """
        wanted = set(names)
        awaited = [device for device in self._devices.values() if wanted & {device.name, device.role}]
        deadline = time.monotonic() + timeout
        while not self._stop.is_set() and time.monotonic() < deadline:
            self._answer(0.05)
            if all(device.host_came(time.monotonic_ns()) for device in awaited):
                self._answer_until(time.monotonic_ns() + int(1e9 * CLOCK_LEARNING))
                return True
        return False

    def serve(self, events: Iterator[Event]) -> StartTime:
        """Send all events when they are due, from now on; returns when the last is sent or after `stop`."""
        ahead: queue.Queue[Event | BaseException | None] = queue.Queue(AHEAD)
        producer = threading.Thread(target=self._produce, args=(events, ahead), name="simulation", daemon=True)
        producer.start()
        try:
            # The first events take the longest: start the clock when they are there.
            pending = self._next(ahead)
            start = StartTime(time.monotonic_ns(), time.time_ns(), self._rate)
            for device in self._devices.values():
                device.begin(start.monotonic_ns, self._rate)
            while pending is not None and not self._stop.is_set():
                self._answer_until(start.monotonic(pending.ready_ns))
                if not self._stop.is_set():
                    self._deliver(pending, start)
                    pending = self._next(ahead)
        finally:
            self._abandoned.set()
            producer.join()
        self._drain()
        return start

    def close(self) -> None:
        """Unplug all devices."""
        for device in self._devices.values():
            if device.port.plugged:
                device.port.close()

    def _deliver(self, event: Event, start: StartTime) -> None:
        lateness = time.monotonic_ns() - start.monotonic(event.ready_ns)
        if lateness > LATE_NS >= self.worst_lateness_ns:
            log.warning("the simulation is %.2f s behind: this machine is too busy for it", lateness * 1e-9)
        self.worst_lateness_ns = max(self.worst_lateness_ns, lateness)
        if isinstance(event, TruthEvent):
            if self._on_truth is not None:
                self._on_truth(event, start)
            return
        for device in self._devices_of_event.get(type(event), ()):
            device.advance(time.monotonic_ns())
            device.send(event, start.monotonic(event.time_ns), self._rate, self._array)

    def _produce(self, events: Iterator[Event], ahead: queue.Queue[Event | BaseException | None]) -> None:
        last: BaseException | None = None
        try:
            for event in events:
                if not self._put(ahead, event):
                    return
        except Exception as error:  # noqa: BLE001 - raised again in the serving thread
            last = error
        self._put(ahead, last)

    def _put(self, ahead: queue.Queue[Event | BaseException | None], item: Event | BaseException | None) -> bool:
        while not (self._stop.is_set() or self._abandoned.is_set()):
            with contextlib.suppress(queue.Full):
                ahead.put(item, timeout=0.1)
                return True
        return False

    def _next(self, ahead: queue.Queue[Event | BaseException | None]) -> Event | None:
        """The next event, None at the end; the devices answer while it is being computed."""
        while not self._stop.is_set():
            try:
                item = ahead.get_nowait()
            except queue.Empty:
                self._answer(0.002)
                continue
            if isinstance(item, BaseException):
                raise item
            return item
        return None

    def _answer_until(self, monotonic_ns: int) -> None:
        while not self._stop.is_set():
            left = monotonic_ns - time.monotonic_ns()
            if left <= 0:
                return
            self._answer(min(left * 1e-9, POLL))

    def _answer(self, timeout: float) -> None:
        now_ns = time.monotonic_ns()
        for device in self._devices.values():
            device.advance(now_ns)
        plugged = [device for device in self._devices.values() if device.port.plugged]
        control = [] if self._control is None else self._control.sockets()
        readable, _, _ = select.select([*(device.port for device in plugged), *control], [], [], timeout)
        if self._control is not None:
            self._control.serve(readable)
        for device in plugged:
            if device.port in readable:
                device.answer(time.monotonic_ns)

    def _drain(self) -> None:
        deadline = time.monotonic() + DRAIN
        listening = [device for device in self._devices.values() if device.port.plugged]
        while time.monotonic() < deadline and any(d.port.unread() for d in listening):
            self._answer(0.01)
