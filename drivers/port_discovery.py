"""From a port's name in the configuration to a device path that exists now."""

from __future__ import annotations

from pathlib import Path

from serial.tools import list_ports


class PortNameError(ValueError):
    """A port name that can never be right; the message says what was expected."""


def parse_usb(name: str) -> tuple[int, int, str | None]:
    """Vendor id, product id and serial number of `usb:VID:PID[:SERIAL]`.

    Raises:
        PortNameError: not of that form.
    """
    parts = name.split(":", 3)
    try:
        if parts[0] != "usb" or len(parts) < 3:
            raise ValueError
        return int(parts[1], 16), int(parts[2], 16), parts[3] if len(parts) == 4 else None
    except ValueError:
        raise PortNameError(f"port {name!r}: expected usb:VID:PID or usb:VID:PID:SERIAL with hexadecimal ids") from None


def check_port_name(name: str) -> None:
    """Raise PortNameError unless `name` is a path, `usb:...` or `auto`."""
    if name.startswith("usb:"):
        parse_usb(name)
    elif name != "auto" and not name.startswith("/"):
        raise PortNameError(f"port {name!r}: expected an absolute path, usb:VID:PID[:SERIAL] or auto")


def is_pattern(name: str) -> bool:
    """Whether a path is a pattern: `/dev/ttyACM*`."""
    return name.startswith("/") and any(c in name for c in "*?[")


def canonical(path: str) -> str:
    """The path without links: two names of one port are one port."""
    return str(Path(path).resolve())


def find_paths(name: str, taken: frozenset[str] = frozenset()) -> list[str]:
    """Device paths that `name` may mean now, sorted; empty if the device is not there.

    Args:
        name: a path, a pattern of paths, `usb:VID:PID[:SERIAL]` or `auto` (every serial port of the kinds that USB
            makes).
        taken: paths in use by other devices of this process, without links.
    """
    if name.startswith("usb:"):
        vendor, product, serial_number = parse_usb(name)
        found = [
            port.device
            for port in list_ports.comports()
            if port.vid == vendor
            and port.pid == product
            and (serial_number is None or port.serial_number == serial_number)
        ]
    elif name == "auto":
        usb_names = ("ttyACM", "ttyUSB")
        found = [p.device for p in list_ports.comports() if p.vid is not None or p.name.startswith(usb_names)]
    elif is_pattern(name):
        found = [str(path) for path in Path("/").glob(name[1:])]
    else:
        found = [name] if Path(name).exists() else []
    return sorted(path for path in found if canonical(path) not in taken)


def byte_time_ns(path: str, baud: int) -> int:
    """Time that a byte takes on the line behind a port, ns; 0 where there is no line: USB CDC, pseudo-terminals.

    Args:
        path: of the port; links are followed.
        baud: bits per second, ten of them a byte.
    """
    name = Path(path).resolve().name
    return 10_000_000_000 // baud if name.startswith(("ttyUSB", "ttyS", "ttyAMA", "ttyO", "ttymxc")) else 0
