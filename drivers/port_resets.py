"""Which open ports are to be reset, and when; resets go on beside the reading of the other devices."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from drivers.open_port import OpenPort
from drivers.usb_recovery import LONGEST_RESET_NS, UsbResetError, reset, usb_port

#: So many failures in a row without a measurement between them call for a reset as well.
FAILURES_BEFORE_RESET = 5


class PortResets:
    """Resets wedged devices, in a thread of its own once the first one is: a reset takes up to a second.

    Args:
        close: closes a port.
        usb_backend: pyusb's; None takes libusb.
    """

    def __init__(self, close: Callable[[OpenPort], None], usb_backend: object = None) -> None:
        self._close = close
        self._usb_backend = usb_backend
        self._thread: ThreadPoolExecutor | None = None

    def failed(self, entry: OpenPort) -> None:
        """Count a failure of a port that is still open: its device's address is known now."""
        path = entry.device.path
        entry.failures += 1
        if entry.failures >= FAILURES_BEFORE_RESET and path is not None:
            entry.usb = usb_port(path) or entry.usb

    def begin_if_wedged(self, entry: OpenPort, now_ns: int) -> None:
        """Reset a USB device that is open but has sent nothing for long, or that fails again and again."""
        silent = entry.port is not None and entry.device.state == "silent"
        silent = silent and now_ns - max(entry.bytes_ns, entry.opened_ns) > entry.reset_after_ns
        if entry.reset is not None or not (silent or entry.failures >= FAILURES_BEFORE_RESET):
            return
        entry.failures = 0
        if entry.device.path is not None:
            entry.usb = usb_port(entry.device.path) or entry.usb
        entry.bytes_ns = now_ns
        if entry.usb is None:
            return
        entry.reset_after_ns = min(2 * entry.reset_after_ns, LONGEST_RESET_NS)
        self._close(entry)
        entry.device.state, entry.device.path = "resetting", None
        entry.device.counters["resets"] += 1
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="usb-reset")
        entry.reset = self._thread.submit(reset, *entry.usb, backend=self._usb_backend)

    def end_if_done(self, entry: OpenPort) -> None:
        """Let the port be opened again once its reset is done, whatever came of it."""
        if entry.reset is None or not entry.reset.done():
            return
        error, entry.reset = entry.reset.exception(), None
        if error is not None and not isinstance(error, UsbResetError):
            raise error
        entry.device.state = "absent"
        entry.device.fault = "silent, has been reset" if error is None else f"silent, and cannot be reset: {error}"
        entry.retry_at = time.monotonic()

    def close(self) -> None:
        """Begin no more."""
        if self._thread is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
