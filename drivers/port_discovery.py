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


def find_paths(name: str, taken: frozenset[str] = frozenset()) -> list[str]:
    """Device paths that `name` may mean now, best first; empty if the device is not there.

    Args:
        name: a path, `usb:VID:PID[:SERIAL]` or `auto` (every USB serial port that nobody has taken).
        taken: paths in use by other devices of this process.
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
        found = [port.device for port in list_ports.comports() if port.vid is not None]
    else:
        found = [name] if Path(name).exists() else []
    return sorted(path for path in found if path not in taken)
