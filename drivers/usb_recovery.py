"""Resets a USB device that has wedged: open but silent, or failing again and again. pyusb is loaded when needed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from serial.tools import list_ports

from drivers.port_discovery import canonical

if TYPE_CHECKING:
    from usb.core import Device

#: A device that is open but silent for this long is reset; it gets twice as long after each reset, up to the last.
FIRST_RESET_NS = 5_000_000_000
LONGEST_RESET_NS = 60_000_000_000


class UsbResetError(RuntimeError):
    """The reset did not work; one line that says why."""


def usb_port(path: str) -> tuple[int, int, str | None] | None:
    """Vendor id, product id and serial number of the USB device behind a port; None where it is not on USB."""
    wanted = canonical(path)
    for port in list_ports.comports():
        if canonical(port.device) == wanted and port.vid is not None and port.pid is not None:
            return port.vid, port.pid, port.serial_number
    return None


def reset(vendor: int, product: int, serial_number: str | None, backend: object = None) -> None:
    """Reset a USB device, as unplugging it does.

    Args:
        vendor, product, serial_number: which; without a serial number there must be one of them only.
        backend: of pyusb (`usb.backend.IBackend`); None takes libusb.

    Raises:
        UsbResetError: pyusb or libusb is not installed, there is no such device, it is ambiguous, or it refused.
    """
    try:
        import usb.core
        import usb.util
    except ImportError as error:
        raise UsbResetError(f"pyusb is not installed ({error})") from error
    try:
        found = list(usb.core.find(find_all=True, idVendor=vendor, idProduct=product, backend=backend))
        if serial_number is not None:
            found = [device for device in found if _serial_number(device) == serial_number]
        which = f"{vendor:04x}:{product:04x}" + (f":{serial_number}" if serial_number else "")
        if not found:
            raise UsbResetError(f"no USB device {which}")
        if len(found) > 1:
            raise UsbResetError(f"{len(found)} USB devices {which}: name one by its serial number")
        try:
            found[0].reset()
        finally:
            usb.util.dispose_resources(found[0])
    except usb.core.NoBackendError as error:
        raise UsbResetError("libusb is not installed") from error
    except usb.core.USBError as error:
        raise UsbResetError(f"refused: {error}") from error


def _serial_number(device: Device) -> str | None:
    try:
        number = device.serial_number
    except ValueError:
        # Strings of a device that may not be opened cannot be read.
        return None
    return None if number is None else str(number)
