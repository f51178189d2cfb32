"""What a device needs to know about itself; the configuration fills it in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Protocol = Literal["framed"]


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """One port.

    Attributes:
        name: the device's name in status, logs and keys.
        port: a path, `usb:VID:PID[:SERIAL]` (hexadecimal ids) or `auto`.
        protocol: the protocol spoken on it.
        baud: bits per second (USB CDC devices ignore it).
        ticks_per_turn: encoder ticks per turn of a screw.
    """

    name: str
    port: str
    protocol: Protocol = "framed"
    baud: int = 115200
    ticks_per_turn: int = 4096
