"""All serial ports in one thread: opens, reads, answers, reopens; measurements go to one bounded queue."""

from __future__ import annotations

import logging
import os
import queue
import selectors
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

import serial

from drivers.device import Device, DeviceStatus
from drivers.measurement import Measurement
from drivers.open_port import FIRST_RETRY_S, OpenPort, node
from drivers.port_discovery import byte_time_ns, canonical, check_port_name, find_paths
from drivers.port_probe import may_speak, verdict
from drivers.port_resets import PortResets
from drivers.settings import DeviceSettings
from drivers.usb_recovery import FIRST_RESET_NS

log = logging.getLogger(__name__)

#: Ports are looked after this often: those that came back are opened, silence is noticed, devices are told to start.
TICK_NS = 20_000_000
#: A device that is plugged in again must be in use within 2 s.
LONGEST_RETRY_S = 1.0
#: 10 s of a full robot: 25 frames, 100 IMU samples, 50 encoder readings, 30 odometry readings a second.
QUEUE_LENGTH = 2048
READ_BYTES = 65536
#: A port that did not have the device is not tried again so soon; a silent one may still be starting.
WRONG_AGAIN_S = 10.0
SILENT_AGAIN_S = 1.0
NOT_FOUND = "port {}: not found on the ports that are there"


class SerialReader:
    """The thread `drivers`: one for all ports, since all of them are slow and Python has one interpreter lock.

    Use as a context manager; `get` returns measurements in the order of their arrival.
    """

    def __init__(self, settings: Sequence[DeviceSettings], usb_backend: object = None) -> None:
        """Read these devices.

        Args:
            settings: of the devices.
            usb_backend: pyusb's, for resets; None takes libusb.

        Raises:
            PortNameError: a port's name that can never be right.
        """
        for one in settings:
            check_port_name(one.port)
        self._ports = [OpenPort(Device(one)) for one in settings]
        # Written in C, so a fifth of `queue.Queue`; `_deliver` keeps the bound.
        self._queue: queue.SimpleQueue[tuple[str, Measurement]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="drivers", daemon=True)
        self._selector = selectors.DefaultSelector()
        #: When there is something to do next that no data call for.
        self._tend_ns = 0
        self._failure: BaseException | None = None
        self._resets = PortResets(self._close, usb_backend)
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
        self._resets.close()

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
        now = time.monotonic_ns()
        if now >= self._tend_ns:
            for entry in self._ports:
                self._tend(entry, now)
            self._tend_ns = self._next_tend_ns(now)
            now = time.monotonic_ns()
        wait_s = max(self._tend_ns - now, 0) * 1e-9
        if not self._selector.get_map():
            self._stop.wait(wait_s)
        else:
            for key, _ in self._selector.select(wait_s):
                self._read(key.data)

    def _tend(self, entry: OpenPort, now_ns: int) -> None:
        """What a port needs from time to time, whether data come or not."""
        if entry.reset is not None:
            self._resets.end_if_done(entry)
        elif entry.port is None and time.monotonic() >= entry.retry_at:
            self._open(entry)
        if entry.device.state == "probing":
            self._probe(entry, now_ns)
        self._write(entry)
        entry.device.check_silence(now_ns)
        self._resets.begin_if_wedged(entry, now_ns)
        self._log_change(entry)

    def _next_tend_ns(self, now_ns: int) -> int:
        """Within a tick, or when a ping is due: sent only when data wake this thread, all would meet the same delay."""
        due = (entry.device.due_ns for entry in self._ports if entry.port is not None)
        return min([now_ns + TICK_NS, *(one for one in due if one is not None)])

    def _open(self, entry: OpenPort) -> None:
        taken = frozenset(canonical(e.device.path) for e in self._ports if e.device.path is not None)
        device = entry.device
        paths = find_paths(device.settings.port, taken)
        fault = f"port {device.settings.port} is not there"
        for path in paths:
            if entry.refused.get(node(path), 0.0) > time.monotonic():
                fault = NOT_FOUND.format(device.settings.port)
                continue
            try:
                port = serial.Serial(path, device.settings.baud, timeout=0, write_timeout=0.2, exclusive=True)
            except (serial.SerialException, OSError, ValueError) as error:
                fault = f"port {path} cannot be opened: {_reason(error)}"
                continue
            entry.port = port
            entry.retry_after = FIRST_RETRY_S
            entry.opened_ns = entry.bytes_ns = time.monotonic_ns()
            entry.any_bytes = False
            entry.other_screws = device.counters["other_screw"]
            entry.counted = device.decoder.counters.copy()
            self._selector.register(port.fileno(), selectors.EVENT_READ, entry)
            device.opened(path, entry.opened_ns, byte_time_ns(path, device.settings.baud))
            if entry.ambiguous:
                device.state = "probing"
            return
        if device.fault != fault:
            device.lost(fault)
        else:
            device.state = "absent"
        entry.retry_at = time.monotonic() + entry.retry_after
        entry.retry_after = min(entry.retry_after * 2.0, LONGEST_RETRY_S)

    def _probe(self, entry: OpenPort, now_ns: int) -> None:
        """Keep the port if it has the device; leave it if it has another."""
        device, path = entry.device, entry.device.path
        found = verdict(
            device.settings,
            device.heard,
            entry.known,
            other_screw=device.counters["other_screw"] > entry.other_screws,
            elapsed_ns=now_ns - entry.opened_ns,
            any_bytes=entry.any_bytes,
        )
        if found == "right":
            device.state = "synchronising"
        elif found != "listening" and path is not None:
            entry.refused = {one: until for one, until in entry.refused.items() if until > time.monotonic()}
            again = WRONG_AGAIN_S if found == "wrong" else SILENT_AGAIN_S
            entry.refused[node(path)] = time.monotonic() + again
            self._close(entry)
            # What other devices say is no fault of this one.
            device.decoder.counters = entry.counted
            device.state, device.path = "absent", None
            device.fault = NOT_FOUND.format(device.settings.port)
            entry.retry_at = time.monotonic()

    def _read(self, entry: OpenPort) -> None:
        port = entry.port
        if port is None:
            return
        try:
            # Not by pyserial, which asks again whether there is something to read.
            data = os.read(port.fileno(), READ_BYTES)
        except BlockingIOError:
            return
        except (serial.SerialException, OSError) as error:
            self._lost(entry, f"read failed: {_reason(error)}")
            return
        arrival_ns = time.monotonic_ns()
        if not data:
            self._lost(entry, "read failed: nothing there (the device is gone, or another program reads it)")
            return
        entry.bytes_ns, entry.any_bytes = arrival_ns, True
        device = entry.device
        measurements = device.received(data, arrival_ns)
        if device.state == "probing":
            self._probe(entry, arrival_ns)
            if entry.port is None or device.state == "probing":
                return
        if measurements:
            entry.failures, entry.reset_after_ns = 0, FIRST_RESET_NS
            if entry.ambiguous:
                entry.known = entry.known | frozenset(device.heard)
        for measurement in measurements:
            self._deliver(device.settings.name, measurement)

    def _write(self, entry: OpenPort) -> None:
        device, now_ns = entry.device, time.monotonic_ns()
        if entry.port is None:
            return
        if device.state == "probing" and not may_speak(
            device.settings, device.heard, elapsed_ns=now_ns - entry.opened_ns, any_bytes=entry.any_bytes
        ):
            return
        data = device.to_send(now_ns)
        if not data:
            return
        try:
            entry.port.write(data)
        except serial.SerialTimeoutException:
            device.counters["write_timeouts"] += 1
        except (serial.SerialException, OSError) as error:
            self._lost(entry, f"write failed: {_reason(error)}")

    def _deliver(self, device: str, measurement: Measurement) -> None:
        # Only this thread puts, so there is room if there was.
        if self._queue.qsize() >= QUEUE_LENGTH:
            # The newest matter most to a robot that is behind; the loss is counted and reported.
            with suppress(queue.Empty):
                self._queue.get_nowait()
                self.dropped += 1
        self._queue.put((device, measurement))

    def _lost(self, entry: OpenPort, fault: str) -> None:
        self._resets.failed(entry)
        self._close(entry)
        entry.device.lost(fault)
        entry.retry_at = time.monotonic() + FIRST_RETRY_S

    def _close(self, entry: OpenPort) -> None:
        if entry.port is None:
            return
        self._selector.unregister(entry.port.fileno())
        try:
            entry.port.close()
        except OSError as error:
            log.warning("device %s: closing failed: %s", entry.device.settings.name, error)
        entry.port = None

    def _log_change(self, entry: OpenPort) -> None:
        device = entry.device
        now = (device.state, device.fault)
        # Listening to one port after the other is no change worth a line.
        if now == entry.logged or device.state == "probing":
            return
        entry.logged = now
        level = logging.WARNING if device.fault else logging.INFO
        detail = device.fault or device.path
        name, fields = device.settings.name, {"device": device.settings.name, "state": device.state}
        log.log(level, "device %s: %s (%s)", name, device.state, detail, extra=fields)


def _reason(error: BaseException) -> str:
    if isinstance(error, serial.SerialException) and "exclusively lock" in str(error):
        return "another program has it open"
    return str(error)
