"""A device's port as the reader thread keeps it: open or not, what to try next and when."""

from __future__ import annotations

from concurrent.futures import Future
from pathlib import Path

import serial

from drivers.device import Device, DeviceState
from drivers.port_discovery import is_pattern
from drivers.usb_recovery import FIRST_RESET_NS

FIRST_RETRY_S = 0.25


class OpenPort:
    """A device and its port, when it has one, and when to try again.

    Attributes:
        device, port: the device; its port while it is open.
        retry_at, retry_after: when to try to open it next, and how long to wait after that, s.
        logged: state and fault that were logged last.
        ambiguous: whether its name may mean several ports.
        known: kinds of readings that it sent when it was last here.
        refused: ports that did not have it, as `node` names them, and until when not to try them again, s.
        opened_ns, bytes_ns: when it was opened, and when something last came.
        any_bytes: whether anything came since.
        other_screws, counted: the counters when it was opened.
        failures: in a row, without a measurement between them.
        usb: vendor, product and serial number, once known.
        reset_after_ns, reset: silence before the next reset; the one that is going on.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.port: serial.Serial | None = None
        self.retry_at = 0.0
        self.retry_after = FIRST_RETRY_S
        self.logged: tuple[DeviceState, str] = ("streaming", "")
        name = device.settings.port
        # A path is taken at its word; what may mean several ports is listened to.
        self.ambiguous = not name.startswith("/") or is_pattern(name)
        self.known: frozenset[str] = frozenset()
        self.refused: dict[tuple[str, int, int], float] = {}
        self.opened_ns = self.bytes_ns = 0
        self.any_bytes = False
        self.other_screws = 0
        self.counted = device.decoder.counters.copy()
        self.failures = 0
        self.usb: tuple[int, int, str | None] | None = None
        self.reset_after_ns = FIRST_RESET_NS
        self.reset: Future[None] | None = None


def node(path: str) -> tuple[str, int, int]:
    """A device node as it is now: another one under the same name is not the same."""
    try:
        status = Path(path).stat()
    except OSError:
        return path, 0, 0
    return path, status.st_ino, status.st_ctime_ns
