"""All serial ports in one thread: opens, reads, answers, reopens; measurements go to one bounded queue."""

from __future__ import annotations

import logging
import queue
import selectors
import threading
import time
from collections.abc import Sequence

import serial

from drivers.device import Device, DeviceState, DeviceStatus
from drivers.measurement import Measurement
from drivers.port_discovery import check_port_name, find_paths
from drivers.settings import DeviceSettings

log = logging.getLogger(__name__)

#: The thread wakes at least this often, for pings and for ports that came back.
TICK_S = 0.02
FIRST_RETRY_S = 0.25
#: A device that is plugged in again must be in use within 2 s.
LONGEST_RETRY_S = 1.0
#: 10 s of a full robot: 25 frames, 100 IMU samples, 50 encoder readings, 30 odometry readings a second.
QUEUE_LENGTH = 2048
READ_BYTES = 65536


class _OpenPort:
    """A device and its port, when it has one, and when to try again."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.port: serial.Serial | None = None
        self.retry_at = 0.0
        self.retry_after = FIRST_RETRY_S
        self.logged: tuple[DeviceState, str] = ("streaming", "")


class SerialReader:
    """The thread `drivers`: one for all ports, since all of them are slow and Python has one interpreter lock.

    Use as a context manager; `get` returns measurements in the order of their arrival.
    """

    def __init__(self, settings: Sequence[DeviceSettings]) -> None:
        for one in settings:
            check_port_name(one.port)
        self._ports = [_OpenPort(Device(one)) for one in settings]
        self._queue: queue.Queue[tuple[str, Measurement]] = queue.Queue(QUEUE_LENGTH)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="drivers", daemon=True)
        self._selector = selectors.DefaultSelector()
        self._failure: BaseException | None = None
        self.dropped = 0

    def __enter__(self) -> SerialReader:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=5.0)
        for entry in self._ports:
            self._close(entry)
        self._selector.close()

    def get(self, timeout: float) -> tuple[str, Measurement] | None:
        """The next (device, measurement), or None after `timeout` seconds.

        Raises:
            RuntimeError: the thread itself failed (our own fault, never a device's).
        """
        try:
            return self._queue.get(timeout=timeout)
        except queue.Empty:
            if self._failure is not None:
                raise RuntimeError("the drivers' thread failed") from self._failure
            return None

    def status(self) -> list[DeviceStatus]:
        """The devices' states and counters."""
        return [entry.device.status() for entry in self._ports]

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._turn()
        except BaseException as error:
            # Handed to the consumer, which raises it: a thread must not die unseen.
            self._failure = error
            log.exception("the drivers' thread failed")

    def _turn(self) -> None:
        for entry in self._ports:
            if entry.port is None and time.monotonic() >= entry.retry_at:
                self._open(entry)
        if not self._selector.get_map():
            self._stop.wait(TICK_S)
        else:
            for key, _ in self._selector.select(TICK_S):
                self._read(key.data)
        now = time.monotonic_ns()
        for entry in self._ports:
            self._write(entry, now)
            entry.device.check_silence(now)
            self._log_change(entry)

    def _open(self, entry: _OpenPort) -> None:
        taken = frozenset(other.device.path for other in self._ports if other.device.path is not None)
        device = entry.device
        paths = find_paths(device.settings.port, taken)
        fault = f"port {device.settings.port} is not there"
        for path in paths:
            try:
                port = serial.Serial(path, device.settings.baud, timeout=0, write_timeout=0.2, exclusive=True)
            except (serial.SerialException, OSError, ValueError) as error:
                fault = f"port {path} cannot be opened: {_reason(error)}"
                continue
            entry.port = port
            entry.retry_after = FIRST_RETRY_S
            self._selector.register(port.fileno(), selectors.EVENT_READ, entry)
            device.opened(path, time.monotonic_ns())
            return
        if device.fault != fault:
            device.lost(fault)
        entry.retry_at = time.monotonic() + entry.retry_after
        entry.retry_after = min(entry.retry_after * 2.0, LONGEST_RETRY_S)

    def _read(self, entry: _OpenPort) -> None:
        port = entry.port
        if port is None:
            return
        try:
            data = port.read(READ_BYTES)
        except (serial.SerialException, OSError) as error:
            self._lost(entry, f"read failed: {_reason(error)}")
            return
        arrival_ns = time.monotonic_ns()
        if not data:
            return
        for measurement in entry.device.received(data, arrival_ns):
            self._deliver(entry.device.settings.name, measurement)

    def _write(self, entry: _OpenPort, now_ns: int) -> None:
        if entry.port is None:
            return
        data = entry.device.to_send(now_ns)
        if not data:
            return
        try:
            entry.port.write(data)
        except serial.SerialTimeoutException:
            entry.device.counters["write_timeouts"] += 1
        except (serial.SerialException, OSError) as error:
            self._lost(entry, f"write failed: {_reason(error)}")

    def _deliver(self, device: str, measurement: Measurement) -> None:
        while True:
            try:
                self._queue.put_nowait((device, measurement))
                return
            except queue.Full:
                # The newest matter most to a robot that is behind; the loss is counted and reported.
                try:
                    self._queue.get_nowait()
                    self.dropped += 1
                except queue.Empty:
                    continue

    def _lost(self, entry: _OpenPort, fault: str) -> None:
        self._close(entry)
        entry.device.lost(fault)
        entry.retry_at = time.monotonic() + FIRST_RETRY_S

    def _close(self, entry: _OpenPort) -> None:
        if entry.port is None:
            return
        self._selector.unregister(entry.port.fileno())
        try:
            entry.port.close()
        except OSError as error:
            log.warning("device %s: closing failed: %s", entry.device.settings.name, error)
        entry.port = None

    def _log_change(self, entry: _OpenPort) -> None:
        device = entry.device
        now = (device.state, device.fault)
        if now == entry.logged:
            return
        entry.logged = now
        level = logging.WARNING if device.fault else logging.INFO
        detail = device.fault or device.path
        log.log(level, "device %s: %s (%s)", device.settings.name, device.state, detail)


def _reason(error: BaseException) -> str:
    if isinstance(error, serial.SerialException) and "exclusively lock" in str(error):
        return "another program has it open"
    return str(error)
